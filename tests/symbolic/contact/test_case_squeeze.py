"""A case's least squeeze against the true rigid body's balance, solved by clarabel."""

from __future__ import annotations

import numpy as np
import pytest

from studies.research.plain.load import GRAVITY
from studies.research.plain.motion import angular_rates, rotation
from symbolic.contact.worst_cases import CASE_SIZE, case_squeeze_function
from tests.symbolic.cells import call
from tests.symbolic.contact.joint_oracle import Case, least_wrenches
from tests.symbolic.contact.test_payload_load import random_cell, random_motion


def test_agrees_with_the_true_bodys_balance() -> None:
    """The body's inertia about its own centre of mass follows by Steiner's theorem."""
    rng = np.random.default_rng(11)
    for _ in range(40):
        cell, (pose, rate, second) = random_cell(rng), random_motion(rng)
        payload, R = cell.payload, rotation(pose[3:])
        friction, radius = rng.uniform(0.3, 1.2, 2), rng.uniform(0.005, 0.04, 2)
        mass, disturbance = payload.mass * rng.uniform(0.8, 1.2), rng.normal(size=3)
        centre = payload.centre_of_mass + rng.normal(scale=0.01, size=3)
        displaced = rng.normal(scale=0.002, size=(2, 2))
        d = centre - payload.centre_of_mass
        nominal = mass / payload.mass * payload.inertia
        inertia = R @ (nominal - mass * (d @ d * np.eye(3) - np.outer(d, d))) @ R.T
        omega, alpha = angular_rates(pose[3:], rate[3:], second[3:])
        c = R @ centre
        acceleration = second[:3] + np.cross(alpha, c) + np.cross(omega, np.cross(omega, c))
        force = mass * (acceleration + disturbance - GRAVITY)
        moment = inertia @ alpha + np.cross(omega, inertia @ omega)
        R_box_pad = cell.contacts[0].T_box_pad[:3, :3]
        points = np.array([contact.T_box_pad[:3, 3] for contact in cell.contacts])
        arms = (points - centre) @ R_box_pad
        arms[:, :2] += displaced
        to_pad = (R @ R_box_pad).T
        expected = least_wrenches(
            Case(to_pad @ force, to_pad @ moment, arms, friction, radius), squeeze=True
        )
        case = np.concatenate([friction, radius, [mass], centre, disturbance, displaced.ravel()])
        case = np.append(case, np.zeros(CASE_SIZE - len(case)))  # pads press as commanded
        found = call(case_squeeze_function(cell), pose, rate, second, case)["normal_force"]
        size = float(np.abs(expected[:, 2]).max())
        assert found == pytest.approx(expected[:, 2] * [1.0, -1.0], abs=1e-6 * size)
