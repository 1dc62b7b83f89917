"""Cost of one candidate and how it grows with the cell; core-seconds of a study by part.

A study runs in this process, one stage after the other, under Python's profiler, on functions that
are compiled before. What Python's functions and the libraries' own ones take themselves is summed
up by the room of this project, or the library, that they belong to; `codegen` is the time in
compiled functions. The profiler's own cost is in the figures, most where much Python runs.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import os
import platform
import re
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np

from codegen.build import compile_function
from codegen.interpreted import InterpretedFunction
from hybrid_opt.api import time_path
from hybrid_opt.cell import Cell
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.display.table import number, text_table
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.front import Front, polish, search
from hybrid_opt.polishing.settings import PolishSettings
from studies.research.plain.candidate import PlainEvaluator, PlainJudge
from studies.research.side_by_side import compare, table
from studies.research.turns import (
    POPULATION,
    Evaluate,
    interleaved,
    progress,
    summary,
    with_collisions,
)
from symbolic.array import Array
from symbolic.cell_model import CellModel
from symbolic.functions import candidate_function
from symbolic.read.cell import load
from symbolic.records import Task, Waypoint, Workcell

SAMPLE_COUNTS = (25, 50, 100, 200, 400)
WAYPOINTS = (1, 2, 3, 4, 5, 6, 7, 8)


def benchmark_cell(options: argparse.Namespace) -> int:
    """Measure the cell, the cells or the study that the options request. Return the exit code."""
    if options.study:
        print(study_table(profile_study(_workcell(options.workcell), options.seed)))
        return 0
    if options.beside:
        workcells = [_workcell(path) for path in (options.workcell, *options.beside)]
        cells = [Cell(workcell, threads=1) for workcell in workcells]
        rows = compare(cells, options.candidates, options.repeats, options.seed)
        print(json.dumps(rows, indent=2) if options.json else table(rows))
        return 0
    result = benchmark(
        _workcell(options.workcell), options.candidates, options.repeats, options.seed
    )
    print(json.dumps(result, indent=2) if options.json else report(result))
    return 0


def _workcell(path: Path | None) -> Workcell:
    if path is not None:
        return load(path)
    with as_file(files("studies")) as folder:
        return load(folder / "workcells" / "rack.toml")


def benchmark(
    workcell: Workcell, candidates: int = 10, repeats: int = 3, seed: int = 0
) -> dict[str, Any]:
    """Measure how long the evaluation of a cell's candidates takes: compiled, interpreted and in
    plain Python, at random decision vectors.

    Args:
        workcell: the cell.
        candidates: number of batches of candidates.
        repeats: number of rounds.
        seed: seed of the candidates.

    Returns:
        Facts on cell and machine, and times in milliseconds per candidate, by name.

    Raises:
        CodegenError: there is no compiler.
        DualArmError: the cell has no model.
    """
    progress(f"{workcell.name}: reading the robots, choosing start branches")
    compiled = CompiledCell(workcell)
    model = compiled.model
    one_each = _candidates(workcell.task, candidates, seed)
    batches = np.repeat(one_each[:, None], POPULATION, axis=1)
    batches[:, 1:] = _candidates(workcell.task, candidates * (POPULATION - 1), seed + 1).reshape(
        candidates, POPULATION - 1, -1
    )
    progress("building the evaluator")
    evaluator = CandidateEvaluator(workcell, compiled=compiled)
    ways: dict[str, Evaluate] = {
        "compiled": lambda x: evaluator.evaluate(x, with_collisions=False),
        "interpreted": InterpretedFunction(candidate_function(model)),
        "plain": PlainEvaluator(workcell, model.start),
    }
    progress(f"{candidates * repeats} rounds: {', '.join(ways)}")
    x = {name: batches if name == "compiled" else one_each for name in ways}
    times = interleaved(ways, x, repeats)
    times["compiled"] /= POPULATION
    return {
        "workcell": workcell.name,
        "digest": workcell.digest,
        "samples": workcell.task.samples,
        "free_waypoints": len(workcell.task.free_indices),
        "candidates": candidates,
        "repeats": repeats,
        "seed": seed,
        "machine": {
            "processor": _processor(),
            "cores": os.cpu_count(),
            "system": platform.platform(),
            "python": platform.python_version(),
        },
        **summary(times),
        "with_collisions": with_collisions(
            workcell, PlainJudge(workcell, model.start), candidates, repeats, seed
        ),
        "scaling": _scaling(model, candidates, repeats, seed),
    }


def _scaling(model: CellModel, candidates: int, repeats: int, seed: int) -> dict[str, Any]:
    """Measure how the time of the compiled evaluation grows with the number of samples and of free
    waypoints.

    Args:
        model: model of the cell.
        candidates: number of batches of candidates.
        repeats: number of rounds.
        seed: seed of the candidates.

    Returns:
        Times [ms] by number of samples, the straight line through them, and times by number of free
        waypoints.
    """
    task = model.workcell.task
    by_samples = {n: replace(task, samples=n) for n in SAMPLE_COUNTS}
    by_waypoints = {n: with_free_waypoints(task, n) for n in WAYPOINTS}
    samples = _costs(model, by_samples, candidates, repeats, seed, "samples")
    waypoints = _costs(model, by_waypoints, candidates, repeats, seed, "free waypoints")
    # The line goes through costs relative to the middle one, which turns taken make comparable;
    # relative weights let 25 samples count as much as 400.
    middle = SAMPLE_COUNTS[len(SAMPLE_COUNTS) // 2]
    n = np.array(SAMPLE_COUNTS)
    relative = np.array([np.median(samples[k] / samples[middle]) for k in SAMPLE_COUNTS])
    slope, offset = np.polyfit(n, relative, 1, w=1.0 / relative)
    unit = 1e3 * float(np.median(samples[middle]))
    deviation = np.abs((slope * n + offset) / relative - 1.0).max()
    return {
        "samples": _entries("samples", samples),
        "samples_line": {
            "ms_per_sample": unit * float(slope),
            "fixed_ms": unit * float(offset),
            "largest_relative_deviation": float(deviation),
        },
        "waypoints": _entries("waypoints", waypoints),
    }


def _entries(name: str, costs: Mapping[int, Array]) -> list[dict[str, float]]:
    return [{name: n, "compiled_ms": 1e3 * float(np.median(cost))} for n, cost in costs.items()]


def _costs(
    model: CellModel,
    tasks: Mapping[int, Task],
    candidates: int,
    repeats: int,
    seed: int,
    what: str,
) -> dict[int, Array]:
    """Measure the time per candidate of the compiled evaluator for several sizes of a task, in
    turns.

    Args:
        model: model of the cell, whose task is replaced.
        tasks: the tasks by their size, such as the number of samples.
        candidates: number of candidates.
        repeats: number of rounds.
        seed: seed of the candidates.
        what: what the size counts, for messages, such as 'samples'.

    Returns:
        Times (rounds,) [s] for each size.
    """
    ways: dict[str, Evaluate] = {}
    x: dict[str, Array] = {}
    for n, task in tasks.items():
        progress(f"building the evaluator with {n} {what}")
        sized = replace(model, workcell=replace(model.workcell, task=task))
        ways[str(n)] = compile_function(candidate_function(sized))
        x[str(n)] = _candidates(task, candidates, seed)
    return {int(name): value for name, value in interleaved(ways, x, repeats).items()}


def with_free_waypoints(task: Task, count: int) -> Task:
    """Return the task with `count` free waypoints between start and goal.

    The waypoints are spread evenly along the polygon of the hand-made trajectory. Each may deviate
    as far as the original waypoint with the narrowest bounds.
    """
    points = np.array([waypoint.lower for waypoint in task.waypoints])
    points[list(task.free_indices)] = task.initial
    knots = np.arange(len(points), dtype=float)
    at = np.linspace(0.0, knots[-1], count + 2)[1:-1]
    centres = np.column_stack([np.interp(at, knots, column) for column in points.T])
    spread = (task.upper - task.lower)[: task.n_box]
    half = np.min(np.reshape(spread, (-1, 6)), axis=0) / 2.0
    stretched = np.linspace(0.0, knots[-1], count + 2)
    redundant = [
        replace(
            joint,
            **{
                key: np.interp(stretched, knots, getattr(joint, key))
                for key in ("lower", "upper", "initial")
            },
        )
        for joint in task.redundant
    ]
    return replace(
        task,
        redundant=tuple(redundant),
        waypoints=(
            task.waypoints[0],
            *(Waypoint(centre - half, centre + half) for centre in centres),
            task.waypoints[-1],
        ),
        initial=centres,
    )


def _candidates(task: Task, count: int, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return rng.uniform(task.lower, task.upper, (count, task.n_var))


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())


def report(result: Mapping[str, Any]) -> str:
    """Return the results of `benchmark` as text."""
    machine, scaling, searched = result["machine"], result["scaling"], result["with_collisions"]
    line, random = scaling["samples_line"], searched["random"]
    ways: list[tuple[str, ...]]
    ways = [("way", "no collisions", "over", "of a search", "over", "random", "over")]
    for way in ("compiled", "interpreted", "plain"):
        times = (
            (number(each[f"{way}_ms"], 3), number(each.get(f"{way}_over_compiled", 1.0), 1))
            for each in (result, searched, random)
        )
        ways.append((way, *(cell for pair in times for cell in pair)))
    costs = (
        [(name, "ms"), *((str(e[name]), number(e["compiled_ms"], 3)) for e in scaling[name])]
        for name in ("samples", "waypoints")
    )
    rate = f"{1e-9 * searched['operations_per_second']:.1f} billion operations a second"
    if searched["share_of_peak"] is not None:
        rate += (
            f", {100 * searched['share_of_peak']:.0f} % of the core's peak (counted in the CasADi "
            "functions; the peak is that of independent additions and multiplications, measured)"
        )
    parts = [
        f"{result['workcell']}: {result['samples']} samples, "
        f"{result['free_waypoints']} free waypoints",
        f"{machine['processor']}, Python {machine['python']}; one core, {result['candidates']} "
        f"candidates x {result['repeats']} rounds, seed {result['seed']}",
        "",
        "ms per candidate, and over the compiled way: medians without collisions; means with them",
        f"(candidates of a search of {searched['evaluations']} evaluations, and random ones, in "
        f"batches of {searched['population']})",
        text_table(ways),
        *(f"{name}: {_shares(each)}" for name, each in (("search", searched), ("random", random))),
        rate,
        "",
        "one candidate at a time, without collisions",
        *(text_table(rows, left=()) for rows in costs),
        f"line: {1e3 * line['ms_per_sample']:.2f} us per sample + {1e3 * line['fixed_ms']:.1f} us, "
        f"off by at most {100 * line['largest_relative_deviation']:.0f} %",
    ]
    return "\n".join(parts)


def _shares(figures: Mapping[str, Any]) -> str:
    parts = ", ".join(f"{name} {100 * share:.0f} %" for name, share in figures["shares"].items())
    return f"feasible {100 * figures['feasible_share']:.0f} %; compiled time: {parts}"


COSTED_EVALUATIONS = 1000
POLISH_ATTEMPTS = 4
LEAST_LISTED_SHARE = 0.02
"""Parts of a stage below this share are summed up as 'other'."""

_ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class StageTime:
    """Core-seconds of one stage of a study.

    Attributes:
        name: name of the stage.
        seconds: core-seconds without the profiler.
        parts: core-seconds with the profiler, by part.
    """

    name: str
    seconds: float
    parts: dict[str, float]


def profile_study(workcell: Workcell, seed: int) -> tuple[StageTime, ...]:
    """Measure the core-seconds of three stages of a study.

    These are one replica of NSGA-II, the polish of a part of its front, and the timing of one
    carry.

    Args:
        workcell: the cell.
        seed: seed of search and polish.
    """
    cell = Cell(workcell)
    progress("compiling what the stages need")
    cell.evaluator.evaluate(cell.initial[None])
    time_path(cell, cell.initial)
    _ = cell.polish_functions
    fronts: list[Front] = []

    def searching() -> None:
        fronts.append(
            search(cell, "nsga2", evaluations=COSTED_EVALUATIONS, rng=np.random.default_rng(seed))
        )

    def polishing() -> None:
        settings = PolishSettings(attempts=POLISH_ATTEMPTS)
        fronts.append(polish(fronts[0], rng=np.random.default_rng(seed), settings=settings))

    stages: dict[str, Callable[[], object]] = {
        f"search ({COSTED_EVALUATIONS} evaluations, certified)": searching,
        f"polish ({POLISH_ATTEMPTS} attempts)": polishing,
        "timing (one carry)": lambda: time_path(cell, fronts[0].balanced()),
    }
    return tuple(_timed(name, run) for name, run in stages.items())


def _timed(name: str, run: Callable[[], object]) -> StageTime:
    progress(name)
    begin = time.process_time()
    run()
    seconds = time.process_time() - begin
    profiler = cProfile.Profile(time.process_time)
    profiler.runcall(run)
    parts: dict[str, float] = defaultdict(float)
    for entry in profiler.getstats():
        code = entry.code
        part = _part("", code) if isinstance(code, str) else _part(code.co_filename, "")
        parts[part] += entry.inlinetime
    total = sum(parts.values())
    small = {part for part, value in parts.items() if value < LEAST_LISTED_SHARE * total}
    kept = {part: value for part, value in parts.items() if part not in small}
    kept["other"] = sum(parts[part] for part in small)
    return StageTime(name, seconds, dict(sorted(kept.items(), key=lambda item: -item[1])))


def _part(file: str, function: str) -> str:
    """Return the package of this project, or the library, to which a profiled function belongs.

    Args:
        file: path of the file with the function.
        function: name of the function.
    """
    path = Path(file)
    if path.is_relative_to(_ROOT):
        return "/".join(path.relative_to(_ROOT).parts[:2]).removesuffix(".py")
    if "site-packages" in path.parts:
        return path.parts[path.parts.index("site-packages") + 1].removesuffix(".py")
    library = re.search(r"\b(_?casadi|numpy|scipy|fcl|pymoo)\b", function)
    return library[1].lstrip("_") if library else "python"


def study_table(stages: tuple[StageTime, ...]) -> str:
    """Return the results of `profile_study` as text."""
    rows = []
    for stage in stages:
        total = sum(stage.parts.values())
        rows += [f"{stage.name}: {stage.seconds:.2f} core-seconds"]
        rows += [f"  {100 * value / total:4.0f} %  {part}" for part, value in stage.parts.items()]
    return "\n".join(rows)
