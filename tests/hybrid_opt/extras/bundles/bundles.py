"""The rack's job for every target, made once per test process."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import replace
from functools import cache
from unittest.mock import patch

from hybrid_opt.extras.bundles import TARGETS, BundleOptions
from hybrid_opt.extras.bundles.bundle import prepared
from hybrid_opt.extras.bundles.job_file import Contents, Export
from hybrid_opt.extras.bundles.programs import carry_job as programs
from hybrid_opt.extras.bundles.programs.bring_up import FILE, Measured
from hybrid_opt.job.records import Job
from symbolic.records import Driver
from tests.hybrid_opt.job.jobs import rack_job

DRIVER = Driver("192.168.0.10", None, None, 0.03, force_control=True, stiffness=1e4)
"""What every target is content with."""

STEPS = {"ur-script": 0.008}


def driven(job: Job, driver: Driver = DRIVER) -> Job:
    """A job of a cell whose robots have a driver."""
    first, second = (replace(robot, driver=driver) for robot in job.workcell.robots)
    return replace(job, workcell=replace(job.workcell, robots=(first, second)))


@cache
def rack_driven() -> Job:
    return driven(rack_job())


@cache
def exported(target: str, driver: str = "simulation") -> Export:
    """The rack's job as a target takes it, at 0.05 s steps where the target allows that.

    Args:
        driver: of the target torque, whatever the makers of the arms.
    """
    options = BundleOptions(step=STEPS.get(target, 0.05), any_arm=True)
    with patch("hybrid_opt.extras.bundles.targets.driver_of", return_value=driver):
        return prepared(rack_driven(), target, options)


@cache
def contents(target: str, driver: str = "simulation") -> Contents:
    """The files of a bundle by path."""
    with patch("hybrid_opt.extras.bundles.torque.driver_of", return_value=driver):
        return TARGETS[target].files(exported(target, driver))


def as_planned(files: Contents, sign: float = 1.0) -> Contents:
    """A bundle of arms that its bring-up found to be as they were planned.

    Args:
        sign: of the force that sensors read where pads press.
    """
    text = files["job.json"]
    assert isinstance(text, str)
    config = json.loads(files.get("config/egm.json") or files["config/cell.json"])
    lines = [f'job = "{hashlib.sha256(text.encode()).hexdigest()}"']
    for driver in config["plan"]["drivers"]:
        stiffness = config["plan"]["stiffness"] or math.nan
        found = Measured(driver["lag"], 0.0, 1.0, 0.0, sign, stiffness, 1.0)
        lines += ["[[robots]]", "[robots.measured]"]
        lines += [f"{name} = {value}" for name, value in vars(found).items()]
    return {**files, FILE: "\n".join(lines)}


@cache
def read_job() -> programs.Job:
    """The rack's job as all programs read it."""
    return programs.Job(json.loads(text_of("data", "job.json")))


def text_of(target: str, name: str, driver: str = "simulation") -> str:
    found = contents(target, driver)[name]
    assert isinstance(found, str)
    return found
