"""Jobs around hand-made trajectories, planned once per test process."""

from __future__ import annotations

from functools import cache

from hybrid_opt.cell import Cell
from hybrid_opt.job.plan import JobModel
from hybrid_opt.job.records import Job
from hybrid_opt.timing.records import Timing, TimingLimits
from hybrid_opt.timing.solve import time_path
from tests.hybrid_opt.cells import shipped


@cache
def timed(name: str) -> Timing:
    """A cell's hand-made trajectory at the reference speeds."""
    cell = shipped(name)
    return time_path(cell.timing_model, cell.initial, TimingLimits(reference_speed=True))


@cache
def jobs_of(name: str) -> JobModel:
    return JobModel(shipped(name).compiled, shipped(name).timing_model)


@cache
def planned(name: str) -> Job:
    return jobs_of(name).plan(timed(name))


def rack() -> Cell:
    return shipped("rack")


def rack_timing() -> Timing:
    return timed("rack")


def rack_jobs() -> JobModel:
    return jobs_of("rack")


def rack_job() -> Job:
    return planned("rack")
