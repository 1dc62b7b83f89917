"""Evidence of a cell from recorded runs, and a workcell file with the calibrated values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from hybrid_opt.display.table import number, text_table
from hybrid_opt.extras.calibrating.estimate import (
    FrictionRatio,
    Load,
    MeasuredHold,
    delay,
    fit_load,
    without_crosstalk,
)
from hybrid_opt.extras.calibrating.faults import (
    LARGEST_RESIDUAL,
    Fault,
    load_faults,
    recording_faults,
    vanished,
)
from hybrid_opt.extras.calibrating.recording import PadMotion, Recording, pad_motion, tared
from hybrid_opt.extras.proposing.problem import Problem
from symbolic import safe_io
from symbolic.array import Array
from symbolic.errors import OutsideError, SettingsError, WorkcellError
from symbolic.read.cell import load as load_cell
from symbolic.read.editing import completed
from symbolic.records import Workcell
from symbolic.records.cell import RANGES
from symbolic.records.poses import inverse
from symbolic.records.quantities import GRAVITY

PIECE, SHORTEST = 2.0, 0.5
"""Usual length of the pieces into which holds are cut, and least length of a piece that is used
[s]."""

STILL_MOTION = 0.01
"""Largest motion of a joint in a piece that counts as still [rad or m]."""

RATIO_TIME = 0.2
"""Time over which forces are averaged before the friction ratio is computed [s]."""

LEAST_PATH = 0.02
"""Least distance that the box has to move before the delay between the arms is computed [m]."""

SURE = 3.0
"""Half the width of the ranges that are written, in standard deviations."""

LEAST_MASS, LEAST_CENTRE, LEAST_FRICTION = 0.005, 0.001, 0.10
"""Least ranges of mass (share), centre of mass [m] and friction (share) that are written. Slips
between the same two surfaces scatter by 10 %."""

SAME_BOX = 0.03
"""Largest relative difference of the weighed masses of runs with one box."""


@dataclass(frozen=True)
class EvidenceEntry:
    """One quantity that the runs determine.

    Attributes:
        name: name of the quantity, for messages.
        found: value of the quantity as text.
        key: key in the workcell file that gets the value; '' for none.
    """

    name: str
    found: str
    key: str = ""


@dataclass
class Evidence:
    """Results of a calibration from recorded runs, collected step by step.

    Attributes:
        workcell: the cell.
        runs: names of the recordings.
        entries: the determined quantities.
        faults: faults found in the recordings.
        asks: descriptions of further recordings that would determine the missing quantities.
        tables: changes of the workcell file by table: new values by key, or one such mapping per
            contact.
        ranges: changes of the table `[uncertainty]` by key.
    """

    workcell: Workcell
    runs: tuple[str, ...]
    entries: list[EvidenceEntry] = field(default_factory=list)
    faults: list[Fault] = field(default_factory=list)
    asks: list[str] = field(default_factory=list)
    tables: dict[str, Any] = field(default_factory=dict)
    ranges: dict[str, Any] = field(default_factory=dict)

    def tell(self, name: str, found: str, key: str = "") -> None:
        """Add a quantity that the recordings determine to `entries`.

        Args:
            name: name of the quantity, for messages.
            found: value of the quantity as text.
            key: key in the workcell file that gets the value; '' for none.
        """
        self.entries.append(EvidenceEntry(name, found, key))

    def set_uncertainty(self, name: str, value: Any) -> None:
        """Store a new range for the table `[uncertainty]` in `ranges`.

        Numbers are rounded to four decimals, towards the larger number; negative ones become zero.

        Args:
            name: key in the table `[uncertainty]`.
            value: half-width of the range in the unit of that key: a number or a list.
        """
        up = np.ceil(np.maximum(1e4 * np.asarray(value, dtype=float) - 1e-6, 0.0)) / 1e4
        self.ranges[name] = up.tolist()

    @property
    def changes(self) -> dict[str, Any]:
        """All changes of the workcell file: new values by table of the file and key."""
        if not self.ranges:
            return self.tables
        # A stated table takes what it does not name for exact.
        doubt = self.workcell.uncertainty
        usual = {name: np.asarray(getattr(doubt, name)).tolist() for name in RANGES}
        return self.tables | {"uncertainty": (usual if not doubt.stated else {}) | self.ranges}

    def __str__(self) -> str:
        rows = [("quantity", "found", "written to")]
        rows += [(entry.name, entry.found, entry.key or "a comment") for entry in self.entries]
        told = [text_table(rows)] if self.entries else []
        told += [f"{'refused' if f.serious else 'warning'}: {f}" for f in self.faults]
        told += [f"to record: {ask}" for ask in self.asks]
        return "\n".join(told)

    @property
    def document(self) -> dict[str, Any]:
        """The runs, results, faults, requests for further recordings, and changes, as JSON values
        by name.
        """
        return {
            "runs": list(self.runs),
            "entries": [vars(entry) for entry in self.entries],
            "faults": [vars(fault) for fault in self.faults],
            "asks": self.asks,
            "changes": self.changes,
        }


def calibrate(workcell: Workcell, runs: Sequence[Recording]) -> Evidence:
    """Determine sensors, payload, friction and force tracking of a cell from recorded runs.

    Args:
        workcell: the cell.
        runs: recorded runs, all with the same box.

    Raises:
        SettingsError: the runs have boxes of different weight.
    """
    masses = [run.labels.mass for run in runs if run.labels.mass is not None]
    if masses and max(masses) > (1.0 + SAME_BOX) * min(masses):
        raise SettingsError(
            f"runs of boxes of {min(masses):g} and {max(masses):g} kg; calibrate with one box"
        )
    evidence = Evidence(workcell, tuple(run.name for run in runs))
    sound = []
    for run in runs:
        motion, offsets = tared(run, pad_motion(workcell, run))
        faults = recording_faults(workcell, run, motion)
        evidence.faults += faults
        if not any(fault.serious for fault in faults):
            _tell_offsets(run, offsets, evidence)
            sound.append((run, motion))
    load = _load(sound, evidence)
    if not any(fault.serious and not fault.run for fault in evidence.faults):
        _friction(sound, load, evidence)
        _tracking(sound, evidence)
        _drift(sound, evidence)
    return evidence


# --- sensors and load ---


def _tell_offsets(run: Recording, offsets: Array, evidence: Evidence) -> None:
    for i in range(2):
        told = ", ".join(number(value, 2) for value in offsets[:, i, :3].mean(axis=0))
        moved = np.ptp(offsets[:, i, :3], axis=0).max()
        drift = f", drift {moved:.2f} N" if len(offsets) > 1 else ""
        evidence.tell(f"{run.name}, offset of arm {i + 1}", f"{told} N{drift}")


def _pieces(run: Recording, motion: PadMotion) -> list[MeasuredHold]:
    """Cut the labelled holds of a run into pieces in which the box is still and no sample is
    missing.

    Args:
        run: the run.
        motion: pad poses and wrenches of the run.

    Returns:
        Mean measurement of each piece.
    """
    found = []
    for begin, end in run.labels.held:
        if any(a < end and b > begin for a, b in run.lost):
            continue
        if not run.labels.empty and vanished(motion.normal[run.within(begin, end)]).any():
            continue
        count = max(1, round((end - begin) / PIECE))
        edges = np.linspace(begin, end, count + 1)
        for first, last in pairwise(edges):
            inside = run.within(first, last)
            if last - first < SHORTEST or np.count_nonzero(inside) < 5:
                continue
            if max(np.ptp(q[inside], axis=0).max() for q in run.joints) > STILL_MOTION:
                continue
            middle = np.flatnonzero(inside)[np.count_nonzero(inside) // 2]
            T_world_box = motion.box[middle]
            pads = np.array([inverse(T_world_box) @ pad for pad in motion.pads[middle]])
            wrench = np.nan_to_num(motion.wrench[inside].mean(axis=0))
            gravity = T_world_box[:3, :3].T @ GRAVITY
            found.append(MeasuredHold(pads, gravity, wrench, run.labels.mass))
    return found


def _empty(run: Recording, pieces: list[MeasuredHold], evidence: Evidence) -> None:
    """Determine the largest force that the sensors show in a run without a box.

    The force counts as a fault if it is too large.

    Args:
        run: the run.
        pieces: measurements of the parts of the run in which the arms are still.
        evidence: the collected results, to which the force is added.
    """
    if not pieces:
        return
    most = max(float(np.linalg.norm(piece.wrench[:, :3], axis=1).max()) for piece in pieces)
    evidence.tell(f"{run.name}, force of nothing", f"{most:.2f} N at most")
    weight = evidence.workcell.payload.mass * abs(GRAVITY[2])
    if most > LARGEST_RESIDUAL * weight:
        text = f"{most:.1f} N of nothing: have the driver compensate the tool's weight"
        evidence.faults.append(Fault(run.name, "residual", text, serious=False))


Sound = list[tuple[Recording, PadMotion]]
"""Runs without serious faults, each with its pad poses and its wrenches without offsets."""


def _load(sound: Sound, evidence: Evidence) -> Load | None:
    """Determine the payload's mass, centre of mass and crosstalk, as far as the recorded runs
    allow.

    Args:
        sound: recordings without serious faults, each with its pad poses and wrenches.
        evidence: the collected results, to which these are added.

    Returns:
        The estimate; None if there are no holds, or the holds have faults.
    """
    holds, moments = [], True
    for run, motion in sound:
        found = _pieces(run, motion)
        if run.labels.empty:
            _empty(run, found, evidence)
            continue
        holds += found
        moments &= run.has_moments or not found
    if not holds:
        evidence.asks.append("holds of the box at rest, two seconds each, after a tare")
        return None
    load = fit_load(holds, moments)
    faults = load_faults(holds, load, moments)
    evidence.faults += faults
    if faults:
        return None
    source = f"from {len(holds)} holds, {load.residual:.2f} N left"
    share = SURE * float(load.deviations[0]) / load.mass
    if load.is_mass_observable:
        told = f"{load.mass:.3f} kg ± {100.0 * share:.1f} % (3 σ), {source}"
        evidence.tell("mass", told, "payload.mass")
        evidence.set_uncertainty("mass", max(share, LEAST_MASS))
    else:
        text = (
            "mass and crosstalk cannot be told apart; record holds at three squeezes, or state the "
            "mass from a scale"
        )
        names = ", ".join(run.name for run, _ in sound if not run.labels.empty)
        evidence.faults.append(Fault(names, "load not seen", text))
    payload: dict[str, Any] = {"mass": round(load.mass, 4)} if load.is_mass_observable else {}
    spread = load.deviations[1:4]
    if load.is_mass_observable and load.observable_centre.all():
        told = ", ".join(
            f"{1e3 * value:.1f} ± {1e3 * SURE * wide:.1f}"
            for value, wide in zip(load.centre, spread, strict=True)
        )
        evidence.tell("centre of mass", f"{told} mm (3 σ), {source}", "payload.centre_of_mass")
        payload["centre_of_mass"] = np.round(load.centre, 5).tolist()
        evidence.set_uncertainty("centre_of_mass", np.maximum(SURE * spread, LEAST_CENTRE))
    else:
        unseen = [
            axis for axis, seen in zip("xyz", load.observable_centre, strict=True) if not seen
        ]
        evidence.asks.append(
            f"holds tilted by 14 degrees, either way about both level axes, at three squeezes: the "
            f"centre of mass cannot be seen along {', '.join(unseen or 'xyz')}"
        )
    if payload:
        evidence.tables["payload"] = payload
    for i in range(2):
        seen = load.observable_crosstalk[i]
        told = ", ".join(
            f"{value:.3f} ± {SURE * wide:.3f}" if known else "not seen"
            for value, wide, known in zip(
                load.crosstalk[i], load.deviations[4 + 2 * i : 6 + 2 * i], seen, strict=True
            )
        )
        evidence.tell(f"crosstalk of arm {i + 1}", f"{told} N/N along the pad's x, y (3 σ)")
    return load


# --- friction, forces, pads ---


def _friction(sound: Sound, load: Load | None, evidence: Evidence) -> None:
    """Determine bounds of the friction coefficient from recorded runs.

    The lower bound is the largest coefficient that a hold without slip used. The upper bound is the
    least coefficient that was used when the box slipped.

    Args:
        sound: recordings without serious faults, each with its pad poses and wrenches.
        load: the estimated payload, None if unknown.
        evidence: the results, to which both bounds are added.
    """
    if (
        load is None
        or not load.observable_crosstalk.all()
        or not evidence.workcell.has_opposite_pads
    ):
        return
    ratio_of = FrictionRatio(evidence.workcell)
    held: list[tuple[float, str]] = []
    slipped: list[tuple[float, str]] = []
    for run, motion in sound:
        if run.labels.empty or not run.has_moments:
            continue
        wrench = without_crosstalk(motion.wrench, load.crosstalk)

        def ratio(begin: float, run: Recording = run, wrench: Array = wrench) -> float:
            inside = run.within(begin, begin + RATIO_TIME)
            return ratio_of(wrench[inside].mean(axis=0)) if inside.any() else np.nan

        for begin, end in run.labels.held:
            lost = any(a < end and b > begin for a, b in run.lost)
            steps = np.arange(begin, end - RATIO_TIME, RATIO_TIME)
            ratios = [ratio(step) for step in steps if not lost]
            held += [(value, run.name) for value in ratios if np.isfinite(value)]
        slips = [ratio(instant - RATIO_TIME) for instant in run.labels.slip_at]
        slipped += [(value, run.name) for value in slips if np.isfinite(value)]
    if held:
        evidence.tell("friction, greatest held", "{:.3f} in {}".format(*max(held)))
    if slipped:
        evidence.tell("friction, least slipped", "{:.3f} in {}".format(*min(slipped)))
    if not held or not slipped or len({name for _, name in held + slipped}) < 2:
        evidence.asks.append(
            "runs that slip (slip_at) beside others that hold: friction is bracketed by two runs "
            "and more, never told by one"
        )
        return
    low, high = sorted((max(held)[0], min(slipped)[0]))
    middle = (low + high) / 2.0
    share = max((high - low) / 2.0 / middle, LEAST_FRICTION)
    evidence.tell("friction", f"{low:.3f} to {high:.3f}", "contacts.friction")
    evidence.tables["contacts"] = [{"friction": round(middle, 3)}] * 2
    evidence.set_uncertainty("friction", share)


def _tracking(sound: Sound, evidence: Evidence) -> None:
    """Determine how closely the measured normal force follows the commanded one.

    The results are quantiles of measured over commanded force, and the delay of the measured force.

    Args:
        sound: recordings without serious faults, each with its pad poses and wrenches.
        evidence: the collected results, to which these are added.
    """
    worst: list[float] = []
    for i in range(2):
        shares, lags = [], []
        for run, motion in sound:
            commanded, normal = run.commanded[:, i], motion.normal[:, i]
            known = np.isfinite(commanded)
            if not known.any():
                continue
            late = delay(run.time[known], commanded[known], normal[known])
            lags += [] if late is None else [late]
            for begin, end in () if run.labels.empty else run.labels.held:
                inside = run.within(begin, end) & known & (commanded > 1.0)
                shares.append(normal[inside] / np.where(inside, commanded, 1.0)[inside])
        every = np.concatenate(shares) if shares else np.empty(0)
        if not len(every):
            continue
        low, usual, high = np.quantile(every, [0.01, 0.5, 0.99])
        worst.append(float(low))
        told = f"{low:.3f}, {usual:.3f}, {high:.3f} (1, 50, 99 %)"
        evidence.tell(f"force over command, arm {i + 1}", told, "uncertainty.tracking")
        if lags:
            evidence.tell(f"lag of the force, arm {i + 1}", f"{max(lags):.3f} s at most")
    if worst:
        evidence.set_uncertainty("tracking", float(np.clip(1.0 - min(worst), 0.0, 0.9)))


def _drift(sound: Sound, evidence: Evidence) -> None:
    """Determine the relative motion of the pads during holds, and the delay between both arms.

    Args:
        sound: recordings without serious faults, each with its pad poses and wrenches.
        evidence: the results, to which the values are added.
    """
    beside: list[Array] = []
    turned: list[Array] = []
    delays = []
    for run, motion in sound:
        for begin, end in run.labels.held:
            inside = run.within(begin, end)
            if run.labels.empty or np.count_nonzero(inside) < 5:
                continue
            between = np.linalg.inv(motion.pads[inside, 0]) @ motion.pads[inside, 1]
            change = between[0, :3, :3].T @ between[:, :3, :3]
            cosine = (np.trace(change, axis1=1, axis2=2) - 1.0) / 2.0
            turned.append(np.arccos(np.clip(cosine, -1.0, 1.0)))
            beside.append(np.linalg.norm(between[:, :2, 3] - between[0, :2, 3], axis=1))
        path = [
            motion.pads[:, i, :3, :] @ inverse(evidence.workcell.contacts[i].T_box_pad)[:, 3]
            for i in range(2)
        ]
        axis = int(np.argmax(np.ptp(path[0], axis=0)))
        far = float(np.ptp(path[0][:, axis])) >= LEAST_PATH
        late = delay(run.time, path[0][:, axis], path[1][:, axis]) if far else None
        delays += [] if late is None else [late]
    if not beside:
        return
    for name, values, scale, unit, key in (
        ("drift of the pads", np.concatenate(beside), 1e3, "mm", "relative_position"),
        ("turn of the pads", np.concatenate(turned), 1.0, "rad", "relative_angle"),
    ):
        rms, most = float(np.sqrt(np.mean(values**2))), float(np.quantile(values, 0.99))
        told = f"{scale * rms:.2g} {unit} rms, {scale * most:.2g} {unit} (99 %), by the joints"
        evidence.tell(name, told, f"uncertainty.{key}")
        evidence.set_uncertainty(key, most)
    if delays:
        most = max(delays, key=abs)
        evidence.tell("delay of arm 2 after arm 1", f"{most:.3f} s at most")


# --- the file ---


def calibrated_file(source: Path, evidence: Evidence, output: Path) -> str:
    """Return the text of a workcell file with calibrated values. Comments are kept, and the results
    are added as comments.

    Args:
        source: the workcell file.
        evidence: the results.
        output: path at which the text will be stored; paths in it are relative to its folder.

    Raises:
        WorkcellError: the calibrated cell would not be valid.
        SettingsError: the file is written in a form that cannot be changed.
    """
    try:
        text = safe_io.text(safe_io.read_bytes(source, safe_io.WORKCELL_BYTES))
        data = safe_io.toml_tables(text.encode())
    except OutsideError as error:
        raise WorkcellError(str(source), (f"file: {error}",)) from error
    load_cell(source, text=completed(text, data, evidence.changes).encode())
    changed = Problem(source, text, data).completed(evidence.changes, output.parent)
    document = tomlkit.parse(changed)
    told: dict[str, list[str]] = {}
    for entry in evidence.entries:
        told.setdefault(entry.key, []).append(f"{entry.name}: {entry.found}")
    for path, texts in told.items():
        table, _, key = path.partition(".")
        if key:
            places = document[table] if isinstance(document[table], list) else [document[table]]
            for place in places:
                place[key].comment("; ".join(texts))
    head = [f"# Calibrated from {', '.join(evidence.runs)}:"]
    head += [f"#   {entry.name}: {entry.found}" for entry in evidence.entries]
    head += [f"#   {fault}" for fault in evidence.faults]
    return "\n".join(head) + "\n\n" + document.as_string()
