"""A candidate as the search sees it: under the task's own time law, on the task's samples."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from codegen.function import NumericFunction
from hybrid_opt.carry import ArmMotion, Carry, Judgement
from symbolic.array import Array
from symbolic.path.spline import sample_basis
from symbolic.records import Workcell
from symbolic.records.task import waypoints_of

STANDSTILL = 1e-30
"""Squared length of a path's tangent below which it counts as none [(m, rad per u)^2]."""


def carry_under_time_law(
    workcell: Workcell,
    functions: Mapping[str, NumericFunction],
    x: Array,
    outputs: Mapping[str, Array],
    judgement: Judgement | None = None,
) -> Carry:
    """The carry of one candidate from its outputs.

    Args:
        functions: with both arms' `inverse_dynamics_i`, see `symbolic.functions`.
        x: (n_var,) decision vector.
        outputs: of the compiled candidate function for x, without an axis over candidates.
        judgement: the evaluator's verdict, where there is one.
    """
    time = outputs["time"].reshape(-1)
    arms = [_arm(workcell, functions[f"inverse_dynamics_{arm}"], x, outputs, arm) for arm in (1, 2)]
    return Carry(
        workcell=workcell,
        x=np.array(x),
        timing=workcell.task.time_law,
        parameter=np.linspace(0.0, 1.0, len(time)),
        time=time,
        pose=outputs["pose"],
        rate=outputs["rate"],
        second_rate=outputs["second_rate"],
        angular_velocity=outputs["angular_velocity"],
        angular_acceleration=outputs["angular_acceleration"],
        normal_force=outputs["normal_force"],
        tangential_force=outputs["tangential_force"],
        contact_force=outputs["contact_force"].reshape(-1, 2, 3),
        pressure_shift=outputs["pressure_shift"],
        point_moment_residual=outputs["point_moment_residual"],
        moment_residual=outputs["moment_residual"],
        arms=(arms[0], arms[1]),
        judgement=judgement,
    )


def _arm(
    workcell: Workcell,
    inverse_dynamics: NumericFunction,
    x: Array,
    outputs: Mapping[str, Array],
    arm: int,
) -> ArmMotion:
    q = np.ascontiguousarray(outputs[f"q_{arm}"])
    q_rate, q_second = _joint_rates(workcell, x, q, outputs)
    (own_torque,) = inverse_dynamics.batch(q, q_rate, q_second).values()
    return ArmMotion(q, q_rate, q_second, outputs[f"joint_torque_{arm}"], own_torque)


def _joint_rates(
    workcell: Workcell, x: Array, q: Array, outputs: Mapping[str, Array]
) -> tuple[Array, Array]:
    """First and second time derivatives of joints q (n, n_joints).

    Under 'constant' they are second-order finite differences on the law's times, as the paper
    takes the box's (one-sided at the ends). Under 'ramped' the law's own u' and u'' drive the
    joints' finite differences over u, so that an arm rests wherever the box does.
    """
    if workcell.task.time_law == "constant":
        time = outputs["time"].reshape(-1)
        rate = np.gradient(q, time, axis=0, edge_order=2)
        return rate, np.gradient(rate, time, axis=0, edge_order=2)
    basis = sample_basis(workcell.task)
    waypoints = waypoints_of(workcell.task, x)
    tangent, curvature = basis.first @ waypoints, basis.second @ waypoints
    length = np.maximum((tangent**2).sum(axis=1), STANDSTILL)
    speed = ((outputs["rate"] * tangent).sum(axis=1) / length)[:, None]
    bend = outputs["second_rate"] - curvature * speed**2
    acceleration = ((bend * tangent).sum(axis=1) / length)[:, None]
    first = np.gradient(q, basis.parameter, axis=0, edge_order=2)
    second = np.gradient(first, basis.parameter, axis=0, edge_order=2)
    return first * speed, second * speed**2 + first * acceleration
