"""Sensitivities of a carry's force and duration to every number of a workcell file.

The path is fixed. The box follows it under the task's time law, or as fast as the limits allow. The
force is the largest commanded force along the carry, which holds the box in every case of the
cell's uncertainty, as in a recommendation.

The formula of the force has exact derivatives with respect to its inputs
(`hybrid_opt.robust.path_force`), and so has the duration under a time law. The change of the
fastest duration follows from the slacks of its limits at unchanged path speeds
(`hybrid_opt.timing.robustness`). How these inputs and slacks depend on a number of the file is
computed by differences between two neighbouring cells, in which the number is lower and higher.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_opt.carry import BoxMotion, Carry
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.display_protocol import Displayable
from hybrid_opt.progress import ShowProgress, track
from hybrid_opt.robust.cases import LEADER
from hybrid_opt.robust.path_force import GoverningForce
from hybrid_opt.timing.model import CarryLimits, TimingModel
from hybrid_opt.timing.records import Timing
from hybrid_opt.timing.robustness import TimingSensitivity
from symbolic import safe_io
from symbolic.array import Array
from symbolic.errors import SettingsError, WorkcellError
from symbolic.parameters import WorkcellParameters
from symbolic.path.spline import path_basis, sample_basis, waypoints_of
from symbolic.path.time_law import timed_path
from symbolic.read.cell import changed
from symbolic.records import Workcell

NUMBER_STEP = 1e-5
"""Half the difference of a number between the two neighbouring cells from which derivatives are
computed, in the number's unit."""

LEAST_EFFECT = 1e-7
"""Least relative change of force or duration by a usual change of a number with which the number is
listed."""

POSE_UNITS = ("m",) * 3 + ("rad",) * 3

