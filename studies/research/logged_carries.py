"""Carries that others logged, read as runs, and what the model asks for in them.

The logs are those of github.com/adamweinhardt/dual-arm-manipulation at commit 6699139: two UR5e
press boxes between them, one file per run (controller QP, 50 Hz) or per arm (PID with
feed-forward, 100 Hz). They tell the pose of each tool, the force on it, and the box's pose by
markers. They tell neither moments nor friction, patches, sizes or centres of mass.

Assumptions about all runs: friction within `STATED_FRICTION`, round patches of `PATCH`, the centre
of mass in the middle between the pads, crosstalk of `CROSSTALK`, an empty box of `EMPTY` if no mass
is stated. The squeeze is the mean of both normal forces: the box hands one on to the other,
which both sensors tell to 20 N only.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation, Slerp

from hybrid_opt.display.table import Table, number
from hybrid_opt.extras.calibrating.estimate import without_crosstalk
from hybrid_opt.extras.calibrating.recording import (
    ArmLog,
    Labels,
    PadMotion,
    Recording,
    lost_spans,
    tared,
    together,
)
from symbolic.array import Array, interpolated
from symbolic.contact.soft_finger import SoftPatch, least_soft_squeeze
from symbolic.errors import SettingsError
from symbolic.records.quantities import GRAVITY

DOWNLOAD_COMMAND = """\
git clone https://github.com/adamweinhardt/dual-arm-manipulation FOLDER
git -C FOLDER checkout 6699139"""

STATED_FRICTION = (0.57, 0.60)
"""The stated bracket, from slips in these logs."""

PATCH = 0.03
"""Radius of the patches [m]."""

CROSSTALK = 0.068
"""Crosstalk of squeeze into lift [N/N], from boxes of known mass in these logs: 0.063 to 0.085."""

EMPTY = 0.3
"""Mass of the small box, which is not stated, as the wrists tell it [kg]."""

TARE = 0.45
"""Instant at which the pads still touch nothing [s]; the sensors are zeroed just before."""

TOOL = np.array([0.0, -0.05753, -0.10])
"""Subtracted from every logged position along fixed axes, as their controller does [m]; the other
way about along y in the world for the right arm."""

SLIPS = {
    "20251209-164437": 9.9,
    "20251209-155311": 9.05,
    "20251209-155347": 9.3,
    "20251209-143108": 11.8,
}
"""When boxes were lost [s], by when the run began: their notes tell of one at 4.4 kg and of two at
0.75 m/s, the markers when, and of one more at 1 m/s."""

LABELLED = (
    "QP/logs/weight/*",
    "PID_ff/logs/weight/*",
    "PID_ff/logs/speed/*_0.750v_*",
    "QP/logs/speed/*_1.0v_*",
)
"""Runs of a stated mass, and those of the notes and of the markers with their likes."""

STEP, SMOOTHED, BRIEF = 0.02, 0.5, 0.2
"""Step of the judged samples, and times over which motion and forces are smoothed [s]."""

GLITCH = 5
"""Samples of which the median is taken: single ones jump."""

TIPPED, BESIDE = np.radians(20.0), 0.1
"""Lean of the box [rad] and move across the pads [m] from which on its markers are not believed;
they are late by 0.15 s."""

BELIEVED = 0.9
"""Share of a carry in which markers have to be believed, else they tell nothing of it."""

LIFTED = 0.015
"""Height of pads and box above their start from which on the box is carried [m]."""


@dataclass(frozen=True)
class LoggedCarry:
    """A logged run of two arms with a box, in the frames of its pads.

    Attributes:
        run: the recording with its labels; joint positions and moments are missing.
        motion: poses of the pads, with x along the face, y up at the start and z into the box;
            poses of the box by its markers; force readings without offset and crosstalk.
        stated: True if the log states the mass of the box.
    """

    run: Recording
    motion: PadMotion
    stated: bool

    @property
    def mass(self) -> float:
        """Mass of the box [kg]; of the empty box if the log states none."""
        return self.run.labels.mass or EMPTY


# --- their files ---


def labelled(folder: Path) -> list[Path]:
    """Return the paths of the logs of all labelled runs. For a run with one log per arm it is the
    log of the left arm.

    Args:
        folder: folder of the downloaded data set.

    Raises:
        SettingsError: there are none.
    """
    found = [path for pattern in LABELLED for path in (folder / "experiments").glob(pattern)]
    runs = sorted(path for path in found if path.suffix == ".npz" and path.stem[-2:] != "_R")
    if not runs:
        raise SettingsError(f"no logs in {folder}; get them by\n{DOWNLOAD_COMMAND}", code="no-logs")
    return runs


def read(path: Path) -> LoggedCarry:
    """Read a run from its log. If each arm has a log, `path` is that of the left arm."""
    stamp = re.search(r"\d{8}-\d{6}", path.stem)
    mass = re.search(r"_([\d.]+)kg", path.stem)
    slip = SLIPS.get(stamp[0] if stamp else "")
    labels = Labels(float(mass[1]) if mass else None, False, (TARE,), (), (slip,) if slip else ())
    both = _one_file(path) if "QP" in path.stem else _two_files(path)
    run = together(path.stem.removesuffix("_L"), (both[0][0], both[1][0]), labels, "base")
    poses = [pose(run.time) for _, pose in both]
    with np.load(path) as log:
        prefix = "box__L" if "QP" in path.stem else "box"
        box = np.tile(np.eye(4), (len(run.time), 1, 1))
        count = min(len(both[0][0].time), len(log[f"{prefix}_positions"]))
        near = np.searchsorted(both[0][0].time[:count], run.time).clip(0, count - 1)
        box[:, :3, 3] = log[f"{prefix}_positions"][near]
        box[:, :3, :3] = log[f"{prefix}_rotmats"][near]
    # At the start the line between the pads is level and along the normals.
    line = poses[1][0, :3, 3] - poses[0][0, :3, 3]
    z = line * [1.0, 1.0, 0.0] / np.linalg.norm(line[:2])
    axes = np.column_stack([np.cross([0.0, 0.0, 1.0], z), [0.0, 0.0, 1.0], z])
    pads, wrench = np.empty((len(run.time), 2, 4, 4)), np.full((len(run.time), 2, 6), np.nan)
    for i, turned in enumerate((axes, axes * [-1.0, 1.0, -1.0])):
        pads[:, i] = poses[i]
        pads[:, i, :3, :3] = poses[i][:, :3, :3] @ turned
        wrench[:, i, :3] = np.einsum("nji,nj->ni", pads[:, i, :3, :3], run.wrench[:, i, :3])
    wrench = median_filter(wrench, (GLITCH, 1, 1))
    motion, _ = tared(run, PadMotion(pads, box, wrench))
    free = without_crosstalk(motion.wrench, np.array([[0.0, CROSSTALK]] * 2))
    return LoggedCarry(run, PadMotion(pads, box, free), mass is not None)


class _Poses:
    """Function of a tool's poses (n, 4, 4) at n times [s], interpolated from a log.

    The rotation of a pose is the tool's rotation since the start.
    """

    def __init__(self, time: Array, position: Array, turn: Rotation) -> None:
        self._time, self._position, self._turn = time, position, Slerp(time, turn)

    def __call__(self, time: Array) -> Array:
        found = np.tile(np.eye(4), (len(time), 1, 1))
        for axis in range(3):
            found[:, axis, 3] = np.interp(time, self._time, self._position[:, axis])
        found[:, :3, :3] = self._turn(time).as_matrix()
        return found


_Arm = tuple[ArmLog, _Poses]


def _arm(time: Array, force: Array, commanded: Array, poses: _Poses) -> _Arm:
    wrench = np.hstack([force, np.full_like(force, np.nan)])
    nothing = np.empty((len(time), 0))
    return ArmLog(time, nothing, wrench, commanded, lost_spans(time, force)), poses


def _one_file(path: Path) -> list[_Arm]:
    """Read a log that has both arms in one file; return the left arm, then the right, in the world
    frame.

    The log states vectors in each arm's base frame, and grasps and normals in the world frame as
    well.
    """
    found = []
    with np.load(path) as log:
        time = log["t_epoch"] - log["t_epoch"][0]
        for side in "LR":
            normals = [log[f"meta__meta__normal_{side}_{frame}"] for frame in ("base", "world")]
            grasps = [
                log[f"meta__meta__grasping_point_{side}_{frame}"] for frame in ("base", "world")
            ]
            yaw = [np.arctan2(normal[1], normal[0]) for normal in normals]
            base = Rotation.from_euler("z", yaw[1] - yaw[0])
            rotation = Rotation.from_rotvec(log[f"rvec_{side}"])
            turn = rotation * rotation[0].inv()
            point = median_filter(log[f"p_{side}"], (GLITCH, 1)) + TOOL - turn.apply(TOOL)
            position = grasps[1] + base.apply(point - grasps[0])
            poses = _Poses(time, position, base * turn * base.inv())
            found.append(
                _arm(time, base.apply(log[f"F_{side}_vec"]), log["ref_force"].astype(float), poses)
            )
    return found


def _two_files(left: Path) -> list[_Arm]:
    """Read a run whose arms have one log each; return the left arm, then the right, in the world
    frame.

    The logged vectors are along the world's axes. Logged rotations are in the bases, which are half
    a turn apart.
    """
    found, begin = [], 0.0
    for i, path in enumerate((left, left.with_stem(left.stem.removesuffix("_L") + "_R"))):
        with np.load(path) as log:
            begin = begin or float(log["meta__start_time_epoch"])
            time = log["timestamp"] + (float(log["meta__start_time_epoch"]) - begin)
            base = Rotation.from_euler("z", np.pi * i)
            rotation = Rotation.from_rotvec(log["rotation"])
            turn = base * rotation * rotation[0].inv() * base.inv()
            tool = TOOL * [1.0, 1.0 - 2.0 * i, 1.0]
            position = median_filter(log["position"], (GLITCH, 1)) + tool - turn.apply(tool)
            commanded = np.linalg.norm(log["reference_force_vector"], axis=1)
            found.append(_arm(time, log["force_vector"], commanded, _Poses(time, position, turn)))
    return found


# --- what the model asks for ---


@cache
def _need() -> ca.Function:
    """Build the function of the mean normal force [N] with which two facing pads hold a box.

    Inputs: force (3,) [N] and moment (3,) [N m] about the middle of the pads, along the axes of the
    first pad; half the distance of the pads [m]; friction coefficient.
    """
    force, moment = ca.SX.sym("force", 3), ca.SX.sym("moment", 3)
    half, friction = ca.SX.sym("half"), ca.SX.sym("friction")
    patch = SoftPatch(2.0 / 3.0 * PATCH, PATCH * np.eye(2))
    arm = ca.vertcat(0.0, 0.0, half)
    fingers = least_soft_squeeze(
        force, moment, (-arm, arm), ca.vertcat(friction, friction), (patch, patch)
    )
    needed = (fingers.normal[0] + fingers.normal[1]) / 2.0
    return ca.Function("need", [force, moment, half, friction], [needed])


@dataclass(frozen=True)
class Comparison:
    """Measured forces of a carry beside the forces of the model, at n samples.

    The samples begin when the box is lifted and end when it is set down or lost.

    Attributes:
        time: (n,) times [s].
        squeeze: (n,) measured normal force, mean of both pads [N].
        need: (n, 2) normal force that the motion requires by the model [N], for the lower and the
            upper friction coefficient of `STATED_FRICTION`.
        used: (n,) measured tangential over measured normal force. It includes the force with which
            the arms push against each other along the faces.
        slid: (n,) distance by which the box has slid down between the pads, by its markers [m]; NaN
            if the markers were hardly seen.
        lean: (n,) angle by which the box has tilted since the start, by its markers [rad]; NaN if
            the markers were hardly seen.
    """

    time: Array
    squeeze: Array
    need: Array
    used: Array
    slid: Array
    lean: Array

    @property
    def margin(self) -> Array:
        """(n,) ratio of the measured normal force to the one that the model requires with the lower
        of the two friction coefficients.
        """
        return np.asarray(self.squeeze / self.need[:, 0])


def compared(carry: LoggedCarry) -> Comparison:
    """Compare the measured forces of a logged carry with the forces of the model."""
    run, motion = carry.run, carry.motion
    time = np.arange(run.time[0], run.time[-1], STEP)
    near = np.searchsorted(run.time, time).clip(0, len(run.time) - 1)

    points = interpolated(time, run.time, motion.pads[:, :, :3, 3]).swapaxes(0, 1)
    middle = (points[0] + points[1]) / 2.0
    turned = Rotation.from_matrix(motion.pads[near, 0, :3, :3])
    width = round(SMOOTHED / STEP) | 1
    speed = np.zeros_like(middle)
    speed[1:] = (turned[1:] * turned[:-1].inv()).as_rotvec() / STEP
    faster = savgol_filter(speed, width, 2, deriv=1, delta=STEP, axis=0)
    lifting = savgol_filter(middle, width, 3, deriv=2, delta=STEP, axis=0) - GRAVITY
    half = np.linalg.norm(points[1] - points[0], axis=1) / 2.0
    force = carry.mass * turned.inv().apply(lifting)
    # A cube between the pads.
    inertia = carry.mass * (2.0 * np.median(half)) ** 2 / 6.0
    moment = inertia * turned.inv().apply(faster)
    needs = [
        np.asarray(_need()(force.T, moment.T, half[None], friction)).ravel()
        for friction in STATED_FRICTION
    ]
    wrench = interpolated(time, run.time, motion.wrench[:, :, :3])
    squeeze = -wrench[:, :, 2].mean(axis=1)
    tangential = np.linalg.norm(wrench[:, :, :2], axis=2).mean(axis=1)
    used = median_filter(tangential / np.maximum(squeeze, 1e-3), round(BRIEF / STEP))
    lean, seen = _by_markers(motion)
    height = np.interp(time, run.time[seen], motion.box[seen, 2, 3])
    below = median_filter(height - middle[:, 2], 2 * width)
    lean = median_filter(np.interp(time, run.time[seen], lean[seen]), 2 * width)
    gripped = (time > 2.0 * TARE) & (time < 5.0 * TARE)
    slid = np.median(below[gripped]) - below
    height = middle[:, 2] - np.median(middle[gripped, 2])
    end = run.labels.slip_at[0] if run.labels.slip_at else time[-1] - SMOOTHED
    carried = (height - np.maximum(slid, 0.0) > LIFTED) & (time <= end)
    known = seen[near][carried].mean() >= BELIEVED
    return Comparison(
        time[carried],
        squeeze[carried],
        np.column_stack(needs)[carried],
        used[carried],
        (slid - slid[carried][0])[carried] if known else np.full(carried.sum(), np.nan),
        lean[carried] if known else np.full(carried.sum(), np.nan),
    )


def _by_markers(motion: PadMotion) -> tuple[Array, Array]:
    """Compute how far a box has tilted, and at which samples its markers are valid.

    They are valid while the box tilts little and stays between the pads.

    Returns:
        (n,) angle of the box's upright axis from its start [rad], and (n,) booleans.
    """
    start = Rotation.from_matrix(motion.box[: 2 * GLITCH, :3, :3]).mean()
    up = (Rotation.from_matrix(motion.box[:, :3, :3]) * start.inv()).as_matrix()[:, 2, 2]
    lean = np.arccos(np.clip(up, -1.0, 1.0))
    beside = (motion.box[:, :2, 3] - motion.pads[:, :, :2, 3].mean(axis=1)).T
    moved = np.hypot(*(beside - beside[:, : 2 * GLITCH].mean(axis=1, keepdims=True)))
    return lean, (lean < TIPPED) & (moved < BESIDE)


HEADER = (
    "run",
    "controller",
    "box [kg]",
    "time [s]",
    "squeeze [N]",
    "need [N]",
    "margin",
    "friction used",
    "slid [mm]",
    "leant [°]",
    "what happened",
)

CREPT = 0.025
"""Largest motion of an empty box's markers that counts as holding [m]."""


