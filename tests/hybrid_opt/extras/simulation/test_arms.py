"""Whole cells in the simulator: against closed forms at rest, and against the planner's torques."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from tests.refusals import refused

pytest.importorskip("mujoco")

import mujoco

from hybrid_opt.extras.simulation.arms import CellSimulation
from hybrid_opt.extras.simulation.box import workcell_of_case
from hybrid_opt.extras.simulation.reference import (
    BoxJob,
    Control,
    JointMotion,
    Reference,
    carry_reference,
    job_reference,
    press_torque,
    with_tracking_error,
)
from hybrid_opt.extras.simulation.scene import ArmSettings, joint_names
from hybrid_opt.robust.cases import nominal_case
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.timing.solve import time_path
from studies.research.plain.arm import PlainArm
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell
from tests.hybrid_opt.cells import shipped
from tests.odd_cells import machine_on_lift, rack_on_rail
from tests.symbolic.cells import hand_cell, start_posture

WEIGHT = 98.1
LEAST = WEIGHT / 2.0
"""Normal force of either pad that holds the hand-written cell's box at rest [N]."""


def standing(
    cell: Workcell, force: float = LEAST, seconds: float = 0.4, carries: bool = True
) -> Reference:
    """The hand-written cell's box held still where the task begins.

    Args:
        carries: whether the box's weight is fed forward.
    """
    posture = start_posture(cell)
    q = np.tile(np.concatenate(posture), (2, 1))
    still = np.zeros_like(q)
    motion = JointMotion(np.array([0.0, seconds]), q, still, still)
    job = BoxJob(cell.task.waypoints[0].lower, None, (0.2, seconds), stands=0.1)
    reference = job_reference(cell, motion, np.full((2, 2), force), job)
    if not carries:
        return reference
    lifting = []
    for robot, contact, joints in zip(cell.robots, cell.contacts, posture, strict=True):
        arm = PlainArm(robot, contact)
        to_pad = arm.place(joints).rotation @ robot.T_flange_pad[:3, 3]
        up = np.array([0.0, 0.0, WEIGHT / 2.0])  # the base stands upright
        lifting.append(arm.jacobian(joints).T @ np.concatenate([up, np.cross(to_pad, up)]))
    return replace(reference, effort=reference.effort + np.concatenate(lifting))


def placed(witness: CellSimulation, q: Array) -> Any:
    """The simulator's data where both arms' joints are at q (all joints,) [rad]."""
    data = mujoco.MjData(witness.model)
    for name, value in zip(joint_names(witness.workcell), q, strict=True):
        data.joint(name).qpos = value
    mujoco.mj_forward(witness.model, data)
    return data


def pad_jacobian(
    cell: Workcell, witness: CellSimulation, q: Array, pad: int, axis: int = 2
) -> Array:
    """(all joints,) of the pad's motion along one of its axes."""
    data = placed(witness, q)
    linear, angular = np.zeros((2, 3, witness.model.nv))
    site = witness.model.site(f"pad_{pad + 1}").id
    mujoco.mj_jacSite(witness.model, data, linear, angular, site)
    columns = [int(witness.model.joint(name).dofadr[0]) for name in joint_names(cell)]
    along: Array = data.site_xmat[site].reshape(3, 3)[:, axis] @ linear[:, columns]
    return along


def test_pads_press_with_the_torques_of_the_simulators_jacobian() -> None:
    cell, rng = hand_cell(), np.random.default_rng(1)
    witness = CellSimulation(cell)
    for q in np.concatenate(start_posture(cell)) + rng.uniform(-0.5, 0.5, (5, 12)):
        both = sum(pad_jacobian(cell, witness, q, pad) for pad in (0, 1))
        np.testing.assert_allclose(press_torque(cell, q[None])[0], both, atol=1e-12)


def test_pads_are_where_the_arms_hold_the_box() -> None:
    cell = hand_cell()
    posture = start_posture(cell)
    data = placed(CellSimulation(cell), np.concatenate(posture))
    for i, (robot, contact) in enumerate(zip(cell.robots, cell.contacts, strict=True)):
        in_root = PlainArm(robot, contact).place(posture[i]).homogeneous
        T_world_flange = robot.T_world_base @ in_root
        T_world_pad = T_world_flange @ robot.T_flange_pad
        np.testing.assert_allclose(data.site(f"pad_{i + 1}").xpos, T_world_pad[:3, 3], atol=1e-9)


@pytest.mark.parametrize("control", get_args(Control))
def test_a_box_at_rest_slips_below_the_least_force(control: Control) -> None:
    """N = m g / (2 mu), arms and controllers included."""
    cell = hand_cell()
    witness, reference = CellSimulation(cell), standing(cell, seconds=1.0)
    assert not witness.simulate(reference, control, 0.97).holds
    outcome = witness.simulate(reference, control, 1.03)
    assert outcome.holds
    assert outcome.arrives
    assert outcome.turn.max() < 1e-4
    np.testing.assert_allclose(outcome.normal_force[-1], 1.03 * LEAST, rtol=0.01)
    assert (outcome.torque_use < 1.0).all()


