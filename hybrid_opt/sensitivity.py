"""What every number of a cell does to a carry: derivatives of the force and of the duration.

The path stays, driven by the task's time law. The force is the largest to
command that holds in every case of the cell's uncertainty, as a recommendation commands it. Its
derivatives, and those of a time law's duration, are exact by what formulas take
(`hybrid_opt.robust.slopes`); how that follows from a number of the file is read off two cells
nearby.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_opt.carry import Carry
from hybrid_opt.recommending.choice import LEADER
from hybrid_opt.robust.force import BoxMotion
from hybrid_opt.robust.slopes import RulingForce
from hybrid_opt.shown import Shown
from symbolic import outside
from symbolic.errors import SettingsError, WorkcellError
from symbolic.path.spline import sample_basis
from symbolic.path.time_law import timed_path
from symbolic.read.cell import changed
from symbolic.records import Workcell
from symbolic.records.task import waypoints_of

STEP = 1e-5
"""Half the distance of two cells nearby, in the number's unit."""

LEAST = 1e-7
"""Share of force or duration that a usual change has to move for a number to be told."""

POSE = ("m",) * 3 + ("rad",) * 3

PAYLOAD = {
    "mass": "kg",
    "centre_of_mass": "m",
    "size": "m",
    "radius": "m",
    "length": "m",
    "velocity_max": "m/s",
    "acceleration_max": "m/s^2",
    "angular_velocity_max": "rad/s",
    "angular_acceleration_max": "rad/s^2",
}
CONTACT = {
    "xyz": "m",
    "normal": "",
    "spin": "rad",
    "friction": "",
    "patch_radius": "m",
    "patch_size": "m",
}
ROBOT = {
    "base.xyz": "m",
    "base.rpy": "rad",
    "pad.xyz": "m",
    "pad.rpy": "rad",
    "velocity_max": "rad/s",
    "acceleration_max": "rad/s^2",
    "torque_max": "N m",
}
TASK = {
    "start": POSE,
    "goal": POSE,
    "reference_speed": "m/s",
    "reference_angular_speed": "rad/s",
    "ramp_time": "s",
}
UNCERTAINTY = {
    "friction": "",
    "mass": "",
    "centre_of_mass": "m",
    "pad_position": "m",
    "disturbance": "m/s^2",
    "tracking": "",
    "internal_force": "N",
    "tilt": "rad",
    "relative_position": "m",
    "relative_angle": "rad",
    "stiffness": "N/m",
}
"""Units by key; of a joint that slides m stands for rad, and N for N m."""

USUAL = {
    "": 0.01,
    "m": 1e-3,
    "rad": np.pi / 180.0,
    "kg": 0.1,
    "s": 0.1,
    "m/s": 0.01,
    "rad/s": 0.1,
    "m/s^2": 0.1,
    "rad/s^2": 0.1,
    "N": 1.0,
    "N m": 1.0,
    "N/m": 1000.0,
}
"""A usual change by unit: what is compared and shown."""


@dataclass(frozen=True)
class Sensitivity:
    """What one number does.

    Attributes:
        key: in the workcell file; of one entry of an array with its index.
        value: of the number [unit].
        force: of the force per unit that the number rises [N/unit].
        lowered: likewise per unit that it falls; other than `-force` where several cases rule.
        duration: likewise of the duration as the number rises [s/unit].
    """

    key: str
    value: float
    unit: str
    force: float
    lowered: float
    duration: float

    @property
    def change(self) -> float:
        """A usual one [unit]."""
        return float(USUAL[self.unit])


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities(Shown):
    """What the numbers of a cell do to a carry, the largest first; others do nothing.

    Attributes:
        workcell: the cell.
        force: the largest to command that holds in every case of the uncertainty [N].
        duration: of the carry [s].
        rows: by how much a usual change moves force or duration.
        missing: by key why nothing is told of a number.
    """

    workcell: Workcell
    force: float
    duration: float
    rows: tuple[Sensitivity, ...]
    missing: Mapping[str, str]

    def __getitem__(self, key: str) -> Sensitivity:
        """The number of a key.

        Raises:
            KeyError: the number does nothing, or nothing is told of it.
        """
        return {row.key: row for row in self.rows}[key]


@dataclass(frozen=True)
class _Number:
    """A number of a workcell file. index: in an array, None of one alone."""

    path: str
    index: int | None
    value: float
    unit: str
    whole: Any

    @property
    def key(self) -> str:
        return self.path if self.index is None else f"{self.path}[{self.index}]"

    def moved(self, workcell: Workcell, by: float) -> Workcell:
        if self.index is None:
            return changed(workcell, {self.path: self.value + by})
        values = np.array(self.whole, dtype=float)
        values[self.index] += by
        return changed(workcell, {self.path: values})


