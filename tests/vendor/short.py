"""A short job of the rack's arms for faults: a carry of 0.12 m, so slow and so pressed that the box
is held when one arm stops by itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from unittest.mock import patch

import numpy as np

from hybrid_opt.extras.bundles import TARGETS, BundleOptions
from hybrid_opt.extras.bundles.bundle import prepared
from hybrid_opt.extras.bundles.job_file import Contents, Export, pad_errors
from hybrid_opt.extras.bundles.programs.carry_job import HELD
from hybrid_opt.job.plan import JobModel
from hybrid_opt.job.records import Job
from hybrid_opt.robust.squeeze import SqueezeSettings
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array
from symbolic.records import Driver
from tests.hybrid_opt.cells import shipped
from tests.hybrid_opt.extras.bundles.bundles import DRIVER, driven, rack_driven

DISTANCE, APART = 0.12, 0.009
"""Of the carry, and between the pads after one arm's stop [m]."""

SQUEEZE = 2.4
"""Commanded over the least squeeze: friction then holds pads that are `APART` apart."""

HANDLING = {"stand_off": 0.02, "pressing_rate": 300.0, "partner_stop": APART}

STEP = 0.05
"""Of all bundles [s]."""


@cache
def short_job() -> Job:
    """A job on the rack's middle board, towards the front."""
    start = shipped("rack").workcell.task.waypoints[0].lower
    path = start - np.outer(np.linspace(0.0, DISTANCE, 5), np.eye(6)[0])
    changes = {"task.goal": path[-1].tolist(), "task.initial": path[1:-1].tolist()}
    changes |= {f"handling.{key}": value for key, value in HANDLING.items()}
    for k, pose in enumerate(path[1:-1]):
        changes[f"task.waypoints[{k}].lower"] = (pose - 0.02).tolist()
        changes[f"task.waypoints[{k}].upper"] = (pose + 0.02).tolist()
    cell = shipped("rack").changed(changes)
    timing = time_path(cell.timing_model, cell.initial, TimingLimits())
    return JobModel(cell.compiled, cell.timing_model).plan(timing, SqueezeSettings(SQUEEZE))


@dataclass(frozen=True, eq=False)
class Bundle:
    """A bundle and the job that it was written for."""

    files: Contents
    export: Export

    @property
    def stated(self) -> float:
        """Largest distance between the pads after one arm's stop, as the bundle states it [m]."""
        return self.export.partner_stop.distance

    def parted(self, q: Array) -> float:
        """Largest distance [m] by which the pads of a run were off their relative place while they
        held the box.

        Args:
            q: (n, joints) of both arms [rad].
        """
        sampled, away = self.export.sampled, []
        held = [sampled.span(k) for k, p in enumerate(sampled.job.phases) if p.name in HELD]
        first = len(sampled.job.joint_names[0])
        for part in (slice(0, first), slice(first, None)):
            known = sampled.q[:, part]
            far = np.abs(q[:, None, part] - known[None]).max(axis=2)
            away.append(np.argmin(far, axis=1))
        # An arm that has let go, or has not touched yet, holds nothing.
        inside = [(held[0].start < at) & (at < held[-1].stop - 1) for at in away]
        rows = q[inside[0] & inside[1]]
        if not len(rows):
            return 0.0
        along, across = pad_errors(self.export.workcell, rows)
        # Pads that press are closer than planned.
        return float(np.hypot(np.maximum(along, 0.0), across).max())


@cache
def torque(driver: str, is_short: bool) -> Bundle:
    """The torque bundle of the rack's arms for a driver, whatever their makers."""
    job = driven(short_job()) if is_short else rack_driven()
    module = "hybrid_opt.extras.bundles"
    with (
        patch(f"{module}.targets.driver_of", return_value=driver),
        patch(f"{module}.torque.driver_of", return_value=driver),
    ):
        export = prepared(job, "torque", BundleOptions(step=STEP, any_arm=True))
        return Bundle(TARGETS["torque"].files(export), export)


@cache
def egm(driver: Driver, is_short: bool) -> Bundle:
    """The bundle for two ABB arms."""
    job = driven(short_job() if is_short else rack_driven(), driver)
    export = prepared(job, "abb-egm", BundleOptions())
    return Bundle(TARGETS["abb-egm"].files(export), export)


if __name__ == "__main__":
    for made in (torque("franka", True), torque("ur", True), egm(DRIVER, True)):
        print(made.export.partner_stop, made.export.limits, made.export.job.peak_normal_force)