def test_what_is_fed_forward_holds_the_arms_without_error() -> None:
    """Inverse dynamics of Pinocchio against MuJoCo's forward dynamics; without its weight fed
    forward, the box gives way at the stiffness."""
    cell = hand_cell()
    errors = [
        np.abs(CellSimulation(cell).simulate(reference, "impedance").tracking_error[-1]).max()
        for reference in (
            standing(cell, 0.0, 0.1, carries=False),
            standing(cell, 2.0 * LEAST, 1.0),
            standing(cell, 2.0 * LEAST, 1.0, carries=False),
        )
    ]
    assert errors[0] < 5e-5
    assert errors[1] < 0.05 * errors[2]
    assert errors[2] > 2e-4


def test_a_softer_arm_sags_more() -> None:
    cell = hand_cell()
    found = [
        CellSimulation(cell, ArmSettings(stiffness=stiffness))
        .simulate(standing(cell, 2.0 * LEAST, 1.0, carries=False), "impedance")
        .tracking_error[-1]
        for stiffness in (25.0, 50.0)
    ]
    sags = [np.abs(error).max() for error in found]
    assert sags[0] == pytest.approx(2.0 * sags[1], rel=0.05)


def test_force_control_takes_what_a_wrong_reference_adds() -> None:
    """Arms that are told to stand 0.5 mm too near press harder by position, not by force."""
    cell = hand_cell()
    reference = standing(cell, 1.5 * LEAST, 1.0)
    q = reference.motion.q.copy()
    for i, (robot, contact) in enumerate(zip(cell.robots, cell.contacts, strict=True)):
        arm, part = PlainArm(robot, contact), slice(6 * i, 6 * i + 6)
        pose = reference.job.start.copy()
        pose[1] += -5e-4 if i == 0 else 5e-4
        target = arm.flange_target(pose)
        for _ in range(5):
            q[:, part] = arm.newton_step(q[0, part], target)
    nearer = replace(reference, motion=replace(reference.motion, q=q))
    witness = CellSimulation(cell)
    excess = {
        control: witness.simulate(nearer, control).normal_force[-1].mean() / (1.5 * LEAST) - 1.0
        for control in get_args(Control)
    }
    assert excess["impedance"] > 0.05
    assert max(abs(excess["leader"]), abs(excess["both"])) < 0.01


def test_what_pushes_the_box_along_the_normal_moves_it_by_the_weak_springs_alone() -> None:
    """3 N against two springs of 2 N/mm, however long both arms control their forces."""
    cell = hand_cell()
    witness = CellSimulation(cell, disturbance=(0.0, 0.3, 0.0))
    outcome = witness.simulate(standing(cell, 1.5 * LEAST, 2.0), "both")
    assert outcome.holds
    moved = outcome.box_position[-1, 1] - outcome.box_position[0, 1]
    assert moved == pytest.approx(-0.3 * 10.0 / (2.0 * witness.settings.drift_stiffness), rel=0.2)


def test_the_simulated_case_differs_from_what_the_arms_were_told() -> None:
    cell = hand_cell()
    reference = standing(cell, 1.1 * LEAST)
    case = nominal_case(cell)
    case[0:2] *= 0.85
    assert not CellSimulation(workcell_of_case(cell, case)).simulate(reference).holds
    assert not CellSimulation(cell, disturbance=(0.0, 0.0, 2.0)).simulate(reference).holds
    case = nominal_case(cell)
    case[11:15] = [0.004, 0.0, 0.004, 0.0]
    outcome = CellSimulation(workcell_of_case(cell, case)).simulate(reference)
    assert outcome.holds
    moved = cell.contacts[0].T_box_pad[:3, :2] @ [0.004, 0.0]
    start = reference.job.start[:3]
    np.testing.assert_allclose(start - outcome.box_position[0], moved, atol=1e-12)


def test_tracking_errors_begin_at_zero_and_stay_small() -> None:
    reference = standing(hand_cell(), seconds=5.0)
    motion = reference.motion
    time = np.linspace(0.0, 5.0, 1001)
    q = np.tile(motion.q[0], (len(time), 1))
    still = JointMotion(time, q, 0.0 * q, 0.0 * q)
    longer = replace(reference, motion=still, effort=0.0 * q)
    off = with_tracking_error(longer, 1e-3, np.random.default_rng(1)).motion
    np.testing.assert_array_equal(off.q[0], q[0])
    assert 2e-4 < np.abs(off.q - q).max() <= 1e-3
    np.testing.assert_allclose(np.gradient(off.q, time, axis=0)[1:-1], off.q_rate[1:-1], atol=2e-4)


