"""Logs of others, made up in both of their forms: what is read is what was planted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from studies.research.logged_carries import CROSSTALK, STATED_FRICTION, TOOL, compared, read
from studies.research.real_runs import main
from symbolic.array import Array
from tests.refusals import ended_by

MASS, SQUEEZE, OPPOSED, LENGTH, SLIDE = 2.4, 60.0, 12.0, 0.28, 0.03
GRASPS = np.array([[0.4, -LENGTH / 2.0, 0.1], [0.4, LENGTH / 2.0, 0.1]])
TURN, RISE, DONE = 0.5, 0.2, 9.0
OFFSET = np.array([1.0, -2.0, 3.0])

QP = "QP/logs/weight/pick_QP_vention_2.4kg_20251209-143108.npz"
PID = "PID_ff/logs/weight/pick_PID_ff_vention_2.4kg_20251209-171357"


@dataclass(frozen=True)
class Arm:
    """What one arm does: positions, turns about the vertical and forces on it, in the world."""

    point: Array
    yaw: Array
    force: Array


def upright(angles: Array) -> Rotation:
    """Turns (n,) about the vertical [rad]."""
    return Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0]))


def rise(time: Array, order: int = 0) -> Array:
    """Height of the pads above the grasp, a polynomial of fifth order from 3 to 7 s."""
    s = np.clip((time - 3.0) / 4.0, 0.0, 1.0)
    curve = np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
    return np.asarray(RISE * curve.deriv(order)(s) / 4.0**order if order else RISE * curve(s))


def arms(time: Array) -> list[Arm]:
    """A box that is gripped, lifted and turned, by two arms that work against one another."""
    gripped = (time > 0.8).astype(float)
    yaw = TURN / RISE * rise(time)
    turn = upright(yaw)
    lifted = np.column_stack([np.zeros((len(time), 2)), rise(time)])
    # The table carries the box before.
    weight = MASS * (9.81 + rise(time, 2)) * (rise(time) > 1e-4)
    found = []
    for i, grasp in enumerate(GRASPS):
        inwards = 1.0 - 2.0 * i
        force = np.zeros((len(time), 3))
        force[:, 0] = inwards * OPPOSED * gripped
        force[:, 1] = -inwards * SQUEEZE * gripped
        force[:, 2] = CROSSTALK * SQUEEZE * gripped - weight / 2.0
        centre = np.array([0.4, 0.0, 0.1])
        point = centre + lifted + turn.apply(grasp - centre)
        noise = np.random.default_rng(i).normal(size=force.shape) * 0.01
        found.append(Arm(point, yaw, turn.apply(force + OFFSET + noise)))
    return found


def markers(time: Array) -> tuple[Array, Array]:
    """Of the box, which slides down while it is carried; one sample in fifty is nonsense."""
    slid = SLIDE * np.clip((time - 6.0) / 2.0, 0.0, 1.0)
    position = np.column_stack([np.full_like(time, 0.4), np.zeros_like(time), 0.11 + rise(time)])
    position[:, 2] -= slid
    position[25::50] = [0.64, 0.5, 0.3]
    turn = upright(TURN / RISE * rise(time) + 1.0)
    return position, turn.as_matrix()


def of_base(yaw: float, turns: Array) -> tuple[Rotation, Array]:
    """An arm's base, turned about the vertical, and rotation vectors of a tool that points down."""
    base = Rotation.from_euler("z", yaw)
    down = Rotation.from_euler("xz", [np.pi, 0.3])
    return base, (base.inv() * upright(turns) * base * down).as_rotvec()


def logged(arm: Arm, tool: Array) -> Array:
    """Positions as their controller tells them: it takes a tool away that does not turn."""
    return np.asarray(arm.point - tool + upright(arm.yaw).apply(tool))


