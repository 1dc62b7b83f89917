"""What is found in runs is what the generator knows; every planted fault is told by its name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hybrid_opt.extras.calibrating.estimate import FrictionRatio, delay
from hybrid_opt.extras.calibrating.evidence import Evidence, calibrate
from hybrid_opt.extras.calibrating.recording import Recording, pad_motion
from studies.research.plain.arm import PlainArm
from symbolic.array import Array
from tests.hybrid_opt.extras.calibrating.generator import (
    CELL,
    LEVEL,
    SQUEEZES,
    Truth,
    run,
)

QUIET = Truth(force_noise=1e-6, moment_noise=1e-7)


def errors(changes: dict[str, Any]) -> list[float]:
    """Of the mass, as a share, and of the centre of mass [m]."""
    truth, found = Truth(), changes["payload"]
    centre = np.array(found["centre_of_mass"]) - truth.centre
    return [found["mass"] / truth.mass - 1.0, *centre.tolist()]


def names(evidence: Evidence) -> set[str]:
    return {fault.name for fault in evidence.faults}


def told(evidence: Evidence, name: str) -> str:
    (found,) = [entry.found for entry in evidence.entries if entry.name == name]
    return found


def test_without_noise_the_truth_is_found() -> None:
    found = calibrate(CELL, [run(0, truth=QUIET)])
    assert found.changes["payload"]["mass"] == pytest.approx(4.4, abs=2e-4)
    np.testing.assert_allclose(found.changes["payload"]["centre_of_mass"], QUIET.centre, atol=2e-5)
    assert {"0.065", "0.070"} == {
        told(found, f"crosstalk of arm {arm}").partition(" ")[0] for arm in (1, 2)
    }
    assert found.faults == []


@pytest.mark.parametrize("seed", range(3))
def test_tilts_and_three_squeezes_show_the_load(seed: int) -> None:
    """Within the ranges that are told."""
    changes = calibrate(CELL, [run(seed)]).changes
    (mass, *centre), doubt = errors(changes), changes["uncertainty"]
    assert abs(mass) < min(3 * 0.007, doubt["mass"])
    assert (np.abs(centre) < np.minimum(3 * 1.6e-3, doubt["centre_of_mass"])).all()
    # What nobody measured keeps what the cell says.
    assert "tilt" not in doubt or doubt["tilt"] == CELL.uncertainty.tilt


@pytest.mark.slow
def test_over_thirty_seeds_the_load_is_as_near_as_promised() -> None:
    every = [errors(calibrate(CELL, [run(seed)]).changes) for seed in range(30)]
    mass, *centre = np.sqrt(np.mean(np.square(every), axis=0))
    assert mass < 0.007
    assert max(centre) < 1.6e-3


def test_level_holds_at_one_squeeze_show_neither_mass_nor_centre() -> None:
    found = calibrate(CELL, [run(0, LEVEL, SQUEEZES[:1])])
    assert "payload" not in found.changes
    (fault,) = found.faults
    assert fault.serious
    assert names(found) == {"load not seen"}
    assert "tilted" in " ".join(found.asks)


def test_level_holds_of_a_weighed_box_still_ask_for_tilts() -> None:
    found = calibrate(CELL, [run(0, LEVEL, SQUEEZES, weighed=4.4)])
    assert found.changes["payload"] == {"mass": pytest.approx(4.4, abs=0.03)}
    assert any("tilted" in ask for ask in found.asks)


def test_lag_and_tracking() -> None:
    found = calibrate(CELL, [run(0, truth=QUIET)])
    for arm in (1, 2):
        lag = float(told(found, f"lag of the force, arm {arm}").split()[0])
        assert lag == pytest.approx(QUIET.lag, abs=0.011)
    assert found.changes["uncertainty"]["tracking"] < 0.05
    weak = run(0, truth=QUIET)
    weak = replace(weak, commanded=weak.commanded / 0.8)
    assert calibrate(CELL, [weak]).changes["uncertainty"]["tracking"] == pytest.approx(
        0.2, abs=0.05
    )


def test_a_delay_is_found_where_there_is_one() -> None:
    time = np.arange(0.0, 10.0, 0.01)
    first, second = np.tanh(3.0 * (time - 4.0)), np.tanh(3.0 * (time - 4.25))
    assert delay(time, first, second) == pytest.approx(0.25, abs=0.006)
    assert delay(time, second, first) == pytest.approx(-0.25, abs=0.006)
    assert delay(1e6 * time, first, second) is None
    noise = np.random.default_rng(0).normal(size=(2, len(time)))
    assert delay(time, *noise) is None


def test_wrenches_in_every_frame_are_the_same() -> None:
    """Told about the flange, and along the axes of the base, by transports written here."""
    made = run(0, truth=QUIET)
    motion = pad_motion(CELL, made)
    flange, base = np.empty_like(made.wrench), np.empty_like(made.wrench)
    for i, robot in enumerate(CELL.robots):
        R, at = robot.T_flange_pad[:3, :3], robot.T_flange_pad[:3, 3]
        R_base = robot.T_world_base[:3, :3]
        for k, (force, moment) in enumerate(made.wrench[:, i].reshape(-1, 2, 3)):
            flange[k, i] = [*(R @ force), *(R @ moment + np.cross(at, R @ force))]
            turned = R_base.T @ motion.pads[k, i, :3, :3]
            base[k, i] = [*(turned @ force), *(turned @ moment)]
    for frame, wrench in (("flange", flange), ("base", base)):
        found = pad_motion(CELL, replace(made, frame=frame, wrench=wrench)).wrench
        np.testing.assert_allclose(found, made.wrench, atol=1e-9)


# --- friction and pads ---


def disc(distance: float, radius: float) -> tuple[float, float]:
    """Share of mu N that an even disc's tangential force takes, and its torsion over mu N [m], when
    it slides about a point so far from its centre: sums over 40,000 points."""
    k = np.arange(40_000) + 0.5
    r, angle = radius * np.sqrt(k / len(k)), np.pi * (1.0 + 5.0**0.5) * k
    x, y = r * np.cos(angle), r * np.sin(angle)
    length = np.hypot(x + distance, y)
    pull = np.array([-y, x + distance]) / length
    return float(np.linalg.norm(pull.mean(axis=1))), float((x * pull[1] - y * pull[0]).mean())


@pytest.mark.parametrize("distance", [0.0, 0.01, 0.03, 0.1, 1.0])
def test_the_ratio_is_the_coefficient_of_discs_that_slide(distance: float) -> None:
    mu, normal = 0.57, 60.0
    pull, twist = disc(distance, CELL.contacts[0].patch_radius)
    wrench = np.zeros((2, 6))
    wrench[:, 1], wrench[:, 2] = mu * normal * pull, -normal
    wrench[:, 5] = mu * normal * twist * np.array([1.0, -1.0])
    assert FrictionRatio(CELL)(wrench) == pytest.approx(mu, rel=0.006)


def slipping(seed: int, name: str, squeeze: float) -> Recording:
    """A level hold that slips when it ends."""
    made = run(seed, LEVEL, (squeeze,), name=name, truth=QUIET)
    ((begin, end),) = made.labels.held
    return changed(made, held=((begin, end - 0.5),), slip_at=(end,))


def test_friction_is_bracketed_by_two_runs() -> None:
    runs = [run(0, truth=QUIET), slipping(1, "low.csv", 30.0), slipping(2, "lower.csv", 25.0)]
    runs[1:] = [changed(made, held=()) for made in runs[1:]]
    found = calibrate(CELL, runs)
    held, slipped = (
        float(told(found, f"friction, {which}").split()[0])
        for which in ("greatest held", "least slipped")
    )
    assert "low.csv" in told(found, "friction, least slipped")
    assert held < slipped
    (first, second), share = found.changes["contacts"], found.changes["uncertainty"]["friction"]
    assert first == second
    assert held < first["friction"] < slipped
    assert share >= max(0.1, (slipped - held) / (slipped + held) - 1e-3)


def test_one_run_never_tells_the_friction() -> None:
    made = run(0, truth=QUIET)
    found = calibrate(CELL, [changed(made, slip_at=(made.labels.held[-1][1],))])
    assert "contacts" not in found.changes
    assert "friction" not in found.changes["uncertainty"]
    assert any("friction" in ask for ask in found.asks)


def test_the_drift_of_the_pads_is_what_plain_kinematics_say() -> None:
    made = run(0, LEVEL, (75.0,), truth=QUIET)
    ((begin, end),) = made.labels.held
    share = np.clip((made.time - begin) / (end - begin), 0.0, 1.0)
    ramp = np.outer(share, [0.005, 0, 0, 0, 0, 0])
    found = calibrate(CELL, [replace(made, joints=(made.joints[0], made.joints[1] + ramp))])
    arm = PlainArm(CELL.robots[1], CELL.contacts[1])
    places = [
        arm.place(q).homogeneous @ CELL.robots[1].T_flange_pad
        for q in (made.joints[1][-1], made.joints[1][-1] + ramp[-1])
    ]
    move = places[0][:3, :3].T @ (places[1][:3, 3] - places[0][:3, 3])
    drift = found.changes["uncertainty"]["relative_position"]
    assert drift == pytest.approx(float(np.hypot(*move[:2])), rel=0.05)
    assert found.changes["uncertainty"]["relative_angle"] == pytest.approx(0.005, rel=0.05)


def test_an_arm_that_moves_late_is_told() -> None:
    """Both turn about their bases: the box goes to and fro between them."""
    made = run(0, LEVEL, truth=QUIET)
    swing = 0.03 * np.sin(np.linspace(0.0, 20.0, len(made.time)))
    late = np.interp(made.time - 0.2, made.time, swing)
    joints = []
    for q, turn in zip(made.joints, (swing, -late), strict=True):
        joints.append(q + np.outer(turn, [1, 0, 0, 0, 0, 0]))
    found = calibrate(CELL, [replace(made, joints=(joints[0], joints[1]))])
    entry = told(found, "delay of arm 2 after arm 1")
    assert float(entry.split()[0]) == pytest.approx(0.2, abs=0.02)


# --- planted faults ---


def late(made: Recording, seconds: float) -> Recording:
    """All that the second arm recorded, on a clock that is off."""

    def later(values: Array) -> Array:
        flat = values.reshape(len(made.time), -1).T
        columns = [np.interp(made.time - seconds, made.time, column) for column in flat]
        return np.column_stack(columns)

    joints, wrench, commanded = made.joints[1], made.wrench[:, 1], made.commanded[:, 1]
    return replace(
        made,
        joints=(made.joints[0], later(joints)),
        wrench=np.stack([made.wrench[:, 0], later(wrench)], axis=1),
        commanded=np.column_stack([made.commanded[:, 0], later(commanded)]),
    )


def changed(made: Recording, **labels: object) -> Recording:
    return replace(made, labels=replace(made.labels, **labels))  # type: ignore[arg-type]


def scaled(made: Recording, forces: float, moments: float, arms: slice = slice(2)) -> Recording:
    wrench = made.wrench.copy()
    wrench[:, arms] *= [forces] * 3 + [moments] * 3
    return replace(made, wrench=wrench)


def without_command(made: Recording) -> Recording:
    return replace(made, commanded=np.full_like(made.commanded, np.nan))


def gripped(made: Recording) -> Recording:
    """Tared between two holds, while the pads press and nothing was commanded."""
    (_, end), (begin, _) = made.labels.held[:2]
    return changed(without_command(made), tare=((begin + end) / 2.0,))


def turned(made: Recording, angle: float) -> Recording:
    """The second arm about its base."""
    return replace(made, joints=(made.joints[0], made.joints[1] + [angle, 0, 0, 0, 0, 0]))


def without_squeeze(made: Recording) -> Recording:
    """The first hold loses its squeeze."""
    wrench, (begin, end) = made.wrench.copy(), made.labels.held[0]
    fallen = made.within((begin + end) / 2.0, end)
    wrench[fallen] -= made.wrench[made.within(begin, end)].mean(axis=0) * 0.99
    return replace(made, wrench=wrench)


SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 30))]

FAULTS: dict[str, tuple[str, Callable[[Recording], Recording]]] = {
    "tare": ("missing tare", lambda made: changed(made, tare=())),
    "tare at no sample": ("missing tare", lambda made: changed(made, tare=(-9.0,))),
    "tare in a hold": (
        "missing tare",
        lambda made: changed(without_command(made), tare=(made.labels.held[0][0] + 0.5,)),
    ),
    "tare under command": ("missing tare", lambda made: changed(made, tare=(1.3,))),
    "tare between squeezes": ("missing tare", gripped),
    "late clock": ("clock offset", lambda made: late(made, 0.3)),
    "early clock": ("clock offset", lambda made: late(made, -0.3)),
    "sensors": ("swapped arms", lambda made: replace(made, wrench=made.wrench[:, ::-1])),
    "joints": ("swapped arms", lambda made: replace(made, joints=made.joints[::-1])),
    "pads": ("pads do not overlap", lambda made: turned(made, 0.3)),
    "kgf of a weighed box": (
        "unit error",
        lambda made: scaled(changed(without_command(made), mass=4.4), 1 / 9.81, 1 / 9.81),
    ),
    "kgf": ("unit error", lambda made: scaled(made, 1 / 9.81, 1 / 9.81)),
    "kgf of one arm": (
        "unit error",
        lambda made: scaled(without_command(made), 1 / 9.81, 1.0, slice(1)),
    ),
    "lbf": ("unit error", lambda made: scaled(made, 0.2248, 1.0)),
    "command in kgf": (
        "unit error",
        lambda made: replace(made, commanded=made.commanded / 9.81),
    ),
    "N mm": ("unit error", lambda made: scaled(made, 1.0, 1e3)),
    "N cm of one arm": ("unit error", lambda made: scaled(made, 1.0, 1e2, slice(1, 2))),
    "degrees": (
        "unit error",
        lambda made: replace(made, joints=(np.degrees(made.joints[0]), np.degrees(made.joints[1]))),
    ),
    "degrees of one arm": (
        "unit error",
        lambda made: replace(made, joints=(made.joints[0], np.degrees(made.joints[1]))),
    ),
    "ms": (
        "unit error",
        lambda made: replace(made, time=1e3 * made.time, steps=1e3 * made.steps),
    ),
    "ms of one arm": ("unit error", lambda made: replace(made, steps=made.steps * [1.0, 1e3])),
    "frame": ("wrong sign or frame", lambda made: replace(made, frame="base")),
    "range": ("beyond the sensor's range", lambda made: replace(made, largest=np.array([90, 9]))),
    "sign": ("wrong sign or frame", lambda made: replace(made, wrench=-made.wrench)),
    "squeeze": ("squeeze vanishes", without_squeeze),
    "weight": ("residual", lambda made: scaled(changed(made, mass=4.4), 2.0, 2.0)),
}


@pytest.mark.parametrize("which", FAULTS)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_planted_fault_is_told_by_its_name(which: str, seed: int) -> None:
    """And by no other: what follows from it would lead astray."""
    name, plant = FAULTS[which]
    found = calibrate(CELL, [plant(run(seed))])
    assert names(found) == {name}
    if which != "squeeze":
        assert "payload" not in found.changes
        assert any(fault.serious for fault in found.faults)


@pytest.mark.parametrize("seed", SEEDS)
def test_what_is_no_fault_is_not_told(seed: int) -> None:
    assert names(calibrate(CELL, [run(seed), run(seed + 1, LEVEL)])) == set()


def test_both_files_exchanged_are_told_where_the_cell_has_no_symmetry() -> None:
    """Half a turn about the vertical makes the rack cell what it is; with one base moved it does
    not, and a run whose first joint turns with the base is one of that cell."""
    made = run(0)
    exchanged = replace(made, joints=made.joints[::-1], wrench=made.wrench[:, ::-1])
    assert names(calibrate(CELL, [exchanged])) == set()
    base = CELL.robots[1].T_world_base.copy()
    base[:2, :2] = base[:2, :2] @ [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    cell = replace(CELL, robots=(CELL.robots[0], replace(CELL.robots[1], T_world_base=base)))
    there = turned(made, -0.3)
    assert names(calibrate(cell, [there])) == set()
    exchanged = replace(there, joints=there.joints[::-1], wrench=there.wrench[:, ::-1])
    assert names(calibrate(cell, [exchanged])) == {"swapped arms"}


def test_holds_that_were_not_recorded_are_told() -> None:
    made = run(0)
    found = calibrate(CELL, [changed(made, held=(*made.labels.held, (900.0, 902.0)))])
    assert names(found) == {"dropout"}
    assert found.changes["payload"]["mass"] == pytest.approx(4.4, rel=0.03)


@pytest.mark.parametrize("weight", [0.0, 30.0])
def test_an_empty_run_shows_whether_the_tool_is_compensated(weight: float) -> None:
    """A tool that weighs turns with the pads; the tare knows one posture."""
    made = changed(run(0, truth=QUIET), empty=True, mass=None)
    up = pad_motion(CELL, made).pads[:, :, 2, :3]
    wrench = np.zeros_like(made.wrench)
    wrench[:, :, :3] = -weight * up
    # The arms hang the other way up at the tare.
    wrench[made.time < 1.0] *= -1.0
    wrench += np.random.default_rng(0).normal(size=wrench.shape) * 0.1
    found = calibrate(CELL, [replace(made, wrench=wrench), run(1)])
    nothing = float(told(found, "run.csv, force of nothing").split()[0])
    assert nothing == pytest.approx(2.0 * weight, rel=0.05, abs=0.2)
    assert names(found) == ({"residual"} if weight else set())
    assert found.changes["payload"]["mass"] == pytest.approx(4.4, rel=0.03)


def test_without_moments_the_centre_of_mass_is_not_written() -> None:
    made = run(0)
    found = calibrate(CELL, [scaled(made, 1.0, np.nan)])
    assert names(found) == {"moments missing"}
    assert found.changes["payload"] == {"mass": pytest.approx(4.4, rel=0.03)}
