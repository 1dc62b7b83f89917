"""Carries of other people's tasks: proposed, studied, beside the figures that they published."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cma
import numpy as np

import hybrid_opt as ho
from hybrid_opt.display.table import Table, number
from hybrid_opt.errors import NoHoldError, ProposalError
from hybrid_opt.evaluate.evaluation import concatenated
from hybrid_opt.extras.proposing.proposal import worked
from hybrid_opt.extras.proposing.ranking import fastest_carry
from hybrid_opt.extras.proposing.trial import judge_of
from hybrid_opt.extras.proposing.via_points import path_length
from studies.research.turns import progress
from symbolic.array import Array
from symbolic.cell_model import build_cell_bodies
from symbolic.errors import OutsideError, SettingsError
from symbolic.read.cell import load
from symbolic.read.editing import completed
from symbolic.safe_io import replace_file

STUDY_EVALUATIONS = 1000
"""Number of evaluations of the search for the fastest carry."""

SHORT_EVALUATIONS, OFFSPRING = 4000, 20
"""Number of evaluations of the search for the shortest carry, in all and per generation."""

SHORT_STEP = 0.1
"""First step size of the search for the shortest carry, as a share of the bounds."""

CHECKS, TOGETHER = 4000, 200
"""Number of configurations with which the rate of collision checks is measured, in all and per
call."""

PAD_FRICTION = 0.8
"""Friction of every pad."""


@dataclass(frozen=True)
class BenchmarkTask:
    """One carry of a benchmark.

    Attributes:
        name: name of the task, in the table and in file names.
        problem: tables of the problem file.
        length: length of the published shortest carry [rad], None if none was published.
        straight: straight distance between the published first and last postures, in the published
            coordinates [rad].
        seconds: duration of the published fastest carry [s], None if none was published.
    """

    name: str
    problem: dict[str, Any]
    length: float | None = None
    straight: float | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class Benchmark:
    """A set of published tasks.

    Attributes:
        name: name on the command line.
        title: title of the table.
        tasks: the tasks.
        note: text on what else was published, and what cannot be compared.
        coordinates: function from the joints (n, joints) of both arms to the published coordinates
            (n, m) [rad]; by default all joints of both arms.
    """

    name: str
    title: str
    tasks: tuple[BenchmarkTask, ...]
    note: str
    coordinates: Callable[[Array, Array], Array] = lambda q_1, q_2: np.hstack([q_1, q_2])


@dataclass(frozen=True)
class BenchmarkSource:
    """Published files, and the way in which a benchmark is made from them.

    Attributes:
        how: shell commands that fetch the files into FOLDER.
        room: subfolder of FOLDER with the files.
        make: function that returns the benchmark of that subfolder; it raises an `OutsideError` for
            a missing or different file.
    """

    how: str
    room: Path
    make: Callable[[Path], Benchmark]

    def benchmark(self, folder: Path) -> Benchmark:
        """Return the benchmark of the files in a folder.

        Raises:
            SettingsError: files are missing, or differ from the published ones.
        """
        there = folder / self.room
        try:
            return self.make(there)
        except OutsideError as error:
            raise SettingsError(f"{there}: {error}; get the files by\n{self.how}") from error


def carry_problem(
    name: str,
    robots: list[dict[str, Any]],
    payload: dict[str, Any],
    pads: list[dict[str, Any]],
    ends: tuple[list[float], list[float]],
    scene: list[dict[str, Any]],
    **task: float,
) -> dict[str, Any]:
    """Return the tables of a problem file for a carry that begins and ends in the air.

    Args:
        name: name of the cell.
        robots: tables `[[robots]]`.
        payload: table `[payload]`.
        pads: tables `[[contacts]]` without friction.
        ends: start and goal pose (6,) of the box [m, rad].
        scene: tables `[[environment]]`.
        task: further keys of `[task]`.
    """
    return {
        "name": name,
        "robots": robots,
        "payload": payload,
        "contacts": [{"friction": PAD_FRICTION, **pad} for pad in pads],
        "task": {"start": ends[0], "goal": ends[1], **task},
        "handling": {"lift_height": 0.0, "set_down_height": 0.0},
        "environment": scene,
    }


@dataclass(frozen=True)
class Length:
    """Length of the joint path of a carry; NaN without a carry.

    Attributes:
        joints: length over all joints of both arms [rad].
        theirs: length in the coordinates of the authors who published the task [rad].
    """

    joints: float = math.nan
    theirs: float = math.nan


@dataclass(frozen=True)
class TaskResult:
    """Results of one task.

    Attributes:
        task: the task.
        refused: reason why no carry was found, '' if one was.
        held: True if the box can be held at start and goal.
        workcell: the proposed workcell file, None without one.
        certified, seconds: working time until the first certified carry, and until the file was
            complete [s].
        first: length of the proposed carry.
        fastest, shortest: lengths of the fastest and the shortest carry of a study.
        duration, force: duration [s] and commanded force [N] of the fastest carry.
    """

    task: BenchmarkTask
    refused: str = ""
    held: bool = True
    workcell: Path | None = None
    certified: float | None = None
    seconds: float | None = None
    first: Length = Length()
    fastest: Length = Length()
    shortest: Length = Length()
    duration: float | None = None
    force: float | None = None


def measured(
    benchmark: Benchmark,
    task: BenchmarkTask,
    output: Path,
    settings: ho.ProposeSettings,
    seed: int,
    study: bool,
) -> TaskResult:
    """Propose a carry for one task, and return its length and the working times. The problem file
    and the proposed workcell file are written.

    Args:
        benchmark: benchmark with the task.
        task: the task.
        output: folder for the files.
        settings: settings of the proposal.
        seed: seed of all searches.
        study: True to search for the fastest and the shortest carry also.
    """
    output.mkdir(parents=True, exist_ok=True)
    path = output / f"{benchmark.name}-{re.sub('[ /]', '-', task.name)}.toml"
    replace_file(path, completed("", {}, task.problem).encode())
    progress(f"{task.name}: a first carry")
    try:
        proposal = ho.propose(path, rng=np.random.default_rng(seed), settings=settings)
    except ProposalError as error:
        progress(f"{task.name}: {error}")
        return TaskResult(task, str(error), not isinstance(error, NoHoldError))
    progress(f"{task.name}: {proposal}")
    workcell = path.with_name(f"{path.stem}-proposed.toml")
    replace_file(workcell, proposal.text(output).encode())
    first = length(benchmark, proposal.q)
    found = TaskResult(task, "", True, workcell, proposal.certified, proposal.seconds, first)
    if not study:
        return found
    progress(f"{task.name}: the fastest carry")
    fastest = fastest_carry(ho.Cell.load(workcell), STUDY_EVALUATIONS, np.random.default_rng(seed))
    progress(f"{task.name}: the shortest carry")
    shortest = shortest_carry(workcell, np.random.default_rng(seed))
    return replace(
        found,
        fastest=length(benchmark, _joints(fastest)),
        shortest=length(benchmark, _joints(shortest)),
        duration=fastest.duration,
        force=float(fastest.peak_normal_force.max()),
    )


def shortest_carry(workcell: Path, rng: np.random.Generator) -> ho.Carry:
    """Search for the carry with the shortest joint path by CMA-ES (Hansen, arXiv 1604.00772).

    The search stays within the bounds of the free waypoints and starts at the cell's initial
    trajectory. The carry is feasible and certified free of collisions.

    Args:
        workcell: path of the workcell file.
        rng: source of the random numbers.
    """
    cell = ho.Cell.load(workcell, ("joint_length",))
    task = cell.workcell.task
    lower, width = task.lower, task.upper - task.lower
    begin = (cell.initial - lower) / width
    options = {"bounds": [0.0, 1.0], "seed": int(rng.integers(1, 2**31)), "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(begin, SHORT_STEP, {**options, "popsize": OFFSPRING})
    tried = [cell.evaluate(cell.initial)]
    for _ in range(SHORT_EVALUATIONS // OFFSPRING):
        asked = strategy.ask()
        tried.append(cell.evaluate(lower + np.array(asked) * width))
        strategy.tell(asked, tried[-1].penalised[:, 0].tolist())
        if strategy.stop():
            break
    every = concatenated(tried)
    shortest = np.argsort(np.where(every.feasible, every.penalised[:, 0], np.inf), kind="stable")
    # The cell's own carry, which is certified, is among them.
    certified = cell.evaluator.certified
    best = next(k for k in shortest if certified(cell.evaluate(every.x[k])).feasible.all())
    return cell.carry(every.x[best])


def _joints(carry: ho.Carry) -> tuple[Array, Array]:
    return carry.arms[0].q, carry.arms[1].q


def length(benchmark: Benchmark, q: tuple[Array, Array]) -> Length:
    """Return the length of a path in joint space and in the coordinates of the publication.

    Args:
        benchmark: benchmark that defines these coordinates.
        q: joint positions (n, joints) of both arms along the path.
    """
    return Length(path_length(np.hstack(q)), path_length(benchmark.coordinates(*q)))


def checks_per_second(workcell: Path, rng: np.random.Generator) -> float:
    """Measure how many random configurations of both arms the collision check of a proposal decides
    per second of working time.

    No compiled functions are used.

    Args:
        workcell: path of the workcell file.
        rng: source of the configurations.
    """
    cell = load(workcell)
    judge = judge_of(build_cell_bodies(cell))
    q_1, q_2 = (
        rng.uniform(arm.lower, arm.upper, (CHECKS, arm.joints)) for arm in judge.geometry.arms
    )
    ends = cell.task.waypoints[0].lower, cell.task.waypoints[-1].lower
    pose = np.tile(np.mean(ends, axis=0), (CHECKS, 1))
    begun = worked()
    for few in np.split(np.arange(CHECKS), CHECKS // TOGETHER):
        judge.colliding(pose[few], q_1[few], q_2[few])
    return CHECKS / (worked() - begun)


BENCHMARK_FIGURES: tuple[tuple[str, Callable[[TaskResult], float | None], int], ...] = (
    ("certified [s]", lambda one: one.certified, 1),
    ("file [s]", lambda one: one.seconds, 1),
    ("joints [rad]", lambda one: one.first.joints, 2),
    ("theirs [rad]", lambda one: one.first.theirs, 2),
    ("straight [rad]", lambda one: one.task.straight, 2),
    ("published [rad]", lambda one: one.task.length, 2),
    ("fastest [s]", lambda one: one.duration, 2),
    ("published [s]", lambda one: one.task.seconds, 2),
    ("force [N]", lambda one: one.force, 1),
    ("its theirs [rad]", lambda one: one.fastest.theirs, 2),
    ("shortest: theirs [rad]", lambda one: one.shortest.theirs, 2),
    ("joints [rad]", lambda one: one.shortest.joints, 2),
)
"""Headings, figures and their digits: of the proposal, of what was published, of a study."""


def table(benchmark: Benchmark, found: list[TaskResult], rng: np.random.Generator) -> Table:
    """Return the table of all results of a benchmark beside the published values.

    A note below states the number of carries found, and the rate of collision checks.

    Args:
        benchmark: the benchmark.
        found: result of each task.
        rng: source of the configurations for the rate of checks.
    """
    rows = tuple(
        (one.task.name, *(number(figure(one), digits) for _, figure, digits in BENCHMARK_FIGURES))
        for one in found
    )
    refused = "".join(f" {one.task.name}: {one.refused}." for one in found if one.refused)
    cell = next((one.workcell for one in found if one.workcell is not None), None)
    rate = "" if cell is None else f" {checks_per_second(cell, rng):.0f} collision checks a second."
    note = f"{solved(found)}{rate} {benchmark.note}{refused}"
    headings = ("task", *(heading for heading, _, _ in BENCHMARK_FIGURES))
    return Table(benchmark.name, benchmark.title, headings, rows, note)


def solved(found: list[TaskResult]) -> str:
    """Return a sentence with the number of tasks, of those whose start and goal can be held, and of
    the carries found, and with the times until the carries were certified.
    """
    held = [one for one in found if one.held]
    times = sorted(one.certified for one in found if one.certified is not None)
    told = (
        f"Of {len(found)} the box can be held at both ends in {len(held)}, carried in {len(times)}"
    )
    if not times:
        return f"{told}."
    return (
        f"{told}; certified after {np.median(times):.1f} s in the median, {times[-1]:.1f} at most."
    )