def write_one(folder: Path) -> Path:
    """As controller QP logs: both arms along the axes of their bases."""
    time = np.arange(0.0, DONE, 0.02)
    position, rotation = markers(time)
    log = {"t_epoch": 1.7e9 + time, "ref_force": np.full(len(time), SQUEEZE)}
    log |= {"box__L_positions": position, "box__L_rotmats": rotation}
    for i, (side, arm) in enumerate(zip("LR", arms(time), strict=True)):
        base, log[f"rvec_{side}"] = of_base(0.02 + 3.2 * i, arm.yaw)
        origin = np.array([0.1, 0.5, -0.2])
        # The tool is taken away along the axes of the base.
        turned = upright(arm.yaw)
        point = base.inv().apply(arm.point - origin)
        log[f"p_{side}"] = point - TOOL + (base.inv() * turned * base).apply(TOOL)
        log[f"F_{side}_vec"] = base.inv().apply(arm.force)
        for frame, to in (("world", Rotation.identity()), ("base", base.inv())):
            place = GRASPS[i] - (origin if frame == "base" else 0.0)
            log[f"meta__meta__grasping_point_{side}_{frame}"] = to.apply(place)
            log[f"meta__meta__normal_{side}_{frame}"] = to.apply([0.0, 2.0 * i - 1.0, 0.0])
    path = folder / "experiments" / QP
    path.parent.mkdir(parents=True)
    np.savez(path, allow_pickle=False, **log)
    return path


def write_two(folder: Path) -> Path:
    """As the PID controller logs: a file per arm, the second begins later."""
    path = folder / "experiments" / PID
    path.parent.mkdir(parents=True)
    for i, side in enumerate("LR"):
        begin = 0.25 * i
        time = np.arange(0.0, DONE - begin, 0.01)
        arm = arms(time + begin)[i]
        position, rotation = markers(time + begin)
        reference = np.tile([0.0, SQUEEZE, 0.0], (len(time), 1))
        log = {
            "timestamp": time,
            "meta__start_time_epoch": np.array(1.7e9 + begin),
            "force_vector": arm.force,
            "position": logged(arm, TOOL * [1.0, 1.0 - 2.0 * i, 1.0]),
            "rotation": of_base(np.pi * i, arm.yaw)[1],
            "reference_force_vector": reference,
            "box_positions": position,
            "box_rotmats": rotation,
        }
        np.savez(f"{path}_{side}.npz", allow_pickle=False, **log)
    return Path(f"{path}_L.npz")


@pytest.mark.parametrize("write", [write_one, write_two])
def test_what_was_planted_is_read(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    carry = read(write(tmp_path))
    assert carry.run.labels.mass == MASS
    assert carry.run.lost == ()
    distance = np.linalg.norm(np.diff(carry.motion.pads[:, :, :3, 3], axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(distance, LENGTH, atol=1e-5)
    found = compared(carry)
    np.testing.assert_allclose(found.squeeze, SQUEEZE, rtol=1e-3)
    weight = MASS * (9.81 + rise(found.time, 2))
    for k, friction in enumerate(STATED_FRICTION):
        np.testing.assert_allclose(found.need[:, k], weight / 2.0 / friction, rtol=2e-3)
    np.testing.assert_allclose(found.used, np.hypot(weight / 2.0, OPPOSED) / SQUEEZE, rtol=5e-3)
    np.testing.assert_allclose(found.margin, SQUEEZE / found.need[:, 0], rtol=1e-3)
    assert found.slid.max() == pytest.approx(SLIDE, abs=2e-3)
    assert np.degrees(found.lean.max()) < 0.1


def test_every_labelled_run_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_one(tmp_path)
    write_two(tmp_path)
    assert main(["--folder", str(tmp_path), "--markdown"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if "| 2025" in line]
    # The first one's stamp is that of a run that lost its box, later than this one ends.
    assert [row.split(" | ")[1] for row in rows] == ["PID", "QP"]
    assert rows[0].endswith("| 30 | 0 | crept |")
    assert rows[1].endswith("| lost |")


def test_how_to_get_the_logs_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "git -C FOLDER checkout 6699139" in capsys.readouterr().out
    with ended_by("no-logs", tmp_path):
        assert main(["--folder", str(tmp_path)]) == 2
