"""The load of a sample held by other pads: balance, clarabel, lanes, derivatives."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from codegen.lanes import lane_text
from codegen.source import generated_c
from studies.research.plain.motion import rotation
from symbolic.array import Array
from symbolic.contact.grasp import Grasp, grasp_wrenches
from symbolic.contact.load import load_function
from symbolic.records import Workcell
from tests.symbolic.cells import call, hand_cell, with_task
from tests.symbolic.contact.grasp_oracle import least_wrenches, random_grasp
from tests.symbolic.contact.test_joint_load import needed
from tests.symbolic.contact.test_payload_load import random_motion

FORKS = (("round", "rectangle"), ("rectangle", "round", "rectangle"))


def held_cell(rng: np.random.Generator, kinds: tuple[str, ...]) -> Workcell:
    return with_task(random_grasp(rng, hand_cell(), kinds), allocation="joint")


def box_load(cell: Workcell, motion: tuple[Array, Array, Array]) -> Array:
    """(6,) force and moment about the box frame's origin that a motion asks for, box axes."""
    force, moment, c = needed(cell, *motion)
    R = rotation(motion[0][3:])
    return np.concatenate([R.T @ force, R.T @ (moment + np.cross(c, force))])


@pytest.mark.parametrize("kinds", FORKS)
def test_agrees_with_clarabel_and_balances_the_motion(kinds: tuple[str, ...]) -> None:
    rng = np.random.default_rng(7)
    for _ in range(3):
        cell, motion = held_cell(rng, kinds), random_motion(rng)
        found = call(load_function(cell), *motion)
        asked = box_load(cell, motion)
        expected = least_wrenches(cell.pads, asked)
        own = [np.array(cell.pad_robots) == i for i in (0, 1)]
        normal = [expected[pads, 2].sum() for pads in own]
        tangential = [np.linalg.norm(expected[pads, :2], axis=1).sum() for pads in own]
        size = np.abs(expected[:, :3]).max()
        np.testing.assert_allclose(found["normal_force"], normal, atol=5e-3 * size)
        np.testing.assert_allclose(found["tangential_force"], tangential, atol=5e-3 * size)
        friction = np.array([contact.friction for contact in cell.contacts])
        assert (found["tangential_force"] <= friction * found["normal_force"]).all()
        # Each robot's wrench about its first pad.
        R = rotation(motion[0][3:])
        total = np.zeros(6)
        for i, contact in enumerate(cell.contacts):
            wrench = found[f"wrench_{i + 1}"]
            force, turning = R.T @ wrench[:3], R.T @ wrench[3:]
            total += np.concatenate([force, turning + np.cross(contact.T_box_pad[:3, 3], force)])
        np.testing.assert_allclose(total, asked, atol=1e-8 * size)
        np.testing.assert_allclose(found["moment_residual"], 0.0, atol=1e-8 * size)
        forces = np.concatenate([found["wrench_1"][:3], found["wrench_2"][:3]])
        np.testing.assert_allclose(found["contact_force"], forces, atol=1e-12 * size)
        radii = [contact.patch_radius for contact in cell.contacts]
        if len(cell.pads) == 2:
            assert (found["pressure_shift"] <= radii).all()


def test_facing_pads_have_the_forces_of_the_joint_allocation() -> None:
    """The general program, asked about two round pads, against the one made for them."""
    rng = np.random.default_rng(3)
    cell = with_task(hand_cell(), allocation="joint")
    motion = random_motion(rng)
    load, friction = ca.MX.sym("load", 6), ca.MX.sym("friction", 2)
    general = ca.Function("grasp", [load, friction], [grasp_wrenches(Grasp(cell), load, friction)])
    wrenches = np.array(general(box_load(cell, motion), [1.0, 1.0])).reshape(2, 6)
    found = call(load_function(cell), *motion)
    np.testing.assert_allclose(wrenches[:, 0], found["normal_force"], rtol=1e-4)


def test_runs_in_lanes() -> None:
    """A batch is evaluated side by side only if every construct of the function is known there."""
    rng = np.random.default_rng(1)
    function = load_function(held_cell(rng, ("round", "rectangle")))
    assert lane_text(generated_c([function]), "grasp") is not None


def test_derivatives_by_the_motion() -> None:
    rng = np.random.default_rng(5)
    function = load_function(held_cell(rng, ("rectangle", "rectangle")))
    jacobian = function.factory("jacobian", function.name_in(), ["jac:normal_force:second_rate"])
    pose, rate, second = random_motion(rng)
    found = np.array(jacobian(pose, rate, second))
    scale = max(1.0, float(np.abs(found).max()))
    for k, step in enumerate(1e-4 * np.eye(6)):
        ends = [
            call(function, pose, rate, second + sign * step)["normal_force"] for sign in (1.0, -1.0)
        ]
        np.testing.assert_allclose(found[:, k], (ends[0] - ends[1]) / 2e-4, atol=1e-3 * scale)


def test_opposite_rectangles_keep_the_papers_forces_where_they_suffice() -> None:
    """Bit by bit; where a centre of pressure would leave its rectangle they press harder."""
    rng = np.random.default_rng(2)
    paper_cell, kept, pressed = hand_cell(), 0, 0
    for _ in range(12):
        half_x, half_y = (float(half) for half in rng.uniform(0.005, 0.15, 2))
        diagonal = float(np.hypot(half_x, half_y))
        first, second = (
            replace(contact, patch_radius=diagonal, half_sides=(half_x, half_y))
            for contact in paper_cell.contacts
        )
        cell = with_task(replace(paper_cell, contacts=(first, second)), allocation="joint")
        motion = random_motion(rng)
        paper, ours = (call(load_function(each), *motion) for each in (paper_cell, cell))
        R = rotation(motion[0][3:])
        shifts = paper["shift_vector"].reshape(2, 3) @ R
        local = [
            shift @ contact.T_box_pad[:3, :2]
            for shift, contact in zip(shifts, cell.contacts, strict=True)
        ]
        if (np.abs(local) <= [half_x, half_y]).all():
            kept += 1
            for name, value in paper.items():
                np.testing.assert_array_equal(ours[name], value, err_msg=name)
        else:
            pressed += 1
            efforts = [float(np.sum(each["contact_force"] ** 2)) for each in (paper, ours)]
            assert efforts[1] >= efforts[0]
    assert min(kept, pressed) >= 2
