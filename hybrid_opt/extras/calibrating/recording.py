"""A recorded run of a cell: joints, wrenches at both wrists, commands, and a side file with labels.

RUN.toml lies beside RUN.csv, RUN.mcap or the folder RUN; docs/how-to/calibration.md explains its
keys. Each arm may have a file of its own; what the second recorded is taken at the times of the
first.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from hybrid_opt.errors import ResultsError
from hybrid_opt.extras.bundles.arms import prefixes
from hybrid_opt.extras.bundles.job_file import pad_places
from hybrid_opt.store.files import read_bytes
from symbolic import safe_io
from symbolic.array import Array, Range, interpolated
from symbolic.errors import OutsideError, WorkcellError
from symbolic.read.arms import arm_model
from symbolic.read.tables import TableReader
from symbolic.records import Workcell
from symbolic.records import quantities as quantity
from symbolic.records.poses import inverse, skew
from symbolic.records.problems import Problems, shown

FRAMES = ("flange", "pad", "base")
"""Frames of a wrench: about the flange or the pad and along its axes, or about the pad along the
axes of the arm's base, as RTDE does."""

TARE_TIME = 0.4
"""Time around a tare instant over which readings are averaged [s]."""

TIME_RANGE = Range(-1e12, 1e12, "s")
Instant = Annotated[float, TIME_RANGE]
FORCE_RANGE = Range(1.0, 1e6, "N")
MOMENT_RANGE = Range(0.1, 1e5, "N m")

Spans = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Labels:
    """Labels of a recorded run in its side file. All times are on the clock of the recording.

    Attributes:
        mass: weighed mass of the box [kg]; None if the box was not weighed.
        empty: True if no box was held at any time.
        tare: instants at which both arms stood still and touched nothing [s].
        held: intervals in which the pads held the box without slip [s].
        slip_at: instants at which the box began to slip [s].
    """

    mass: Annotated[float, quantity.MASS] | None = None
    empty: bool = False
    tare: tuple[Instant, ...] = ()
    held: tuple[tuple[Instant, Instant], ...] = ()
    slip_at: tuple[Instant, ...] = ()


@dataclass(frozen=True)
class Recording:
    """Recorded run of both arms, at n common times.

    Attributes:
        name: name of the file.
        time: (n,) ascending times [s].
        steps: (2,) usual time step of each arm's recording [s].
        joints: joint positions (n, joints) of each arm [rad or m].
        wrench: (n, 2, 6) force and moment on each arm, in the frame `frame` [N, N m]; moments that
            were not recorded are not finite.
        commanded: (n, 2) commanded normal force of each arm [N]; not finite if not recorded.
        lost: intervals, far longer than the usual step, without new samples of an arm [s].
        frame: frame of the wrenches, one of `FRAMES`.
        largest: (2,) largest measurable force and moment [N, N m]; infinite if not stated.
        labels: labels of the side file.
    """

    name: str
    time: Array
    steps: Array
    joints: tuple[Array, Array]
    wrench: Array
    commanded: Array
    lost: Spans
    frame: str
    largest: Array
    labels: Labels

    @property
    def has_moments(self) -> bool:
        """True if the moments of both arms were recorded."""
        return bool(np.isfinite(self.wrench[:, :, 3:]).all())

    def within(self, begin: float, end: float) -> Array:
        """Find the samples between two instants.

        Args:
            begin, end: the instants, on the clock of the recording [s].

        Returns:
            (n,) True for these samples.
        """
        return np.asarray((self.time >= begin) & (self.time <= end))

    def around(self, instant: float) -> Array:
        """Find the samples within half of `TARE_TIME` before and after an instant. Both arms stand
        still then.

        Args:
            instant: the instant, on the clock of the recording [s].

        Returns:
            (n,) True for these samples.
        """
        return self.within(instant - TARE_TIME / 2.0, instant + TARE_TIME / 2.0)


# --- files ---


GAP, LONG_GAP = 10.0, 0.2
"""A step of a recording counts as a gap if it is at least this many usual steps long, and at least
this long [s]."""


