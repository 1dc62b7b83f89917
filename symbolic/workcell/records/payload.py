"""The payload, how it is held, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from symbolic.array import Array
from symbolic.workcell.records.shapes import Box, Cylinder, Mesh


@dataclass(frozen=True)
class Payload:
    """What is carried, called the box.

    Attributes:
        size: (3,) edge lengths along the box axes [m]; of another shape those of a box about the
            frame that holds it.
        mass: [kg].
        centre_of_mass: (3,) in the box frame [m].
        inertia: (3, 3) about the centre of mass, box axes [kg m^2].
        velocity_max, acceleration_max: limits of the box's translation [m/s, m/s^2].
        angular_velocity_max, angular_acceleration_max: of its rotation [rad/s, rad/s^2].
        jerk_max: of its translation [m/s^3], or None without a limit.
        shape: its geometry in the box frame; None for a box of its size.
    """

    size: Array
    mass: float
    centre_of_mass: Array
    inertia: Array
    velocity_max: float
    acceleration_max: float
    angular_velocity_max: float
    angular_acceleration_max: float
    jerk_max: float | None = None
    shape: Cylinder | Mesh | None = None

    @property
    def solid(self) -> Box | Cylinder | Mesh:
        """Its geometry in the box frame."""
        return Box(self.size) if self.shape is None else self.shape


@dataclass(frozen=True)
class Contact:
    """The frictional contact between one robot's pad and the box.

    Attributes:
        T_box_pad: (4, 4), the pad frame in the box frame; its z axis is the contact normal, which
            points into the box.
        friction: Coulomb coefficient.
        patch_radius: radius of a round contact patch, half the diagonal of a rectangular one [m].
        half_sides: half the sides of a rectangular patch along the pad's x and y axes [m]; None
            for a round one.
        further: other pads of the same robot, rigidly beside the first, as on a fork; with its
            friction and its kind of patch.
    """

    T_box_pad: Array
    friction: float
    patch_radius: float
    half_sides: tuple[float, float] | None = None
    further: tuple[Contact, ...] = ()


@dataclass(frozen=True)
class Uncertainty:
    """How far from its nominal value each quantity may be while the robots hold the box.

    Attributes:
        friction: share by which either coefficient may be lower or higher.
        mass: share by which the mass may be lower or higher.
        centre_of_mass: (3,) half the width of its range along the box axes [m].
        pad_position: how far either pad may be displaced in its contact plane [m].
        disturbance: (3,) largest acceleration of the box beside the motion's, along the world's
            axes, either way [m/s^2].
    """

    friction: float = 0.0
    mass: float = 0.0
    centre_of_mass: Array = field(default_factory=lambda: np.zeros(3))
    pad_position: float = 0.0
    disturbance: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def is_empty(self) -> bool:
        """Whether nothing may be different from what the workcell says."""
        ranges = (self.friction, self.mass, self.pad_position)
        return not (any(ranges) or self.centre_of_mass.any() or self.disturbance.any())

    def scaled(self, factor: float) -> Uncertainty:
        """All ranges times a factor."""
        return Uncertainty(
            factor * self.friction,
            factor * self.mass,
            factor * self.centre_of_mass,
            factor * self.pad_position,
            factor * self.disturbance,
        )
