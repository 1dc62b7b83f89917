"""Check of any joint trajectory of both arms that is meant to carry the box of a cell.

The trajectory may be an edited one of a bundle, or another planner's, as CSV, JSON or ROS 2's
JointTrajectory in YAML. The first arm's pad gives the pose of the box. The second arm's pad has to
hold the box at this pose (the closed chain). The cell's contact model gives the forces that the box
needs.

Controllers interpolate between samples. The interpolated motion is checked too: closed chain,
limits and forces at the shares `BETWEEN` of each step, collisions by a proof along the whole
motion.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.interpolate import BPoly, CubicSpline
from scipy.spatial.transform import Rotation

from codegen.function import NumericFunction
from hybrid_opt.carry import joints_of
from hybrid_opt.cell import Cell
from hybrid_opt.collision.certify import certify
from hybrid_opt.collision.checker import CollisionChecker
from hybrid_opt.display.table import text_table
from hybrid_opt.errors import ResultsError
from hybrid_opt.extras.bundles.arms import prefixes
from hybrid_opt.extras.bundles.job_file import (
    BETWEEN,
    DERIVATIVES,
    Interpolation,
    between,
    pad_errors,
    pad_places,
)
from hybrid_opt.job.motions import joint_use
from hybrid_opt.store.files import read_bytes
from hybrid_opt.store.trajectory_file import TRAJECTORY_FORMAT as CARRY_FORMAT
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.arms import arm_model
from symbolic.records import Workcell
from symbolic.records.poses import inverse

if TYPE_CHECKING:
    import casadi as ca

    from symbolic.cell_model import CellModel

LARGEST_FILE = 64 * 2**20
"""Largest size of a file [bytes]."""

SHORTEST = 4
"""Smallest number of samples of a trajectory."""

TOUCHING = 0.005
"""The pads count as holding the box while their relative position changes by at most this [m]."""

CLOSED_CHAIN_CHANGE = 1e-3
"""The closed chain counts as closed if the pads' relative position changes by at most this [m]."""

EXCESS = 1.005
"""A limit counts as exceeded if it is used beyond this ratio."""

QUANTITIES = ("position", "velocity", "acceleration")

