"""What the last three numbers of a box pose mean: a chart of the rotations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from symbolic.array import Array
from symbolic.workcell.reader import read_only

Rotation = Literal["roll-pitch-yaw", "quaternion"]


@dataclass(frozen=True)
class Orientation:
    """How three numbers [rad] give R_world_box.

    'roll-pitch-yaw', the paper's: Rz(yaw) Ry(pitch) Rx(roll). 'quaternion': a rotation vector v
    along the world's axes, whose unit quaternion (cos |v|/2, sin |v|/2 v/|v|) turns the reference:
    R_world_box = exp(v) R_reference.

    Attributes:
        rotation: which of the two.
        reference: (3, 3), R_world_box at v = 0; of 'quaternion' only.
    """

    rotation: Rotation = "roll-pitch-yaw"
    reference: Array = field(default_factory=lambda: read_only(np.eye(3)))

    @property
    def is_vector(self) -> bool:
        """Whether the numbers are a rotation vector; angles otherwise, each up to full turns."""
        return self.rotation == "quaternion"

    @property
    def components(self) -> tuple[str, str, str]:
        """Names of the three numbers."""
        if self.is_vector:
            return ("rotation x", "rotation y", "rotation z")
        return ("roll", "pitch", "yaw")

    def unwrapped(self, numbers: Array) -> Array:
        """Numbers (n, 3) along a path, angles without jumps of full turns."""
        return numbers if self.is_vector else np.unwrap(numbers, axis=0)
