"""The packed limits against the geometry and the loads they are made from."""

from __future__ import annotations

from functools import cache

import numpy as np

from symbolic.array import Array
from symbolic.contact.load import LOAD_OUTPUTS, load_function
from symbolic.limits import (
    PATH_OUTPUTS,
    limit_layout,
    path_function,
    ratio_functions,
    sample_limits_function,
)
from symbolic.path_motion import path_motion_function
from symbolic.records import Workcell
from tests.symbolic.cells import call, hand_cell, hand_model, with_contacts, with_payload

SAMPLES = 21


def uneven() -> Workcell:
    """The hand cell with nothing symmetric about its contacts and its payload."""
    cell = with_payload(hand_cell(), centre_of_mass=np.array([0.004, -0.01, 0.02]))
    return with_contacts(cell, friction=(0.9, 1.1), patch_radius=(0.02, 0.04))


@cache
def outputs() -> tuple[dict[str, Array], dict[str, Array]]:
    """Packed limits and the path's motion of a tilted trajectory."""
    model = hand_model(uneven())
    rng = np.random.default_rng(2)
    x = model.workcell.task.initial.reshape(-1) + 0.05 * rng.uniform(-1.0, 1.0, 18)
    path = call(path_function(model, SAMPLES), x)
    rows = sample_limits_function(model).map(SAMPLES)(*[path[name].T for name in PATH_OUTPUTS])
    motion = call(path_motion_function(model, SAMPLES), x)
    np.testing.assert_allclose(path["q_1"], motion["q_1"], atol=1e-12)
    return {"limits": np.array(rows.T)}, motion


def block(name: str) -> Array:
    layout = limit_layout(uneven())
    start = layout.offsets[name]
    return outputs()[0]["limits"][:, start : start + layout.sizes[name]]


def both(name: str) -> Array:
    motion = outputs()[1]
    return np.concatenate([motion[f"{name}_{i}"] for i in (1, 2)], axis=1)


def limits_of(name: str) -> Array:
    return np.concatenate([getattr(robot, name) for robot in uneven().robots])


def test_speeds_and_accelerations_are_the_paths_over_their_limits() -> None:
    motion, cell = outputs()[1], uneven()
    speed = np.linalg.norm(motion["pose_first"][:, :3], axis=1)
    turn = np.linalg.norm(motion["angular_first"], axis=1)
    np.testing.assert_allclose(
        block("speed"),
        np.column_stack(
            [
                both("q_first") / limits_of("velocity_max"),
                speed / cell.payload.velocity_max,
                turn / cell.payload.angular_velocity_max,
                speed / cell.task.reference_speed,
                turn / cell.task.reference_angular_speed,
            ]
        ),
        atol=1e-10,
    )
    np.testing.assert_allclose(
        block("acceleration"),
        np.hstack([both("q_first"), both("q_second")]) / np.tile(limits_of("acceleration_max"), 2),
        atol=1e-9,
    )
    linear = np.hstack([motion["pose_first"][:, :3], motion["pose_second"][:, :3]])
    angular = np.hstack([motion["angular_first"], motion["angular_second"]])
    cones = np.hstack([linear / cell.payload.acceleration_max, angular / 10.0])
    np.testing.assert_allclose(block("cone"), cones, atol=1e-10)


def test_torques_and_shifts_are_those_of_the_load_and_the_arms() -> None:
    """The other route: contact forces in the world frame, then each arm's own torques."""
    motion, cell = outputs()[1], uneven()
    values, slopes = ratio_functions(cell)
    rng = np.random.default_rng(3)
    load = load_function(cell)
    packed = np.hstack([block(name) for name in ("force", "moment", "torque", "wrench")])
    for k in range(SAMPLES):
        a, w = rng.normal(scale=0.3), rng.uniform(0.0, 0.4)
        found = np.array(values(packed[k], a, w)).reshape(-1)
        rate = motion["pose_first"][k] * np.sqrt(w)
        second = motion["pose_second"][k] * w + motion["pose_first"][k] * a
        loads = dict(zip(LOAD_OUTPUTS, load(motion["pose"][k], rate, second), strict=True))
        torques = []
        for i in (1, 2):
            wrench = motion[f"wrench_torque_{i}"][k].reshape(6, 6)
            own = motion[f"torque_by_acceleration_{i}"][k] * a
            own = own + motion[f"torque_by_speed_{i}"][k] * w + motion[f"torque_at_rest_{i}"][k]
            torques.append(own + wrench @ np.array(loads[f"wrench_{i}"]).reshape(-1))
        shifts = np.array(loads["pressure_shift"]).reshape(-1) / [0.02, 0.04]
        expected = np.concatenate([np.concatenate(torques) / limits_of("torque_max"), shifts])
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8)

        same, by_a, by_w = (np.array(part).reshape(-1) for part in slopes(packed[k], a, w))
        np.testing.assert_allclose(same, found, atol=1e-14)
        step = 1e-6
        for slope, da, dw in ((by_a, step, 0.0), (by_w, 0.0, step)):
            ahead = np.array(values(packed[k], a + da, w + dw)).reshape(-1)
            behind = np.array(values(packed[k], a - da, w - dw)).reshape(-1)
            np.testing.assert_allclose(slope, (ahead - behind) / (2.0 * step), atol=2e-5)
