"""A second opinion on a polished timing: the tenfold grid, and the independent `time_path`."""

from __future__ import annotations

import numpy as np

from hybrid_opt.timing.drive import Driver
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.refined import drive_path
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array

AGREEMENT = 5e-3
"""Largest relative difference of both timings' durations."""


def second_opinion(driver: Driver, model: TimingModel, x: Array) -> str:
    """Why the timing of a decision vector (n_var,) is not believed, empty where it is.

    Args:
        model: of the driver's workcell and intervals.
    """
    (timing,) = driver.timings(np.asarray(x)[None])
    if not timing.ok:
        return f"no timing: {timing.status}"
    motion, limits = model.path_motion(x), driver.limits(float(x[-1]))
    driven = drive_path(model, x, timing.grid_speed, limits, motion)
    if not driven.ok:
        return f"on the tenfold grid: {driven.reason}"
    other = time_path(model, x, limits, motion)
    if not other.ok:
        return f"the independent timing: {other.reason}"
    if abs(timing.duration / other.duration - 1.0) > AGREEMENT:
        return f"the independent timing takes {other.duration:.3f} s, not {timing.duration:.3f} s"
    return ""