def sensitivities(carry: Carry) -> Sensitivities:
    """Derivatives of a carry's force and duration by the numbers of its cell.

    Args:
        carry: under the time law of its task.

    Raises:
        SettingsError: it has another timing, or the uncertainty leaves nothing that holds.
    """
    if carry.timing not in ("constant", "ramped"):
        raise SettingsError(
            f"a carry under the timing {carry.timing!r}; give one of Cell.carry under the time law "
            "'constant' or 'ramped'"
        )
    workcell, ruling = carry.workcell, RulingForce(carry, LEADER)
    drive = partial(_driven, carry, ruling.samples)
    rows, missing, (still, duration) = [], {}, drive(workcell)
    for number in _numbers(workcell):
        section = number.path.partition(".")[0].partition("[")[0]
        if section == "robots":
            continue
        if section == "uncertainty" and number.value == 0.0:
            missing[number.key] = "zero: a range begins or ends there"
            continue
        try:
            low, high = (number.moved(workcell, by) for by in (-STEP, STEP))
        except WorkcellError as error:
            missing[number.key] = str(error).splitlines()[-1].strip(" -")
            continue
        ends = [(still, duration)] * 2 if section != "task" else [drive(low), drive(high)]
        motions, pads = (ends[0][0], ends[1][0]), section == "contacts"
        rise, fall = ruling.slopes(low, high, motions, pads)
        longer = (ends[1][1] - ends[0][1]) / 2.0
        slopes = [change / STEP for change in (rise, fall, longer)]
        rows.append(Sensitivity(number.key, number.value, number.unit, *slopes))

    def size(row: Sensitivity) -> float:
        harder = max(abs(row.force), abs(row.lowered)) / ruling.force
        return row.change * max(harder, abs(row.duration) / duration)

    told = tuple(sorted((row for row in rows if size(row) > LEAST), key=lambda row: -size(row)))
    return Sensitivities(workcell, ruling.force, duration, told, missing)


def _driven(carry: Carry, samples: NDArray[np.intp], workcell: Workcell) -> tuple[BoxMotion, float]:
    """The carry's motion at some samples in a cell nearby, and its duration there [s]."""
    task = workcell.task
    points = waypoints_of(task, carry.x)
    path = timed_path(task, sample_basis(task), ca.MX(ca.DM(points.T)))
    parts = (path.time, path.pose, path.rate, path.second_rate)
    time, *motion = (np.array(ca.evalf(part)).T for part in parts)
    return BoxMotion(*[part[samples] for part in motion]), float(time[-1, 0])


# --- the numbers of a file ---


def _numbers(workcell: Workcell) -> Iterator[_Number]:
    """All that are told of, as the file states them, or else with what they are then."""
    text = workcell.text or outside.read_bytes(workcell.source, outside.WORKCELL_BYTES)
    data = outside.toml_tables(text)
    yield from _of(data["payload"], "payload", PAYLOAD, workcell.payload)
    for i, table in enumerate(data["contacts"]):
        yield from _of(table, f"contacts[{i}]", CONTACT)
        for k, pad in enumerate(table.get("further", ())):
            yield from _of(pad, f"contacts[{i}].further[{k}]", CONTACT)
    for i, table in enumerate(data["robots"]):
        yield from _of(table, f"robots[{i}]", ROBOT, workcell.robots[i])
    yield from _of(data["task"], "task", TASK, workcell.task)
    if "uncertainty" in data:
        yield from _of(data["uncertainty"], "uncertainty", UNCERTAINTY, workcell.uncertainty)


def _of(
    table: Mapping[str, Any], path: str, units: Mapping[str, Any], record: object = None
) -> Iterator[_Number]:
    for key, unit in units.items():
        stated: Any = table
        for name in key.split("."):
            stated = stated.get(name) if isinstance(stated, Mapping) else None
        value = getattr(record, key, None) if stated is None else stated
        if value is None:
            continue
        if np.ndim(value) == 0:
            yield _Number(f"{path}.{key}", None, float(value), str(unit), value)
            continue
        for k, entry in enumerate(value):
            own = unit if isinstance(unit, str) else unit[min(k, len(unit) - 1)]
            yield _Number(f"{path}.{key}", k, float(entry), own, value)