@dataclass(frozen=True)
class ArmLog:
    """Recording of one arm, at m samples.

    Attributes:
        time: (m,) ascending times [s].
        joints: (m, joints) joint positions [rad or m].
        wrench: (m, 6) force and moment on the arm [N, N m].
        commanded: (m,) commanded normal force [N].
        lost: intervals without new samples [s].
    """

    time: Array
    joints: Array
    wrench: Array
    commanded: Array
    lost: Spans


def lost_spans(time: Array, values: Array) -> Spans:
    """Find intervals of a recording without new samples.

    In such an interval the time between two samples is longer than usual, or all samples repeat the
    same values.

    Args:
        time: (m,) ascending times [s].
        values: (m, k) recorded values.

    Returns:
        First and last time of each interval [s].
    """
    steps = np.diff(time)
    long = np.flatnonzero(steps > max(GAP * float(np.median(steps)), LONG_GAP))
    same = (np.diff(values, axis=0) == 0.0).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(int), [0]])))
    spans = [*((k, k + 1) for k in long), *zip(edges[::2], edges[1::2], strict=True)]
    times = [(float(time[begin]), float(time[end])) for begin, end in spans]
    return tuple(span for span in times if span[1] - span[0] > LONG_GAP)


def together(
    name: str,
    recorded: tuple[ArmLog, ArmLog],
    labels: Labels,
    frame: str,
    largest: Array | None = None,
) -> Recording:
    """Merge the recordings of both arms into one run, at the times of the first arm's samples. The
    second arm's values are interpolated.

    Args:
        name: name of the recording.
        recorded: the recording of each arm.
        labels: labels of the side file.
        frame: frame of the wrenches, one of `FRAMES`.
        largest: (2,) largest measurable force and moment [N, N m]; None if not stated.

    Raises:
        ResultsError: the two recordings hardly overlap in time.
    """
    first, second = recorded
    steps = np.array([np.median(np.diff(each.time)) for each in recorded])
    time = first.time[(first.time >= second.time[0]) & (first.time <= second.time[-1])]
    if len(time) < 10:
        raise ResultsError(
            f"{name}: both arms recorded at the same time on {len(time)} samples; allowed are 10 "
            f"and more, on one clock in s (usual steps are {steps[0]:g} and {steps[1]:g})"
        )

    def of_both(name: str) -> tuple[Array, Array]:
        one, two = (interpolated(time, log.time, getattr(log, name)) for log in recorded)
        return one, two

    return Recording(
        name=name,
        time=time,
        steps=steps,
        joints=of_both("joints"),
        wrench=np.stack(of_both("wrench"), axis=1),
        commanded=np.stack(of_both("commanded"), axis=1),
        lost=tuple(sorted({*first.lost, *second.lost})),
        frame=frame,
        largest=np.full(2, np.inf) if largest is None else np.asarray(largest),
        labels=labels,
    )


def read_run(path: Path, workcell: Workcell) -> Recording:
    """Read a recorded run and its side file, which has the same name with the suffix `.toml`.

    Args:
        path: path of the recording.
        workcell: the cell.

    Raises:
        ResultsError: the recording cannot be read, or lacks a column.
        WorkcellError: the side file is wrong; the message lists all problems.
    """
    side = path.with_suffix(".toml")
    try:
        data = safe_io.toml_tables(safe_io.read_bytes(safe_io.resolved(side), 2**20))
    except OutsideError as error:
        told = f"a recording's side file: {error}; docs/how-to/calibration.md explains it"
        raise WorkcellError(str(side), (told,)) from error
    problems = Problems()
    table = TableReader(data, "", problems)
    frame = table.choice("frame", FRAMES, "flange")
    largest = None
    if table.has("sensor_range"):
        largest = table.vector("sensor_range", (FORCE_RANGE, MOMENT_RANGE))
    arms = table.tables("arms", exactly=2)
    labels = table.record(Labels)
    if labels.empty and labels.mass is not None:
        table.add("mass", "is stated for an empty run; leave out one of them")
    if table.clean("held") and any(begin >= end for begin, end in labels.held):
        table.add("held", f"found {shown(labels.held)}; allowed are pairs [begin, end] in s")
    if problems.found or len(arms) != 2:
        raise WorkcellError(str(side), problems.messages())
    recorded = [_read_arm(arm, path, workcell, i) for i, arm in enumerate(arms)]
    for each in arms:
        each.close()
    if problems.found:
        raise WorkcellError(str(side), problems.messages())
    return together(path.name, (recorded[0], recorded[1]), labels, frame, largest)


