"""Options that decide a bundle beside the job itself."""

from __future__ import annotations

from dataclasses import dataclass

from hybrid_opt.job.compliance import require_delay, require_stiffness


@dataclass(frozen=True)
class BundleOptions:
    """How a job is written.

    Attributes:
        step: time between samples [s]; None for the form's own.
        per_arm: ROS 2: one trajectory and one controller per arm instead of one for both.
        any_arm: write a maker's own language for arms that do not look like that maker's.
        stiffness: of each arm at its pad, for what a skew and position control do [N/m].
        skew: between the starts of both arms that the job has to survive [s]; None for what the
            form leaves to chance (`hybrid_opt.store.export.start`).
    """

    step: float | None = None
    per_arm: bool = False
    any_arm: bool = False
    stiffness: float = 1e4
    skew: float | None = None

    def __post_init__(self) -> None:
        require_stiffness(self.stiffness)
        if self.skew is not None:
            require_delay(self.skew)
