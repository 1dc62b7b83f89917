"""Allowed range of every quantity in a workcell file.

The ranges are wide for cells of industrial arms and narrow enough that a value in another unit
(mm, degrees, g, kgf, mm/s) falls outside and is refused. docs/reference/workcell.md lists them.
"""

from __future__ import annotations

import math

from symbolic.array import Range

SMALLEST_SIZE = 1e-6
"""Extents below this count as zero [m]: a micrometre, a thousandth of any real wall."""

STANDARD_GRAVITY = 9.80665  # [m/s^2], turns kgf into N

_MILLIMETRES = (("mm", 1e-3),)
_DEGREES = (("deg", math.pi / 180),)
_DEGREES_PER_SECOND = (("deg/s", math.pi / 180),)
_MILLIMETRES_PER_SECOND = (("mm/s", 1e-3),)
_TURN = 2 * math.pi + 1e-9

POSITION = Range(-10.0, 10.0, "m", mistaken=_MILLIMETRES)
ANGLE = Range(-_TURN, _TURN, "rad", mistaken=_DEGREES)
POSE = (POSITION,) * 3 + (ANGLE,) * 3

# The least values are far below any real cell and keep what is divided by them finite.
SHAPE_SIZE = Range(1e-6, 10.0, "m", mistaken=_MILLIMETRES)
SCALE = Range(1e-6, 1000.0)
MESH_SCALE = Range(-1000.0, 1000.0)

PAYLOAD_SIZE = Range(1e-3, 5.0, "m", mistaken=_MILLIMETRES)
MASS = Range(1e-3, 500.0, "kg", mistaken=(("g", 1e-3),))
LINK_MASS = Range(0.0, 10_000.0, "kg")
INERTIA = Range(-1000.0, 1000.0, "kg m^2")
SPEED = Range(1e-3, 10.0, "m/s", mistaken=_MILLIMETRES_PER_SECOND)
ACCELERATION = Range(1e-3, 100.0, "m/s^2", mistaken=(("mm/s^2", 1e-3),))
ANGULAR_SPEED = Range(1e-3, 20.0, "rad/s", mistaken=_DEGREES_PER_SECOND)
JOINT_SPEED = Range(1e-3, 50.0, "rad/s", mistaken=_DEGREES_PER_SECOND)
ANGULAR_ACCELERATION = Range(1e-3, 200.0, "rad/s^2", mistaken=(("deg/s^2", math.pi / 180),))
JERK = Range(1e-1, 1e4, "m/s^3", mistaken=(("mm/s^3", 1e-3),))
ANGULAR_JERK = Range(1e-1, 2e4, "rad/s^3", mistaken=(("deg/s^3", math.pi / 180),))

FRICTION = Range(1e-3, 5.0, mistaken=(("%", 1e-2),))
PATCH_RADIUS = Range(1e-4, 0.5, "m", mistaken=_MILLIMETRES)
PATCH_SIDE = Range(2e-4, 1.0, "m", mistaken=_MILLIMETRES)

LAYER = Range(0.01, 100.0)
SHARE = Range(0.0, 0.9, mistaken=(("%", 1e-2),))
DISPLACEMENT = Range(0.0, 0.5, "m", mistaken=_MILLIMETRES)
DISTURBANCE = Range(0.0, 50.0, "m/s^2", mistaken=(("mm/s^2", 1e-3),))
INTERNAL_FORCE = Range(0.0, 1e4, "N")
TILT = Range(0.0, 0.5, "rad", mistaken=_DEGREES)
ARM_STIFFNESS = Range(0.0, 1e7, "N/m")
PAD_STIFFNESS = Range(100.0, 1e7, "N/m", mistaken=(("N/mm", 1e3),))

JOINT_POSITION = Range(-4 * math.pi, 4 * math.pi, "rad", mistaken=_DEGREES)
LOCKED_POSITION = Range(-4 * math.pi, 4 * math.pi, "rad or m")
TORQUE = Range(1e-3, 1e5, "N m")
MANIPULABILITY = Range(1e-9, 10.0, "m^3")
JOINT_LIMIT = Range(-1e30, 1e30)
JOINT_MOST = Range(0.0, 1e30)
URDF_ANGLE = Range(-2 * _TURN, 2 * _TURN, "rad", mistaken=_DEGREES)
DIRECTION = Range(-1e3, 1e3)

FORCE = Range(1.0, 1e5, "N", mistaken=(("kgf", STANDARD_GRAVITY),))
DURATION = Range(1e-3, 60.0, "s", mistaken=(("ms", 1e-3),))
DEPARTURE = Range(1e-6, 1.0, "m", mistaken=_MILLIMETRES)
TOLERANCE = Range(0.0, 0.1, "m", mistaken=_MILLIMETRES)

STAND_OFF = Range(1e-3, 0.5, "m", mistaken=_MILLIMETRES)
LIFT = Range(0.0, 0.5, "m", mistaken=_MILLIMETRES)
SEPARATION = Range(1e-3, 1.0, "m", mistaken=_MILLIMETRES)
RATE = Range(10.0, 8000.0, "Hz", mistaken=(("kHz", 1e3),))
LAG = Range(0.0, 0.5, "s", mistaken=(("ms", 1e-3),))
FORCE_RATE = Range(1.0, 1e4, "N/s")
GRIP_TIME = Range(0.0, 30.0, "s", mistaken=(("ms", 1e-3),))


GRAVITY = (0.0, 0.0, -9.81)
"""Gravity in the world frame [m/s^2] (paper, below Eq. 34)."""