Columns = tuple[Array, dict[tuple[str, str], Array]]
"""Columns of a file: times (n,); positions, velocities and accelerations (n,) by quantity and name
of the joint."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """Joint positions of both arms over time, as read from a file.

    Attributes:
        time: (n,) ascending times from 0 [s].
        known: arrays (n, joints), both arms side by side: positions, then velocities and
            accelerations if the file has them [rad or m, and s].
        carry: first and last time of the carry [s]; None if the file does not state them.
    """

    time: Array
    known: tuple[Array, ...]
    carry: tuple[float, float] | None = None

    @property
    def q(self) -> Array:
        """(n, joints) joint positions of both arms side by side [rad, or m for sliding joints]."""
        return self.known[0]


@dataclass(frozen=True, eq=False)
class Finding:
    """Result of the check of a joint trajectory.

    Attributes:
        held: (n,) True for samples at which both pads hold the box.
        along, across: largest deviation of the second pad from its planned position relative to the
            first pad while they hold the box, along the first pad's normal and across it [m].
        use: largest value over its limit, by name of the limit; above 1 the limit is exceeded.
        collides: first pair that collides or cannot be proven free while the box is held; '' for
            none.
        normal_force: (2,) largest normal force that each arm needs to hold the box [N].
        rated: (2,) reference force of each arm [N].
        balanced: True if forces of the pads can hold the box at every sample.
        duration: duration of the trajectory [s].
        interpolation: assumed interpolation between samples.
    """

    held: Mask
    along: float
    across: float
    use: dict[str, float]
    collides: str
    normal_force: Array
    rated: Array
    balanced: bool
    duration: float
    interpolation: Interpolation

    @property
    def problems(self) -> list[str]:
        """Sentences with reasons why the trajectory should not be run; empty if there are none."""
        if not self.held.any():
            return ["the pads hold the box nowhere: another cell, or another order of the joints?"]
        found = []
        if max(self.along, self.across) > CLOSED_CHAIN_CHANGE:
            found.append(
                f"the chain is not closed: the pads miss one another by {1e3 * self.along:.2f} mm "
                f"along and {1e3 * self.across:.2f} mm across the normal"
            )
        found += [
            f"uses {100.0 * ratio:.1f} % of the limit on {name}"
            for name, ratio in self.use.items()
            if ratio > EXCESS
        ]
        if self.collides:
            found.append(f"collisions: {self.collides}")
        if not self.balanced:
            found.append("no forces of the pads balance the box everywhere")
        for arm, (force, most) in enumerate(zip(self.normal_force, self.rated, strict=True), 1):
            if force > most:
                found.append(f"arm {arm} needs {force:.1f} N, its reference force is {most:.1f} N")
        return found

    def __repr__(self) -> str:
        share = float(self.held.mean())
        rows = [
            ["duration", f"{self.duration:.3f} s"],
            ["between samples", self.interpolation],
            ["the box is held", f"{100.0 * share:.0f} % of the samples"],
            ["closed chain", f"{1e3 * self.along:.3f} mm along, {1e3 * self.across:.3f} mm across"],
            *([f"use of {name}", f"{100.0 * ratio:.1f} %"] for name, ratio in self.use.items()),
            ["collisions", self.collides or "none, proven also between samples"],
            ["normal forces", " / ".join(f"{force:.2f} N" for force in self.normal_force)],
        ]
        verdict = "; ".join(self.problems) or "it can be driven"
        return f"{text_table([['what', 'found'], *rows], left=(0, 1))}\nverdict: {verdict}"


def read_trajectory(path: Path, workcell: Workcell) -> JointTrajectory:
    """Read the joint positions of a cell's arms from a file.

    Args:
        path: path of the file: CSV, JSON (job.json, or a message of ROS 2), or YAML of ROS 2.

    Raises:
        ResultsError: the file cannot be read, or lacks joints of the cell.
    """
    content = read_bytes(path)
    if len(content) > LARGEST_FILE:
        raise ResultsError(f"{path}: larger than {LARGEST_FILE // 2**20} MiB")
    try:
        text = content.decode("utf-8")
        if path.suffix.lower() == ".csv":
            columns, carry = _csv_columns(text)
        else:
            is_json = path.suffix.lower() == ".json"
            document = json.loads(text) if is_json else yaml.load(text, Loader=yaml.CSafeLoader)
            columns, carry = _document_columns(document), None
            # Before and after the carry of a whole job the box touches what it stands on.
            for phase in document.get("phases", ()):
                if phase["name"] == "carry":
                    carry = document["time"][phase["first"]], document["time"][phase["last"]]
        return replace(_chosen(columns, workcell), carry=carry)
    except (ValueError, KeyError, TypeError, IndexError, yaml.YAMLError, csv.Error) as error:
        raise ResultsError(
            f"{path}: no joint trajectory of both arms ({error})", code="no-trajectory"
        ) from error


def _csv_columns(text: str) -> tuple[Columns, tuple[float, float] | None]:
    """Read a CSV file with joint positions.

    Returns:
        - Times and columns of the file.
        - First and last time [s] of the rows with 'carry' in the column `phase`; None without such
          rows.
    """
    rows = list(csv.DictReader(io.StringIO(text)))
    titles = {re.sub(r"\s*\[.*\]$", "", title).strip(): title for title in rows[0]}
    (at,) = (word for word in titles if word.lower() in ("time", "t"))

    def column(word: str) -> Array:
        return np.array([float(row[titles[word]]) for row in rows])

    found: dict[tuple[str, str], Array] = {}
    for word in titles:
        name, _, what = word.rpartition(" ")
        if what in QUANTITIES:
            found[what, name] = column(word)
        elif not name and word not in (at, "phase"):
            found["position", what] = column(word)
    time, phase = column(at), titles.get("phase", "")
    carried = [t for t, row in zip(time.tolist(), rows, strict=True) if row.get(phase) == "carry"]
    return (time, found), (carried[0], carried[-1]) if carried else None


def _document_columns(document: Any) -> Columns:
    if document.get("format") == CARRY_FORMAT:
        raise ValueError("it is a stored carry: export it first (dual-arm-carry export)")
    if "robots" in document:
        found = {
            (what, f"{robot['name']}/{joint}"): values.astype(float)
            for robot in document["robots"]
            for what in QUANTITIES
            for joint, values in zip(robot["joints"], np.array(robot[what]).T, strict=True)
        }
        return np.array(document["time"], dtype=float), found
    for key in ("goal", "joint_trajectory", "trajectory"):
        document = document.get(key, document)
    names, points, found = document["joint_names"], document["points"], {}
    stamps = [point["time_from_start"] for point in points]
    time = np.array([stamp["sec"] + 1e-9 * stamp.get("nanosec", 0) for stamp in stamps])
    for what, plural in zip(QUANTITIES, ("positions", "velocities", "accelerations"), strict=True):
        if what == "position" or all(point.get(plural) for point in points):
            rows = np.array([point[plural] for point in points], dtype=float)
            found |= {(what, name): row for name, row in zip(names, rows.T, strict=True)}
    return time, found


def _chosen(columns: Columns, workcell: Workcell) -> JointTrajectory:
    """Select the joints of a cell from the columns of a file. A joint may be named ROBOT/JOINT, by
    its name in ROS, or plainly if the plain name is unique.

    Raises:
        ValueError: a joint is missing, or times or values are not valid.
    """
    time, values = columns
    names = [
        (f"{robot.name}/{joint}", f"{prefix}{joint}", joint)
        for robot, prefix in zip(workcell.robots, prefixes(workcell), strict=True)
        for joint in list(arm_model(robot).names)[1:]
    ]
    plain = [each[2] for each in names]
    picked = []
    for known in names:
        # A name that both arms have says nothing.
        usable = known if plain.count(known[2]) == 1 else known[:2]
        found = next((name for name in usable if ("position", name) in values), None)
        if found is None:
            has = ", ".join(name for what, name in values if what == "position")
            raise ValueError(f"there is no joint {usable[1]!r}; it has {has}")
        picked.append(found)
    tables: list[Array] = []
    for what in QUANTITIES:
        if not all((what, name) in values for name in picked):
            break
        tables.append(np.column_stack([values[what, name] for name in picked]))
    for rows in tables:
        if len(time) < SHORTEST or rows.shape != (len(time), len(names)):
            raise ValueError(
                f"{len(time)} times for {len(rows)} postures; at least {SHORTEST} are needed"
            )
        if not np.isfinite(rows).all():
            raise ValueError("all numbers have to be finite")
    if not (np.isfinite(time).all() and (np.diff(time) > 0.0).all()):
        raise ValueError("times have to ascend")
    return JointTrajectory(time - time[0], tuple(tables))


def check(
    cell: Cell,
    trajectory: JointTrajectory,
    held: tuple[float, float] | None = None,
    interpolation: Interpolation | None = None,
) -> Finding:
    """Check whether two arms can carry the box along a joint trajectory.

    The check covers the positions of the pads on the box, limits of joints and payload, collisions,
    and the normal forces that hold the box.

    Args:
        cell: the cell.
        trajectory: joint positions of both arms over time.
        held: first and last time at which the pads hold the box [s]. None for the times that the
            file states; if it states none, the longest run of samples at which the pads are near
            their planned positions relative to each other.
        interpolation: the controller's interpolation between samples; None for one that uses all
            known derivatives, as ROS 2's joint trajectory controller does.

    Raises:
        SettingsError: too few samples lie between the times of `held`, or the file lacks columns
            that the interpolation needs.
    """
    workcell, time = cell.workcell, trajectory.time
    held = held or trajectory.carry
    kind = interpolation or tuple(DERIVATIVES)[len(trajectory.known) - 1]
    if len(trajectory.known) < DERIVATIVES[kind]:
        raise SettingsError(
            f"{kind} motion between samples takes {', '.join(QUANTITIES[: DERIVATIVES[kind]])}; "
            f"the file has {', '.join(QUANTITIES[: len(trajectory.known)])}: choose another one"
        )
    joints = between(time, trajectory.known, kind)
    mask = _held(*pad_errors(workcell, trajectory.q))
    if held is not None:
        mask = np.asarray((time >= held[0]) & (time <= held[1]))
    if held is not None and mask.sum() < SHORTEST:
        raise SettingsError(
            f"under {SHORTEST} samples lie between {held[0]:g} and {held[1]:g} s", code="too-few"
        )
    places = _places(time)
    # Straight lines have no accelerations: those of a smooth motion through the samples count.
    smooth = CubicSpline(time, trajectory.q) if kind == "linear" else joints
    use = joint_use(workcell, joints(places), joints(places, 1), smooth(places, 2))
    rated = np.asarray(workcell.task.reference_force, dtype=float)
    if not mask.any():
        nothing, end = np.zeros(2), float(time[-1])
        return Finding(mask, np.inf, np.inf, use, "", nothing, rated, False, end, kind)
    carried = time[mask]
    places = _places(carried)
    along, across = pad_errors(workcell, joints(places))
    motion = CubicSpline(carried, _poses(workcell, joints(carried)))
    pose, rate, second = (np.ascontiguousarray(motion(places, order)) for order in range(3))
    force = _load(cell).batch(pose, rate, second)["normal_force"]
    payload = workcell.payload
    use["payload velocity"] = _most(rate[:, :3], payload.velocity_max)
    use["payload acceleration"] = _most(second[:, :3], payload.acceleration_max)
    return Finding(
        held=mask,
        along=float(np.abs(along).max()),
        across=float(across.max()),
        use=use,
        collides=_certificate(cell, joints, carried),
        normal_force=np.nanmax(force, axis=0),
        rated=rated,
        balanced=bool(np.isfinite(force).all()),
        duration=float(time[-1]),
        interpolation=kind,
    )


def _places(time: Array) -> Array:
    """Return the times [s] at which a trajectory is checked: those of the n samples and, in each
    step between two samples, those at the shares `BETWEEN` of the step. They ascend."""
    steps = np.diff(time)
    inside = [time[:-1] + share * steps for share in (0.0, *BETWEEN)]
    return np.append(np.column_stack(inside).ravel(), time[-1])


def _load(cell: Cell) -> NumericFunction:
    """Return the compiled function that computes the contact forces from pose, velocity and
    acceleration of the box. A timing model has this function too, but would also load a compiled
    solver.
    """

    def make(model: CellModel) -> Mapping[str, ca.Function]:
        from symbolic.contact.load import load_function

        return {"load": load_function(model.workcell)}

    return cell.compiled.functions("load", make, bodies=False)["load"]


def _certificate(cell: Cell, joints: BPoly, time: Array) -> str:
    """Prove that the motion of both arms and box is free of collisions.

    Args:
        cell: the cell.
        joints: polynomials in time of both arms' joint positions.
        time: (n,) times [s]; the proof covers the motion from the first to the last one.

    Returns:
        First pair that collides or cannot be proven free, and its time, as text; '' if the motion
        is proven free.
    """
    workcell = cell.workcell

    def at(places: Array) -> tuple[Array, Array, Array]:
        # In order of time: angles are counted on from one place to the next.
        every = np.union1d(time, places)
        pose = _poses(workcell, joints(every))[np.searchsorted(every, places)]
        q_1, q_2 = (np.ascontiguousarray(q) for q in joints_of(workcell, joints(places)))
        return np.ascontiguousarray(pose), q_1, q_2

    # Not the evaluator's: in drivable cells that brings the timing of paths.
    checker = CollisionChecker(cell.compiled.geometry, cell.compiled.screening)
    found = certify(checker, at, time)
    return "" if found.is_free else f"{found.problem} at {found.at_parameter:.3f} s"


def _held(along: Array, across: Array) -> Mask:
    """Find the longest run of at least `SHORTEST` samples at which both pads are near their planned
    positions relative to each other. `along` and `across` are the results of `pad_errors`.

    Returns:
        (n,) True for samples of this run; False everywhere if there is none.
    """
    near = (np.abs(along) < TOUCHING) & (across < TOUCHING)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], near.astype(int), [0]])))
    runs = list(zip(edges[::2], edges[1::2], strict=True))
    mask = np.zeros(len(near), dtype=bool)
    if runs:
        begin, end = max(runs, key=lambda run: run[1] - run[0])
        if end - begin >= SHORTEST:
            mask[begin:end] = True
    return mask


def _poses(workcell: Workcell, q: Array) -> Array:
    """Compute the box poses (n, 6) [m, rad] that follow from the first arm, if its pad stays at its
    position on the box.

    Args:
        workcell: the cell, whose task says whether the last three numbers are angles or a rotation
            vector.
        q: (n, joints) joint positions of both arms side by side [rad or m].
    """
    T_pad_box = inverse(workcell.contacts[0].T_box_pad)
    T = pad_places(workcell, 0, joints_of(workcell, q)[0]) @ T_pad_box
    orientation = workcell.task.orientation
    if orientation.is_vector:
        turned = T[:, :3, :3] @ orientation.reference.T
        numbers = Rotation.from_matrix(turned).as_rotvec()
    else:
        numbers = Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz")
    return np.ascontiguousarray(np.column_stack([T[:, :3, 3], orientation.unwrapped(numbers)]))


def _most(values: Array, limit: float) -> float:
    return float(np.linalg.norm(values, axis=1).max()) / limit


def as_document(finding: Finding) -> Mapping[str, Any]:
    """Convert the result of a check to JSON values."""
    return {
        "duration": finding.duration,
        "interpolation": finding.interpolation,
        "held": float(finding.held.mean()),
        "closed_chain": {"along": finding.along, "across": finding.across},
        "use": finding.use,
        "collides": finding.collides,
        "normal_force": finding.normal_force.tolist(),
        "reference_force": finding.rated.tolist(),
        "balanced": finding.balanced,
        "problems": finding.problems,
    }
