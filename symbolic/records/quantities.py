"""The believable range of every quantity in a workcell file.

The ranges are wide for cells of industrial arms and narrow enough that a value in another unit
(mm, degrees, g, kgf, mm/s) falls outside and is refused. docs/workcell.md lists them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Quantity:
    """A physical quantity with the range in which a value is believable.

    Attributes:
        unit: SI unit, empty for a pure number.
        low, high: allowed range, ends included.
        mistaken: units that people write by mistake, each (name, factor to `unit`).
    """

    unit: str
    low: float
    high: float
    mistaken: tuple[tuple[str, float], ...] = ()

    def contains(self, value: float) -> bool:
        """Whether the value is finite and within the range."""
        return math.isfinite(value) and self.low <= value <= self.high

    def allowed(self) -> str:
        """The range in words."""
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.low:g} to {self.high:g}{unit}"

    def suspicion(self, value: float) -> str:
        """Which other unit a value outside the range was probably written in, or ''."""
        for name, factor in self.mistaken:
            if math.isfinite(value) and value != 0 and self.contains(value * factor):
                return (
                    f"; this looks like {name}: {value:g} {name} are "
                    f"{value * factor:.6g} {self.unit}"
                )
        return ""


SMALLEST_SIZE = 1e-6
"""Extents below this count as zero [m]: a micrometre, a thousandth of any real wall."""

STANDARD_GRAVITY = 9.80665  # [m/s^2], turns kgf into N

_MILLIMETRES = (("mm", 1e-3),)
_DEGREES = (("deg", math.pi / 180),)
_DEGREES_PER_SECOND = (("deg/s", math.pi / 180),)
_MILLIMETRES_PER_SECOND = (("mm/s", 1e-3),)
_TURN = 2 * math.pi + 1e-9

POSITION = Quantity("m", -10.0, 10.0, mistaken=_MILLIMETRES)
ANGLE = Quantity("rad", -_TURN, _TURN, mistaken=_DEGREES)
POSE = (POSITION,) * 3 + (ANGLE,) * 3

# The least values are far below any real cell and keep what is divided by them finite.
SHAPE_SIZE = Quantity("m", 1e-6, 10.0, mistaken=_MILLIMETRES)
SCALE = Quantity("", 1e-6, 1000.0)
MESH_SCALE = Quantity("", -1000.0, 1000.0)

PAYLOAD_SIZE = Quantity("m", 1e-3, 5.0, mistaken=_MILLIMETRES)
MASS = Quantity("kg", 1e-3, 500.0, mistaken=(("g", 1e-3),))
LINK_MASS = Quantity("kg", 0.0, 10_000.0)
INERTIA = Quantity("kg m^2", -1000.0, 1000.0)
SPEED = Quantity("m/s", 1e-3, 10.0, mistaken=_MILLIMETRES_PER_SECOND)
ACCELERATION = Quantity("m/s^2", 1e-3, 100.0, mistaken=(("mm/s^2", 1e-3),))
ANGULAR_SPEED = Quantity("rad/s", 1e-3, 20.0, mistaken=_DEGREES_PER_SECOND)
ANGULAR_ACCELERATION = Quantity("rad/s^2", 1e-3, 200.0, mistaken=(("deg/s^2", math.pi / 180),))
JERK = Quantity("m/s^3", 1e-1, 1e4, mistaken=(("mm/s^3", 1e-3),))
ANGULAR_JERK = Quantity("rad/s^3", 1e-1, 2e4, mistaken=(("deg/s^3", math.pi / 180),))

FRICTION = Quantity("", 1e-3, 5.0, mistaken=(("%", 1e-2),))
PATCH_RADIUS = Quantity("m", 1e-4, 0.5, mistaken=_MILLIMETRES)
PATCH_SIDE = Quantity("m", 2e-4, 1.0, mistaken=_MILLIMETRES)

SHARE = Quantity("", 0.0, 0.9, mistaken=(("%", 1e-2),))
DISPLACEMENT = Quantity("m", 0.0, 0.5, mistaken=_MILLIMETRES)
DISTURBANCE = Quantity("m/s^2", 0.0, 50.0, mistaken=(("mm/s^2", 1e-3),))
INTERNAL_FORCE = Quantity("N", 0.0, 1e4)
TILT = Quantity("rad", 0.0, 0.5, mistaken=_DEGREES)
ARM_STIFFNESS = Quantity("N/m", 0.0, 1e7)

JOINT_POSITION = Quantity("rad", -4 * math.pi, 4 * math.pi, mistaken=_DEGREES)
LOCKED_POSITION = Quantity("rad or m", -4 * math.pi, 4 * math.pi)
TORQUE = Quantity("N m", 1e-3, 1e5)
MANIPULABILITY = Quantity("m^3", 1e-9, 10.0)
JOINT_LIMIT = Quantity("", -1e30, 1e30)
JOINT_MOST = Quantity("", 0.0, 1e30)
URDF_ANGLE = Quantity("rad", -2 * _TURN, 2 * _TURN, mistaken=_DEGREES)
DIRECTION = Quantity("", -1e3, 1e3)

# Below 20 N a value is kgf by all likelihood: it would be a hold of less than 2 kg per robot.
FORCE = Quantity("N", 20.0, 1e5, mistaken=(("kgf", STANDARD_GRAVITY),))
DURATION = Quantity("s", 1e-3, 60.0, mistaken=(("ms", 1e-3),))
DEPARTURE = Quantity("m", 1e-6, 1.0, mistaken=_MILLIMETRES)
TOLERANCE = Quantity("m", 0.0, 0.1, mistaken=_MILLIMETRES)

STAND_OFF = Quantity("m", 1e-3, 0.5, mistaken=_MILLIMETRES)
LIFT = Quantity("m", 0.0, 0.5, mistaken=_MILLIMETRES)
RATE = Quantity("Hz", 10.0, 8000.0, mistaken=(("kHz", 1e3),))
LAG = Quantity("s", 0.0, 0.5, mistaken=(("ms", 1e-3),))
FORCE_RATE = Quantity("N/s", 1.0, 1e4)


GRAVITY = (0.0, 0.0, -9.81)
"""Gravity in the world frame [m/s^2] (paper, below Eq. 34)."""