def _read_arm(table: TableReader, path: Path, workcell: Workcell, arm: int) -> ArmLog:
    """Read one arm's recording, from the columns or topics that the side file names.

    Args:
        table: reader of the arm's table in the side file.
        path: path of the recording, unless the table names another file.
        workcell: the cell.
        arm: index of the arm.

    Raises:
        ResultsError: the recording cannot be read, or lacks a column.
    """
    file = path.parent / table.text("file") if table.has("file") else path
    names = list(arm_model(workcell.robots[arm]).names)[1:]
    if is_bag(file):
        return _read_bag(table, file, [f"{prefixes(workcell)[arm]}{name}" for name in names])
    columns = _csv_columns(file)

    def column(name: str) -> Array:
        if name not in columns:
            raise ResultsError(
                f"{file}: no column {name!r}; it has {', '.join(columns)[:300]}", code="no-column"
            )
        return columns[name]

    def several(key: str, counts: Sequence[int]) -> Array:
        value = table.raw(key)
        words = [f"{value}{k}" for k in range(max(counts))] if isinstance(value, str) else value
        if not isinstance(words, list) or len(words) not in counts:
            allowed = " or ".join(map(str, counts))
            table.problems.add(
                table.at(key),
                f"found {shown(value)}; allowed are names of {allowed} columns, or what stands "
                "before 0, 1, 2 ... in them",
            )
            return np.zeros((len(column(time_name)), max(counts)))
        return np.column_stack([column(str(word)) for word in words])

    time_name = table.text("time", "time")
    time = column(time_name)
    joints = several("joints", (len(names),))
    wrench = several("wrench", (6, 3))
    if wrench.shape[1] == 3:
        wrench = np.hstack([wrench, np.full_like(wrench, np.nan)])
    commanded = np.full(len(time), np.nan)
    if table.has("commanded"):
        commanded = column(table.text("commanded"))
    sound = np.isfinite(time) & np.isfinite(joints).all(1) & np.isfinite(wrench[:, :3]).all(1)
    if np.count_nonzero(sound) < 2 or (np.diff(time[sound]) <= 0.0).any():
        raise ResultsError(f"{file}: {time_name!r} does not ascend, or has fewer than two samples")
    lost = lost_spans(time[sound], wrench[sound, :3])
    return ArmLog(time[sound], joints[sound], wrench[sound], commanded[sound], lost)


def _read_bag(table: TableReader, file: Path, names: list[str]) -> ArmLog:
    """Read one arm's recording from a ROS 2 bag, at the times of its joint states.

    Args:
        table: reader of the arm's table in the side file.
        file: path of the bag.
        names: names of the arm's joints, unless the table states others.

    Raises:
        ResultsError: the bag cannot be read, or has too few samples.
    """
    if table.has("joints"):
        value = table.raw("joints")
        if not isinstance(value, list) or len(value) != len(names):
            allowed = f"allowed are the names of {len(names)} joints"
            table.problems.add(table.at("joints"), f"found {shown(value)}; {allowed}")
        else:
            names = [str(name) for name in value]
    states = table.text("joint_states", "/joint_states")
    felt = table.text("wrench")
    asked = table.text("commanded") if table.has("commanded") else ""
    if table.problems.found:
        nothing = np.zeros(2)
        return ArmLog(nothing, nothing, nothing, nothing, ())
    messages = read_topics(file, [topic for topic in (states, felt, asked) if topic])
    time, joints = joint_series(messages[states], names, file)
    wrench_time, wrench = wrench_series(messages[felt])
    if min(len(time), len(wrench_time)) < 2 or not np.isfinite(wrench[:, :3]).all():
        raise ResultsError(f"{file}: fewer than two samples, or forces that are not finite")
    commanded = np.full(len(time), np.nan)
    if asked and messages[asked]:
        commanded = np.interp(time, *force_series(messages[asked]), left=np.nan)
    lost = {*lost_spans(time, time[:, None]), *lost_spans(wrench_time, wrench[:, :3])}
    felt_then = interpolated(time, wrench_time, wrench)
    inside = (time >= wrench_time[0]) & (time <= wrench_time[-1])
    inside &= np.append(True, np.diff(time) > 0.0)
    return ArmLog(
        time[inside], joints[inside], felt_then[inside], commanded[inside], tuple(sorted(lost))
    )