PAYLOAD_UNITS = {
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
CONTACT_UNITS = {
    "xyz": "m",
    "normal": "",
    "spin": "rad",
    "friction": "",
    "patch_radius": "m",
    "patch_size": "m",
}
ROBOT_UNITS = {
    "base.xyz": "m",
    "base.rpy": "rad",
    "pad.xyz": "m",
    "pad.rpy": "rad",
    "velocity_max": "rad/s",
    "acceleration_max": "rad/s^2",
    "torque_max": "N m",
}
TASK_UNITS = {
    "start": POSE_UNITS,
    "goal": POSE_UNITS,
    "reference_speed": "m/s",
    "reference_angular_speed": "rad/s",
    "ramp_time": "s",
}
UNCERTAINTY_UNITS = {
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
"""Units of the entries of [uncertainty] by key. For sliding joints m stands for rad, and N for N
m."""

USUAL_CHANGES = {
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
"""Size of a usual change of a number by unit. Sensitivities are sorted and shown for this
change."""


@dataclass(frozen=True)
class Sensitivity:
    """Effect of one number of the workcell file on a carry's force and duration.

    Attributes:
        key: key path in the workcell file, with an index for one entry of an array.
        value: value of the number [unit].
        unit: unit of the number, as text.
        force: change of the force per unit by which the number rises [N/unit].
        lowered_force: change of the force per unit by which the number falls [N/unit]; it differs
            from `-force` where another case of the uncertainty then decides the force.
        duration: change of the duration per unit by which the number rises [s/unit]; None if it
            cannot be computed.
        lowered_duration: change of the duration per unit by which the number falls [s/unit]; None
            if it cannot be computed.
    """

    key: str
    value: float
    unit: str
    force: float
    lowered_force: float
    duration: float | None
    lowered_duration: float | None

    @property
    def change(self) -> float:
        """Usual change of a number with this unit: 0.001 m, 0.1 kg, 1 N and so on [unit]. Effects
        of numbers with different units are compared by it.
        """
        return float(USUAL_CHANGES[self.unit])


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities(Displayable):
    """Effects of the numbers of a workcell file on a carry's force and duration. Numbers without
    effect are left out.

    Attributes:
        workcell: the cell.
        force: largest commanded force along the carry that holds the box in every case of the
            uncertainty [N].
        duration: duration of the carry [s].
        rows: effect of each number, the largest effect of a usual change first.
        missing: for each number whose effect on the force or the duration cannot be computed, the
            reason, by key.
    """

    workcell: Workcell
    force: float
    duration: float
    rows: tuple[Sensitivity, ...]
    missing: Mapping[str, str]

    def __getitem__(self, key: str) -> Sensitivity:
        """Return the effect of one number of the workcell file.

        Args:
            key: key path of the number, as in `Sensitivity.key`.

        Raises:
            KeyError: the number has no effect, or its effect cannot be computed.
        """
        return {row.key: row for row in self.rows}[key]


@dataclass(frozen=True)
class _Number:
    """One number of a workcell file.

    Attributes:
        path: key path in the workcell file.
        index: position of the number in an array, None for a single number.
        value: value of the number [unit].
        unit: unit of the number, as text.
        whole: value of the key in the file, a number or an array.
    """

    path: str
    index: int | None
    value: float
    unit: str
    whole: Any

    @property
    def key(self) -> str:
        return self.path if self.index is None else f"{self.path}[{self.index}]"

    @property
    def section(self) -> str:
        return self.path.partition(".")[0].partition("[")[0]

    @property
    def is_limit(self) -> bool:
        return self.path.endswith("_max")

    def moved(self, workcell: Workcell, by: float) -> Workcell:
        if self.index is None:
            return changed(workcell, {self.path: self.value + by})
        values = np.array(self.whole, dtype=float)
        values[self.index] += by
        return changed(workcell, {self.path: values})


def sensitivities(carry: Carry | Timing, *, progress: ShowProgress = False) -> Sensitivities:
    """Compute the derivatives of a carry's largest commanded force and duration with respect to all
    numbers of its workcell file.

    How the motion changes with a number depends on what is given:

    - A carry under a time law follows the law in the changed cell.
    - For the fastest timing of a path, the derivative of the duration is that of the fastest timing
      of the same path in the changed cell. The derivative of the force is that with unchanged path
      speeds.

    Args:
        carry: a carry under the time law of its task, or the fastest timing of a path within
            limits.
        progress: True for a progress bar, or a function that is called with the number of file
            numbers done and their total.

    Raises:
        SettingsError: the carry has another timing; or the given timing is not the fastest, or
            limits robust normal forces (which hold the box in every case of the uncertainty)
            instead of planned ones; or no force holds the box in every case.
    """
    drive = _Law(carry) if isinstance(carry, Carry) else _Fastest(carry)
    workcell, ruling = drive.carry.workcell, GoverningForce(drive.carry, LEADER)
    rows, missing = [], {}
    for number in track(progress, "sensitivities", list(_numbers(workcell))):
        if number.section == "uncertainty" and number.value == 0.0:
            missing[number.key] = "zero: a range begins or ends there"
            continue
        if not drive.moved_by(number) and number.section == "robots":
            continue
        try:
            low, high = (number.moved(workcell, by) for by in (-NUMBER_STEP, NUMBER_STEP))
        except WorkcellError as error:
            missing[number.key] = str(error).splitlines()[-1].strip(" -")
            continue
        longer: tuple[float | None, float | None] = (0.0, 0.0)
        if drive.is_compiled_with(number, high):
            longer, missing[number.key] = (
                (None, None),
                "duration: another structure, to be compiled",
            )
        elif drive.moved_by(number):
            changes = drive.durations(number, low, high)
            longer = changes[0] / NUMBER_STEP, changes[1] / NUMBER_STEP
            if not np.isfinite(changes).all():
                longer, missing[number.key] = (None, None), "duration: no timing nearby holds"
        rise = fall = 0.0
        if number.section != "robots":
            motions = drive.motion(low, ruling.samples), drive.motion(high, ruling.samples)
            rise, fall = ruling.slopes(low, high, motions, number.section == "contacts")
        forces = rise / NUMBER_STEP, fall / NUMBER_STEP
        rows.append(Sensitivity(number.key, number.value, number.unit, *forces, *longer))
    duration = drive.carry.duration

    def size(row: Sensitivity) -> float:
        harder = max(abs(row.force), abs(row.lowered_force)) / ruling.force
        longer = max(abs(row.duration or 0.0), abs(row.lowered_duration or 0.0)) / duration
        return row.change * max(harder, longer)

    told = tuple(
        sorted((row for row in rows if size(row) > LEAST_EFFECT), key=lambda row: -size(row))
    )
    return Sensitivities(workcell, ruling.force, duration, told, missing)


class _Law:
    """Changes of a carry under its task's time law in neighbouring cells."""

    def __init__(self, carry: Carry) -> None:
        if carry.timing not in ("constant", "ramped"):
            raise SettingsError(
                f"a carry under the timing {carry.timing!r}; give the timing itself, as of "
                "ho.time_path, or a carry of Cell.carry under the time law 'constant' or 'ramped'",
                code="timing",
            )
        self.carry = carry

    def moved_by(self, number: _Number) -> bool:
        """Return True if the box motion or its duration may depend on a number of the workcell
        file.
        """
        return number.section == "task"

    def is_compiled_with(self, number: _Number, workcell: Workcell) -> bool:
        """Return False: the duration in a cell with another value of a number never needs newly
        compiled functions, because the time law is interpreted.

        Args:
            number: the number.
            workcell: the cell with its other value.
        """
        return False

    def durations(self, number: _Number, low: Workcell, high: Workcell) -> tuple[float, float]:
        """Compute the changes of the duration [s] from the present cell to two neighbouring cells.

        Args:
            number: the number that differs.
            low, high: cells with a lower, and an equally much higher, value of the number.

        Returns:
            Change towards `high`, and change towards `low`.
        """
        before, after = (float(self._driven(cell)[0][-1, 0]) for cell in (low, high))
        return (after - before) / 2.0, (before - after) / 2.0

    def motion(self, workcell: Workcell, samples: NDArray[np.intp]) -> BoxMotion:
        """Compute the box motion in another cell at some samples of the carry.

        Args:
            workcell: the other cell.
            samples: (m,) indices of the samples.
        """
        return BoxMotion(*[part[samples] for part in self._driven(workcell)[1:]])

    def _driven(self, workcell: Workcell) -> list[Array]:
        task = workcell.task
        points = waypoints_of(task, self.carry.x)
        path = timed_path(task, sample_basis(task), ca.MX(ca.DM(points.T)))
        parts = (path.time, path.pose, path.rate, path.second_rate)
        return [np.array(ca.evalf(part)).T for part in parts]


class _Fastest:
    """Changes of the fastest timing of a path in neighbouring cells.

    The path speeds are fixed. The change of the duration follows from the ratios of all values to
    their limits at these speeds.
    """

    def __init__(self, timing: Timing) -> None:
        if timing.limits.robust:
            raise SettingsError(
                "the timing limits robust forces; give one within a limit of planned ones, or none",
                code="robust-timing",
            )
        if timing.carry is None:
            raise SettingsError(f"there is no timing: {timing.reason}")
        self.carry, self._limits = timing.carry, timing.limits
        self._compiled = CompiledCell(self.carry.workcell)
        self._digest = WorkcellParameters(self.carry.workcell).workcell_digest
        self._near = TimingSensitivity(TimingModel(self._compiled), timing)

    def moved_by(self, number: _Number) -> bool:
        """Return True if the box motion or its duration may depend on a number of the workcell
        file.
        """
        return number.section != "uncertainty"

    def is_compiled_with(self, number: _Number, workcell: Workcell) -> bool:
        """Return True if a cell with another value of a number needs newly compiled functions.

        It does if an upright base becomes tilted, or if pads whose normals are not opposite move.

        Args:
            number: the number.
            workcell: the cell with its other value.
        """
        if number.is_limit or not self.moved_by(number):
            return False
        return WorkcellParameters(workcell).workcell_digest != self._digest

    def durations(self, number: _Number, low: Workcell, high: Workcell) -> tuple[float, float]:
        """Compute the changes of the duration [s] from the present cell to two neighbouring cells.

        Args:
            number: the number that differs.
            low, high: cells with a lower, and an equally much higher, value of the number.

        Returns:
            Change towards `high`, and change towards `low`.
        """
        before, after = (self._ratios(number, cell) for cell in (low, high))
        return self._near.changes(before, after)

    def _ratios(self, number: _Number, workcell: Workcell) -> dict[str, Array]:
        carry = self.carry
        if not number.is_limit:
            model = TimingModel(self._compiled.with_parameters(workcell))
            carry = self._near.speeds.carry(model, model.path_motion(carry.x))
        return CarryLimits(workcell).ratios(carry, self._limits)

    def motion(self, workcell: Workcell, samples: NDArray[np.intp]) -> BoxMotion:
        """Compute the box motion in another cell at some samples of the carry, with unchanged path
        speeds.

        Args:
            workcell: the other cell.
            samples: (m,) indices of the samples.
        """
        points, speeds = waypoints_of(workcell.task, self.carry.x), self._near.speeds
        basis = path_basis(len(points), self.carry.parameter[samples])
        first, second = basis.first @ points, basis.second @ points
        a, w = speeds.a[samples, None], speeds.w[samples, None]
        return BoxMotion(basis.position @ points, first * np.sqrt(w), second * w + first * a)


# --- the numbers of a file ---


def _numbers(workcell: Workcell) -> Iterator[_Number]:
    """Yield all numbers of a workcell whose effects are computed. Their values are those in the
    workcell file, or defaults.
    """
    text = workcell.text or safe_io.read_bytes(workcell.source, safe_io.WORKCELL_BYTES)
    data = safe_io.toml_tables(text)
    yield from _of(data["payload"], "payload", PAYLOAD_UNITS, workcell.payload)
    for i, table in enumerate(data["contacts"]):
        yield from _of(table, f"contacts[{i}]", CONTACT_UNITS)
        for k, pad in enumerate(table.get("further", ())):
            yield from _of(pad, f"contacts[{i}].further[{k}]", CONTACT_UNITS)
    for i, table in enumerate(data["robots"]):
        yield from _of(table, f"robots[{i}]", ROBOT_UNITS, workcell.robots[i])
    yield from _of(data["task"], "task", TASK_UNITS, workcell.task)
    if "uncertainty" in data:
        yield from _of(data["uncertainty"], "uncertainty", UNCERTAINTY_UNITS, workcell.uncertainty)


def _of(
    table: Mapping[str, Any], path: str, units: Mapping[str, Any], record: object = None
) -> Iterator[_Number]:
    for key, unit in units.items():
        stated: Any = table
        for name in key.split("."):
            stated = stated.get(name) if isinstance(stated, Mapping) else None
        value = getattr(record, key, None) if stated is None else stated
        if value is None or isinstance(value, str):  # such as torques that are unknown
            continue
        if np.ndim(value) == 0:
            yield _Number(f"{path}.{key}", None, float(value), str(unit), value)
            continue
        for k, entry in enumerate(value):
            own = unit if isinstance(unit, str) else unit[min(k, len(unit) - 1)]
            yield _Number(f"{path}.{key}", k, float(entry), own, value)
