"""Timing of a carry that real robots can drive: limits judged, timings found and recomputed."""

from hybrid_opt.timing.analysis import (
    ForceCurve,
    TimedTrajectory,
    closest_to_reference_timing,
    drivable_timing,
    duration_against_force_limit,
    judge_timing,
    timed_trajectory,
)
from hybrid_opt.timing.given import drive_path
from hybrid_opt.timing.jerk import time_with_jerk
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.path_timer import PathTimer, PathTiming
from hybrid_opt.timing.records import (
    Excess,
    JerkLimits,
    JerkTiming,
    Place,
    Timing,
    TimingLimits,
    TimingStatus,
)
from hybrid_opt.timing.solve import time_path

__all__ = [
    "Excess",
    "ForceCurve",
    "JerkLimits",
    "JerkTiming",
    "PathTimer",
    "PathTiming",
    "Place",
    "TimedTrajectory",
    "Timing",
    "TimingLimits",
    "TimingModel",
    "TimingStatus",
    "closest_to_reference_timing",
    "drivable_timing",
    "drive_path",
    "duration_against_force_limit",
    "judge_timing",
    "time_path",
    "time_with_jerk",
    "timed_trajectory",
]
