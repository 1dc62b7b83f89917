"""Cells of the tests, their evaluators and polishers built once per test process."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.polishing.cell import SmoothCell
from hybrid_opt.polishing.drive import DriveStepMethod
from hybrid_opt.polishing.drive_front import DrivePolisher, recheck_timing
from hybrid_opt.polishing.front import Polisher, Solution
from hybrid_opt.polishing.functions import PolishFunctions, polish_functions
from hybrid_opt.polishing.polisher import make_polisher
from hybrid_opt.polishing.settings import DrivableSettings, PolishSettings
from hybrid_opt.timing.candidates import CandidateDriver
from hybrid_opt.timing.model import TimingModel
from symbolic.array import Array
from symbolic.read.cell import load
from symbolic.records import Workcell
from symbolic.records.task import initial_decision
from tests.hybrid_opt.timing.cells import by_toppra
from tests.symbolic.read.samples import RACK


@cache
def drivable_rack() -> Workcell:
    """Timed as robots drive it."""
    return driven(load(RACK))


def driven(cell: Workcell) -> Workcell:
    """A cell of the rack's payload and robots, timed as robots drive it."""
    still = cell.payload.mass * 9.81 / 2.0
    task = replace(cell.task, time_law="optimal", force_limit=(1.001 * still, 117.68))
    return replace(cell, task=task)


@cache
def evaluator() -> CandidateEvaluator:
    """Of the drivable rack."""
    cell = drivable_rack()
    return CandidateEvaluator(cell, DRIVABLE_OBJECTIVES, compiled=CompiledCell(cell))


@cache
def functions() -> PolishFunctions:
    """Of the drivable rack."""
    return polish_functions(evaluator().compiled)


@cache
def polisher() -> Polisher:
    """Of the drivable rack, for small fronts."""
    settings = DrivableSettings(first_rounds=8, rounds=3, members=8)
    return make_polisher(evaluator(), PolishSettings(attempts=4, drivable=settings), functions())


def drive_method() -> DriveStepMethod:
    """Of the drivable rack."""
    return drive_method_of(polisher())


def drive_method_of(owner: Polisher) -> DriveStepMethod:
    """How a polisher of drivable carries polishes one."""
    assert isinstance(owner, DrivePolisher)
    return owner.drive_method


def solved(by: DriveStepMethod, x: Array, rounds: int = 40) -> Solution:
    """Some rounds of a point from a decision vector."""
    return by.solve_from(x).run(rounds)


def disbelieved(driver: CandidateDriver | None, model: TimingModel, x: Array) -> str:
    """Why the timing of a decision vector is not believed: by the tenfold grid, or by the
    independent one."""
    assert driver is not None
    found, other = driver.time_candidate(x).timing, by_toppra(model, x, driver.limits(float(x[-1])))
    if not other.ok or abs(found.duration / other.duration - 1.0) > 5e-3:
        return f"{found.duration:.3f} s, by the independent timing {other.duration:.3f} s"
    return recheck_timing(driver, model, x)


def require_progress(told: list[tuple[int, int]], attempts: int) -> None:
    """Attempts done and in all as a polish tells them: never more than are expected, each once."""
    done, total = np.transpose(told)
    assert np.unique(done).tolist() == list(range(attempts + 1))
    assert (np.diff(done) >= 0).all()
    assert (done <= total).all()
    assert told[-1] == (attempts, attempts)
    # What is expected at first is of the right size.
    assert attempts / 2 <= total[0] <= 2 * attempts


def smooth_cell(judge: CandidateEvaluator) -> SmoothCell:
    """What programs of an evaluator's cell share."""
    return SmoothCell(judge, polish_functions(judge.compiled), PolishSettings().clearance)


def start(force: float, seed: int = 0) -> Array:
    """(n_var,) the hand-made path, moved a little, with a force limit [N]."""
    return start_in(drivable_rack(), force, seed)


def start_in(cell: Workcell, force: float, seed: int) -> Array:
    """The same in another cell."""
    x = initial_decision(cell.task)
    x[:-1] += 0.004 * np.random.default_rng(seed).normal(size=len(x) - 1)
    x[-1] = force
    return np.clip(x, cell.task.lower, cell.task.upper)


def tilted(force: float) -> Array:
    """(n_var,) a fast path that tilts the box until rest nearly uses the patches."""
    x = np.zeros((3, 6))
    x[:, [0, 2, 4]] = [[-0.40, 0.965, 0.48], [-0.29, 1.16, 0.56], [-0.20, 1.19, 0.37]]
    x += 0.001 * np.random.default_rng(0).normal(size=x.shape)
    return np.append(x.ravel(), force)
