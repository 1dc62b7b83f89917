"""The rack's job around the hand-made trajectory, planned once per test process."""

from __future__ import annotations

from functools import cache

from hybrid_opt.cell import Cell
from hybrid_opt.job.plan import JobModel
from hybrid_opt.job.records import Job
from hybrid_opt.timing.records import Timing, TimingLimits
from hybrid_opt.timing.solve import time_path
from tests.hybrid_opt.cells import shipped


def rack() -> Cell:
    return shipped("rack")


@cache
def rack_timing() -> Timing:
    model = rack().timing_model
    return time_path(model, rack().initial, TimingLimits(reference_speed=True))


@cache
def rack_jobs() -> JobModel:
    return JobModel(rack().compiled, rack().timing_model)


@cache
def rack_job() -> Job:
    return rack_jobs().plan(rack_timing())