def test_arms_that_push_against_one_another_do_so_along_the_faces() -> None:
    """By the simulator's Jacobians: the forces of both arms cancel, and press nowhere."""
    cell = hand_cell()
    witness, reference = CellSimulation(cell), standing(cell)
    pushed = with_tracking_error(reference, 0.0, np.random.default_rng(1), 7.0)
    more = (pushed.effort - reference.effort)[0]
    forces = []
    q = reference.motion.q[0]
    for i, contact in enumerate(cell.contacts):
        jacobian = np.stack([pad_jacobian(cell, witness, q, i, axis) for axis in range(3)])
        part = slice(6 * i, 6 * i + 6)
        force, rest = np.linalg.lstsq(jacobian[:, part].T, more[part], rcond=None)[:2]
        assert rest.max() < 1e-18
        assert np.linalg.norm(force) == pytest.approx(7.0)
        assert force[2] == pytest.approx(0.0, abs=1e-9)
        forces.append(contact.T_box_pad[:3, :3] @ force)
    np.testing.assert_allclose(forces[0], -forces[1], atol=1e-9)


def test_a_carrys_references_are_the_planners_torques_but_for_moments() -> None:
    """The torques of the timing's compiled functions without what the wrenches' moments take of
    them, and what pressing harder adds."""
    cell = shipped("rack")
    carry = time_path(cell.timing_model, cell.initial, TimingLimits()).carry
    assert carry is not None
    planned = carry_reference(cell, carry)
    load = cell.timing_model.uncertain_load(carry, np.ones(2), np.zeros(3))
    moments = np.stack([load["wrench_1"][:, 3:], load["wrench_2"][:, 3:]])
    by_moment = cell.timing_model.wrench_torque(carry.q, carry.pose)[..., 3:]
    each = (by_moment[:, :6], by_moment[:, 6:])
    taken = [np.einsum("njk,nk->nj", part, own) for part, own in zip(each, moments, strict=True)]
    assert np.abs(taken).max() > 0.1
    fed = planned.effort[2:] + np.concatenate(taken, axis=1)
    np.testing.assert_allclose(fed, carry.torque, atol=1e-9)
    np.testing.assert_allclose(planned.normal_force[2:], carry.normal_force, atol=1e-9)
    harder = carry_reference(cell, carry, carry.normal_force[:, 0] + 7.0, leader=1)
    assert harder.leader == 1
    np.testing.assert_allclose(harder.normal_force[2:] - carry.normal_force, 7.0, atol=1e-9)
    more = harder.effort[2:] - planned.effort[2:]
    np.testing.assert_allclose(more, 7.0 * planned.press_torque[2:], atol=1e-9)
    # At rest before, with what the beginning will need.
    assert (planned.normal_force[0] >= carry.normal_force[0] - 1e-9).all()
    with refused(SettingsError, "shape"):
        carry_reference(cell, carry, np.ones(3))
    with refused(SettingsError, "not-at-rest"):
        carry_reference(cell, replace(carry, rate=np.ones_like(carry.rate)))


def test_joints_that_slide_do_so_and_both_arms_ride_on_one_lift(tmp_path: Path) -> None:
    witness = CellSimulation(rack_on_rail(tmp_path, 0.1))
    kinds = [int(witness.model.joint(name).type[0]) for name in joint_names(witness.workcell)]
    slides, turns = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    assert kinds == [slides] + 12 * [turns]
    lift = CellSimulation(machine_on_lift(tmp_path, 0.2, free=True))
    data = mujoco.MjData(lift.model)
    first, second = (int(lift.model.joint(f"joint_{i}_1").dofadr[0]) for i in (1, 2))
    data.qfrc_applied[first] = 500.0  # of the first copy alone
    for _ in range(50):  # in which the other alone would fall by 12 mm
        mujoco.mj_step(lift.model, data)
    moved = [data.qpos[int(lift.model.joint(f"joint_{i}_1").qposadr[0])] for i in (1, 2)]
    assert abs(moved[0] - moved[1]) < 1e-3
    assert abs(data.qvel[first] - data.qvel[second]) < 0.02


def test_misuse_is_told() -> None:
    cell = hand_cell()
    reference = standing(cell)
    force = reference.normal_force
    backwards = replace(reference.motion, time=reference.motion.time[::-1])
    with refused(SettingsError, "times-decrease"):
        job_reference(cell, backwards, force, reference.job)
    with refused(SettingsError, "shape", "(2, 3)"):
        job_reference(cell, reference.motion, force, reference.job, np.zeros((2, 3)))
    with refused(SettingsError, "shape"):
        job_reference(cell, reference.motion, np.zeros((3, 2)), reference.job)
    with refused(SettingsError, "control-period"):
        ArmSettings(control_period=7e-4)
    with refused(SettingsError, "time-step"):
        ArmSettings(time_step=0.01)