def _csv_columns(path: Path) -> dict[str, Array]:
    """Read the columns of a CSV file separated by commas, semicolons or blanks. Empty cells become
    NaN.

    Args:
        path: path of the file.

    Returns:
        Values (n,) of each column by its name.

    Raises:
        ResultsError: the file is no table of numbers below a line of names.
    """
    try:
        text = safe_io.text(read_bytes(path))
        dialect = csv.Sniffer().sniff(text.partition("\n")[0], ",; \t")
        header, *rows = [row for row in csv.reader(io.StringIO(text), dialect) if row]
        values = np.array([[float(word or "nan") for word in row] for row in rows])
        if values.shape != (len(rows), len(header)) or not len(rows):
            raise ValueError("rows differ in length")
    except (OutsideError, ValueError, csv.Error) as error:
        raise ResultsError(f"{path}: no table of numbers below a line of names: {error}") from error
    return dict(zip((name.strip() for name in header), values.T, strict=True))


# --- frames ---


@dataclass(frozen=True)
class PadMotion:
    """Poses of both pads in a run, and the wrenches on them.

    Attributes:
        pads: (n, 2, 4, 4) pose of each arm's pad in the world.
        box: (n, 4, 4) pose of the box in the world: the middle between the poses that follow from
            each pad.
        wrench: (n, 2, 6) force and moment on each arm, about the pad's centre along the pad's axes
            [N, N m].
    """

    pads: Array
    box: Array
    wrench: Array

    @property
    def normal(self) -> Array:
        """(n, 2) normal force of each arm [N]."""
        return -self.wrench[:, :, 2]


def pad_motion(workcell: Workcell, run: Recording) -> PadMotion:
    """Compute pad poses, box poses and wrenches about the pads from a recorded run.

    Args:
        workcell: the cell.
        run: the run.
    """
    pads, boxes, wrenches = [], [], []
    for i, (robot, contact) in enumerate(zip(workcell.robots, workcell.contacts, strict=True)):
        T_world_pad = pad_places(workcell, i, run.joints[i])
        if run.frame == "base":
            turned = robot.T_world_base[:3, :3].T @ T_world_pad[:, :3, :3]
            force, moment = (
                np.einsum("nji,nj->ni", turned, run.wrench[:, i, part])
                for part in (slice(0, 3), slice(3, 6))
            )
        else:
            T = robot.T_flange_pad if run.frame == "flange" else np.eye(4)
            R, at = T[:3, :3], T[:3, 3]
            force = run.wrench[:, i, :3] @ R
            moment = (run.wrench[:, i, 3:] - run.wrench[:, i, :3] @ skew(at).T) @ R
        pads.append(T_world_pad)
        boxes.append(T_world_pad @ inverse(contact.T_box_pad))
        wrenches.append(np.hstack([force, moment]))
    middle = (boxes[0] + boxes[1]) / 2.0
    # The nearest rotation to the mean of both.
    u, _, v = np.linalg.svd(middle[:, :3, :3])
    middle[:, :3, :3] = u @ v
    return PadMotion(np.stack(pads, axis=1), middle, np.stack(wrenches, axis=1))


def tared(run: Recording, motion: PadMotion) -> tuple[PadMotion, Array]:
    """Subtract the force sensors' offsets from the wrenches of a run.

    The offset of a sample is the one measured at the last tare before it.

    Args:
        run: the run, whose labels state the tares.
        motion: pad poses and wrenches of the run.

    Returns:
        - The pad poses with corrected wrenches.
        - Offsets (k, 2, 6) of both arms at each of the k recorded tares [N, N m].
    """
    instants = [instant for instant in sorted(run.labels.tare) if run.around(instant).any()]
    if not instants:
        return motion, np.empty((0, 2, 6))
    offsets = np.array([motion.wrench[run.around(instant)].mean(axis=0) for instant in instants])
    before = np.maximum(np.searchsorted(instants, run.time, side="right") - 1, 0)
    return replace(motion, wrench=motion.wrench - offsets[before]), offsets


