"""Cost of one candidate: compiled, interpreted and written plainly.

`python -m studies.benchmark [WORKCELL]` measures milliseconds per candidate on one core, in the
thread's own processor time, so that waiting for a busy machine does not count. The three ways take
turns, the compiled one with batches of a search's size, and a ratio is the median over the rounds
of the ratio within a round. The plain way is the reference that the tests hold the evaluator to
(`studies.plain`). With collisions the same is measured on candidates of a search
(`studies.benchmark_collisions`). `--study` tells instead where the time of a study goes
(`studies.benchmark_study`).

The cost against the number of samples and of free waypoints is measured on cells derived from the
given one: same start, goal and robots, the free waypoints spread along the hand-made trajectory.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np

from codegen.build import compile_function
from codegen.interpreted import InterpretedFunction
from codegen.source import dense
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from studies.benchmark_collisions import POPULATION, with_collisions
from studies.benchmark_study import profile_study, study_table
from studies.benchmark_text import report
from studies.benchmark_turns import Evaluate, interleaved, progress, summary
from studies.plain.candidate import PlainEvaluator
from studies.plain.verdict import PlainJudge
from studies.program import Parser, add_verbose, carried_out, run_program
from symbolic.array import Array
from symbolic.cell_model import CellModel
from symbolic.errors import SettingsError
from symbolic.functions import candidate_function
from symbolic.read.cell import load
from symbolic.records import Task, Waypoint, Workcell

PROGRAM = "python -m studies.benchmark"

SAMPLES = (25, 50, 100, 200, 400)
WAYPOINTS = (1, 2, 3, 4, 5, 6, 7, 8)


@carried_out(PROGRAM)
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit code: 0, or 2 on bad input."""
    options = _parser().parse_args(arguments)
    if options.study:
        print(study_table(profile_study(_workcell(options.workcell), options.seed)))
        return 0
    result = benchmark(
        _workcell(options.workcell), options.candidates, options.repeats, options.seed
    )
    print(json.dumps(result, indent=2) if options.json else report(result))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=PROGRAM,
        description="Milliseconds per candidate: compiled, interpreted and written plainly.",
    )
    parser.add_argument(
        "workcell", nargs="?", type=Path, help="workcell file (default: the rack cell)"
    )
    parser.add_argument(
        "--candidates", type=int, default=10, help="random candidates (default: 10)"
    )
    parser.add_argument(
        "--repeats", type=int, default=3, help="rounds with each candidate (default: 3)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the candidates (default: 0)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    parser.add_argument(
        "--study", action="store_true", help="core-seconds by part of search, polish and timing"
    )
    add_verbose(parser)
    return parser


def _workcell(path: Path | None) -> Workcell:
    if path is not None:
        return load(path)
    with as_file(files("studies")) as folder:
        return load(folder / "workcells" / "rack.toml")


def benchmark(
    workcell: Workcell, candidates: int = 10, repeats: int = 3, seed: int = 0
) -> dict[str, Any]:
    """Measure one cell; every time is in milliseconds per candidate.

    Args:
        candidates: number of decision vectors, uniform within the bounds.
        repeats: rounds with each of them.
        seed: of the decision vectors.

    Raises:
        SettingsError: a number is not positive.
        CodegenError: there is no compiler.
        DualArmError: the cell has no model.
    """
    for name, value in (("candidates", candidates), ("repeats", repeats)):
        if value < 1:
            raise SettingsError(f"--{name} is {value}; give 1 or more")
    if seed < 0:
        raise SettingsError(f"--seed is {seed}; give 0 or more")
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
        "compiled": lambda x: evaluator.sampled(x, with_collisions=False),
        "interpreted": InterpretedFunction(dense(candidate_function(model))),
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
    """Compiled cost against the numbers of samples and of free waypoints."""
    task = model.workcell.task
    by_samples = {n: replace(task, samples=n) for n in SAMPLES}
    by_waypoints = {n: with_free_waypoints(task, n) for n in WAYPOINTS}
    samples = _costs(model, by_samples, candidates, repeats, seed, "samples")
    waypoints = _costs(model, by_waypoints, candidates, repeats, seed, "free waypoints")
    # The line goes through costs relative to the middle one, which turns taken make comparable;
    # relative weights let 25 samples count as much as 400.
    middle = SAMPLES[len(SAMPLES) // 2]
    n = np.array(SAMPLES)
    relative = np.array([np.median(samples[k] / samples[middle]) for k in SAMPLES])
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
    """Seconds per candidate (rounds,) of the compiled evaluator for each task, taken in turns."""
    ways: dict[str, Evaluate] = {}
    x: dict[str, Array] = {}
    for n, task in tasks.items():
        progress(f"building the evaluator with {n} {what}")
        sized = replace(model, workcell=replace(model.workcell, task=task))
        ways[str(n)] = compile_function(candidate_function(sized))
        x[str(n)] = _candidates(task, candidates, seed)
    return {int(name): value for name, value in interleaved(ways, x, repeats).items()}


def with_free_waypoints(task: Task, count: int) -> Task:
    """The task with another number of free waypoints between its start and goal.

    They lie evenly along the polygon of the hand-made trajectory; each may deviate as far as the
    narrowest of the original ones.
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


if __name__ == "__main__":
    sys.exit(run_program(main))
