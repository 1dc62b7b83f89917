"""The load of a sample under the joint allocation: the paper's where patches suffice, else more."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codegen.lanes import lane_text
from codegen.source import generated_c
from studies.research.plain.load import GRAVITY
from studies.research.plain.motion import angular_rates, rotation
from symbolic.array import Array
from symbolic.contact.load import RESIDUAL_TOLERANCE, load_function
from symbolic.records import Workcell
from tests.symbolic.cells import call, with_contacts, with_payload, with_task
from tests.symbolic.contact.joint_oracle import Case, least_wrenches
from tests.symbolic.contact.test_payload_load import (
    at_rest,
    load,
    random_cell,
    random_motion,
    ten_kilogram_cell,
)


def joint(cell: Workcell) -> Workcell:
    return with_task(cell, allocation="joint")


def needed(cell: Workcell, pose: Array, rate: Array, second: Array) -> tuple[Array, Array, Array]:
    """Force and moment about the centre of mass that a motion asks for, and the latter's place
    from the box centre; (3,) each, world frame."""
    R, payload = rotation(pose[3:]), cell.payload
    omega, alpha = angular_rates(pose[3:], rate[3:], second[3:])
    c = R @ payload.centre_of_mass
    acceleration = second[:3] + np.cross(alpha, c) + np.cross(omega, np.cross(omega, c))
    inertia = R @ payload.inertia @ R.T
    moment = inertia @ alpha + np.cross(omega, inertia @ omega)
    return payload.mass * (acceleration - GRAVITY), moment, c


def box_case(cell: Workcell, motion: tuple[Array, Array, Array]) -> Case:
    """What a motion asks of the contacts, in the axes of the first pad."""
    force, moment, _ = needed(cell, *motion)
    R_box_pad = cell.contacts[0].T_box_pad[:3, :3]
    to_pad = (rotation(motion[0][3:]) @ R_box_pad).T
    points = np.array([contact.T_box_pad[:3, 3] for contact in cell.contacts])
    return Case(
        to_pad @ force,
        to_pad @ moment,
        (points - cell.payload.centre_of_mass) @ R_box_pad,
        np.array([contact.friction for contact in cell.contacts]),
        np.array([contact.patch_radius for contact in cell.contacts]),
    )


@given(seed=st.integers(0, 2**31), radius=st.floats(0.002, 0.2))
def test_is_the_papers_where_the_patches_suffice_and_costs_more_where_not(
    seed: int, radius: float
) -> None:
    rng = np.random.default_rng(seed)
    cell = with_contacts(random_cell(rng), patch_radius=(radius, radius))
    motion = random_motion(rng)
    paper, ours = load(cell, *motion), load(joint(cell), *motion)
    force = paper["contact_force"].reshape(2, 3)
    carried = np.linalg.norm(paper["moment_residual"]) <= (
        RESIDUAL_TOLERANCE * 0.4 * np.linalg.norm(force.sum(axis=0))
    )
    if carried and paper["pressure_shift"].max() <= radius:
        for name, value in paper.items():
            np.testing.assert_array_equal(ours[name], value, err_msg=name)
    else:
        effort = [float(np.sum(found["contact_force"] ** 2)) for found in (paper, ours)]
        assert effort[1] >= (1.0 - 1e-12) * effort[0]
        assert ours["pressure_shift"].max() <= radius


@given(seed=st.integers(0, 2**31))
def test_wrenches_balance_the_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cell = with_contacts(joint(random_cell(rng)), patch_radius=(0.01, 0.02))
    motion = random_motion(rng)
    result = load(cell, *motion)
    force, moment, c = needed(cell, *motion)
    wrenches = np.array([result["wrench_1"], result["wrench_2"]])
    arms = [rotation(motion[0][3:]) @ contact.T_box_pad[:3, 3] - c for contact in cell.contacts]
    np.testing.assert_allclose(wrenches[:, :3].sum(axis=0), force, atol=1e-8)
    exerted = wrenches[:, 3:].sum(axis=0) + np.cross(arms, wrenches[:, :3]).sum(axis=0)
    np.testing.assert_allclose(exerted, moment, atol=1e-8)
    np.testing.assert_allclose(result["moment_residual"], 0.0, atol=1e-8)
    np.testing.assert_array_equal(result["contact_force"], wrenches[:, :3].ravel())


def test_agrees_with_clarabel() -> None:
    rng = np.random.default_rng(5)
    beyond = 0
    for _ in range(40):
        cell = with_contacts(random_cell(rng), patch_radius=(0.008, 0.015))
        motion = random_motion(rng)
        force = load(joint(cell), *motion)["contact_force"]
        expected = least_wrenches(box_case(cell, motion))[:, :3]
        assert float(force @ force) == pytest.approx(float(np.sum(expected**2)), rel=1e-6)
        shift = load(cell, *motion)["pressure_shift"]
        beyond += bool((shift > [0.008, 0.015]).any())
    assert beyond >= 20


@pytest.mark.parametrize(("radius", "force"), [(0.02, 102.2), (0.01, 111.5), (0.005, 116.8)])
def test_an_offset_towards_a_pad_is_carried_by_pressing_harder(radius: float, force: float) -> None:
    """The known cases of the allocation, as a cell."""
    offset = np.array([0.0, 0.05, 0.0])
    cell = with_payload(ten_kilogram_cell(0.5), centre_of_mass=offset)
    cell = with_contacts(cell, patch_radius=(radius, radius))
    assert at_rest(cell)["pressure_shift"].max() > radius
    result = at_rest(joint(cell))
    np.testing.assert_allclose(result["normal_force"], force, atol=0.05)
    np.testing.assert_allclose(result["pressure_shift"], radius, rtol=1e-6)


def test_a_moment_that_no_shift_carries_is_carried_by_torsion() -> None:
    """In free fall nothing is tangential, so that the paper leaves a moment about the normal."""
    cell = with_payload(ten_kilogram_cell(0.5), inertia=np.eye(3))
    motion = np.zeros(6), np.zeros(6), np.array([0.0, 0.0, -9.81, 0.0, 1.0, 0.0])
    assert np.linalg.norm(load(cell, *motion)["moment_residual"]) == pytest.approx(1.0)
    result = load(joint(cell), *motion)
    np.testing.assert_allclose(result["moment_residual"], 0.0, atol=1e-8)
    # Both rims: 2 mu N r = 1 N m.
    np.testing.assert_allclose(result["normal_force"], 1.0 / (2 * 0.5 * 0.0315), rtol=1e-6)


def test_derivatives_pass_through_the_choice() -> None:
    cell = with_contacts(joint(ten_kilogram_cell()), patch_radius=(0.01, 0.01))
    cell = with_payload(cell, centre_of_mass=np.array([0.0, 0.05, 0.0]))
    function = load_function(cell)
    jacobian = function.factory("jacobian", function.name_in(), ["jac:normal_force:second_rate"])
    motion = np.zeros(6), np.zeros(6), np.array([0.3, 0.2, 0.1, 0.0, 0.0, 0.0])
    found = np.array(jacobian(*motion))
    for k, step in enumerate(1e-4 * np.eye(6)):
        ends = [
            call(function, motion[0], motion[1], motion[2] + sign * step)["normal_force"]
            for sign in (1.0, -1.0)
        ]
        np.testing.assert_allclose(found[:, k], (ends[0] - ends[1]) / 2e-4, atol=1e-4)


def test_runs_in_lanes() -> None:
    """A batch is evaluated side by side only if every construct of the function is known there."""
    function = load_function(joint(ten_kilogram_cell()))
    assert lane_text(generated_c([function]), "joint") is not None
