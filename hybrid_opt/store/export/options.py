"""What decides a bundle beside the job itself."""

from __future__ import annotations

from dataclasses import dataclass

from symbolic.errors import SettingsError


@dataclass(frozen=True)
class BundleOptions:
    """How a job is written.

    Attributes:
        step: time between samples [s]; None for the form's own.
        per_arm: ROS 2: one trajectory and one controller per arm instead of one for both.
        any_arm: write a maker's own language for arms that do not look like that maker's.
        stiffness: of each arm at its pad, for what a skew and position control do [N/m].
    """

    step: float | None = None
    per_arm: bool = False
    any_arm: bool = False
    stiffness: float = 1e4

    def __post_init__(self) -> None:
        if not 0.0 < self.stiffness < float("inf"):
            raise SettingsError(f"stiffness {self.stiffness:g} N/m: give a finite positive one")
