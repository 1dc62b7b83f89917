"""The time of a study: core-seconds by part of search, polish and timing.

Everything runs in this process, one after the other, under Python's profiler, on functions that are
compiled before. What Python's functions and the libraries' own ones take themselves is summed up
by the room of this project, or the library, that they belong to; `codegen` is the time in compiled
functions. The profiler's own cost is in the figures, most where much Python runs.
"""

from __future__ import annotations

import cProfile
import re
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybrid_opt.cell import Cell
from hybrid_opt.door import polish, search, time_path
from hybrid_opt.front import Front
from hybrid_opt.polishing.settings import PolishSettings
from studies.research.turns import progress
from symbolic.records import Workcell

EVALUATIONS = 1000
POLISH_ATTEMPTS = 4
LEAST_SHARE = 0.02
"""Parts below this share of their stage are summed up as 'other'."""

_ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class StageTime:
    """Core-seconds of a stage, without the profiler as `seconds`, and by part as profiled."""

    name: str
    seconds: float
    parts: dict[str, float]


def profile_study(workcell: Workcell, seed: int) -> tuple[StageTime, ...]:
    """Time one replica of NSGA-II, the polish of some of its front, and the timing of one carry."""
    cell = Cell(workcell)
    progress("compiling what the stages need")
    cell.evaluator.evaluate(cell.initial[None])
    time_path(cell, cell.initial)
    _ = cell.polish_functions
    fronts: list[Front] = []

    def searching() -> None:
        fronts.append(
            search(cell, "nsga2", evaluations=EVALUATIONS, rng=np.random.default_rng(seed))
        )

    def polishing() -> None:
        settings = PolishSettings(attempts=POLISH_ATTEMPTS)
        fronts.append(polish(fronts[0], rng=np.random.default_rng(seed), settings=settings))

    stages: dict[str, Callable[[], object]] = {
        f"search ({EVALUATIONS} evaluations, certified)": searching,
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
    small = {part for part, value in parts.items() if value < LEAST_SHARE * total}
    kept = {part: value for part, value in parts.items() if part not in small}
    kept["other"] = sum(parts[part] for part in small)
    return StageTime(name, seconds, dict(sorted(kept.items(), key=lambda item: -item[1])))


def _part(file: str, function: str) -> str:
    """The room of this project or the library that a function belongs to."""
    path = Path(file)
    if path.is_relative_to(_ROOT):
        return "/".join(path.relative_to(_ROOT).parts[:2]).removesuffix(".py")
    if "site-packages" in path.parts:
        return path.parts[path.parts.index("site-packages") + 1].removesuffix(".py")
    library = re.search(r"\b(_?casadi|numpy|scipy|fcl|pymoo)\b", function)
    return library[1].lstrip("_") if library else "python"


def study_table(stages: tuple[StageTime, ...]) -> str:
    """The figures as text."""
    rows = []
    for stage in stages:
        total = sum(stage.parts.values())
        rows += [f"{stage.name}: {stage.seconds:.2f} core-seconds"]
        rows += [f"  {100 * value / total:4.0f} %  {part}" for part, value in stage.parts.items()]
    return "\n".join(rows)