ENDINGS = (".mcap", ".db3")

Messages = list[tuple[float, Any]]
"""Messages of a topic, each with its time since the begin of the recording [s]."""


def is_bag(path: Path) -> bool:
    """Return True if a path has the name of a ROS 2 recording."""
    return path.is_dir() or path.suffix.lower() in ENDINGS


def read_topics(path: Path, topics: Collection[str]) -> dict[str, Messages]:
    """Read the messages of some topics of a ROS 2 recording.

    Args:
        path: path of the recording.
        topics: names of the topics.

    Returns:
        For each topic its messages, each with its time from the beginning of the recording [s].

    Raises:
        ResultsError: the recording cannot be read or lacks a topic, or rosbags is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.rosbag2 import ReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ResultsError(
            "the package rosbags is not installed: pip install 'dual-arm-carry[ros]'"
        ) from error
    found: dict[str, Messages] = {topic: [] for topic in topics}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            lacking = sorted(set(topics) - set(reader.topics))
            if lacking:
                has = ", ".join(sorted(reader.topics))[:300]
                raise ResultsError(
                    f"{path}: no topic {lacking[0]!r}; it has {has}", code="no-topic"
                )
            wanted = [each for each in reader.connections if each.topic in found]
            for connection, stamp, data in reader.messages(wanted):
                message = reader.deserialize(data, connection.msgtype)
                found[connection.topic].append(((stamp - reader.start_time) * 1e-9, message))
    except ResultsError:
        raise
    # Readers and decoders raise many kinds of errors for a damaged file.
    except (AnyReaderError, ReaderError, OSError, ValueError, KeyError, IndexError) as error:
        raise ResultsError(f"{path}: no recording that can be read: {error}") from error
    return found


def joint_series(messages: Messages, names: list[str], path: Path) -> tuple[Array, Array]:
    """Read joint positions from those JointState messages that contain all given joints.

    Args:
        messages: the messages with their times.
        names: names of the joints, in the order of the result.
        path: path of the recording, for messages of errors.

    Returns:
        Times (n,) [s] and joint positions (n, joints) [rad, or m for sliding joints].

    Raises:
        ResultsError: no message contains all joints.
    """
    times, rows, seen = [], [], set()
    for time, message in messages:
        place = {name: k for k, name in enumerate(message.name)}
        seen |= set(place)
        if all(name in place for name in names):
            times.append(time)
            rows.append([message.position[place[name]] for name in names])
    if not rows:
        lacking = next((name for name in names if name not in seen), names[0])
        has = ", ".join(sorted(seen))[:300]
        raise ResultsError(
            f"{path}: no joint {lacking!r} in its joint states; they have {has}", code="no-joint"
        )
    return np.array(times), np.array(rows, dtype=float)


def wrench_series(messages: Messages) -> tuple[Array, Array]:
    """Read forces and moments from WrenchStamped or Wrench messages.

    Args:
        messages: the messages with their times [s].

    Returns:
        Times (n,) [s] and wrenches (n, 6), force then moment [N, N m].
    """
    rows = []
    for _, message in messages:
        wrench: Any = getattr(message, "wrench", message)
        both = (wrench.force, wrench.torque)
        rows.append([getattr(part, axis) for part in both for axis in "xyz"])
    return np.array([time for time, _ in messages]), np.array(rows, dtype=float).reshape(-1, 6)


def force_series(messages: Messages) -> tuple[Array, Array]:
    """Read normal forces from messages that hold one number each, or from wrenches by the absolute
    force along z.

    Args:
        messages: the messages with their times [s].

    Returns:
        Times (n,) [s] and forces (n,) [N].
    """
    if messages and hasattr(messages[0][1], "data"):
        return (
            np.array([time for time, _ in messages]),
            np.array([float(message.data) for _, message in messages]),
        )
    times, wrench = wrench_series(messages)
    return times, np.abs(wrench[:, 2])