def table(folder: Path) -> Table:
    """Return a table with a row for every labelled run.

    For a run in which the box was lost, the row states the forces just before; for other runs,
    those at the sample with the smallest ratio of measured to required force. It also states the
    largest friction used, slide and tilt of the run.

    Raises:
        SettingsError: there are no logs.
    """
    rows = []
    for path in labelled(folder):
        carry = read(path)
        found = compared(carry)
        lost = bool(carry.run.labels.slip_at)
        k = len(found.time) - 1 if lost else int(np.argmin(found.margin))
        most = float(found.slid.max())
        rows.append(
            (
                carry.run.name[-15:],
                "QP" if "QP" in path.stem else "PID",
                number(carry.mass, 1) if carry.stated else f"({EMPTY})",
                number(found.time[k], 1),
                number(found.squeeze[k], 0),
                f"{found.need[k, 0]:.1f} to {found.need[k, 1]:.1f}",
                number(found.margin[k]),
                number(float(found.used.max())),
                number(most, 0, 1e3),
                number(np.degrees(found.lean.max()), 0),
                "lost" if lost else "crept" if most > CREPT else "held",
            )
        )
    rows.sort(key=lambda row: (row[2].startswith("("), row[2], row[1], row[0]))
    return Table("real-runs", "Real runs", HEADER, tuple(rows), "")
