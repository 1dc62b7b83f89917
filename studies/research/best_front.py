"""The best front of a workcell that is known: polished from many starts, then filled."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from hybrid_opt.campaign.stages import loaded_cell
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import PAPER_OBJECTIVES
from hybrid_opt.front import Front, polish
from hybrid_opt.indicators import metrics
from hybrid_opt.polishing.front import PolishedFront
from hybrid_opt.polishing.settings import FillSettings, PolishSettings
from hybrid_opt.polishing.solvers.ipopt import use_one_thread
from hybrid_opt.store.files import AGAIN, read_bytes, write_atomically
from hybrid_opt.workers import LocalWorkers
from studies.program import load_workcell
from symbolic import safe_io
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.cell_files import CellFiles, collect_cell
from symbolic.records.task import initial_decision

CANDIDATES = 4000
"""Random candidates among which starts are looked for."""

ROUNDS_PER_ATTEMPT = 14
"""Rounds of one attempt, more than in a study."""

ATTEMPTS_PER_START = 7
"""Attempts from each start: the point itself, then both ends and the middle, twice."""


@dataclass(frozen=True)
class ReferenceFront:
    """The best known front of a workcell; arrays are read-only.

    Attributes:
        digest: digest of the workcell.
        objectives: (k, 2) objectives of the k points, by increasing first objective.
        x: (k, n_var) decision vectors of the points.
    """

    digest: str
    objectives: Array
    x: Array


def compute_reference_front(
    evaluator: CandidateEvaluator,
    starts: int,
    attempts: int,
    rng: np.random.Generator,
    jobs: int = 1,
    tell: Callable[[str], None] = lambda text: None,
) -> ReferenceFront:
    """Compute a reference front of a cell: polish from many start candidates, then polish the
    union.

    Args:
        evaluator: evaluator of the cell, with the paper's objectives.
        starts: number of random feasible candidates to start from, besides the hand-made
            trajectory.
        attempts: number of attempts of the final polish of the union.
        rng: source of the random candidates.
        jobs: number of worker processes, 0 for one per core; no influence on the result.
        tell: function that receives messages on the progress.

    Raises:
        SettingsError: too few random candidates are feasible.
    """
    candidates = rng.uniform(evaluator.lower, evaluator.upper, (CANDIDATES, evaluator.n_var))
    found = evaluator.evaluate(candidates)
    feasible = np.flatnonzero(found.feasible)
    if len(feasible) < starts:
        raise SettingsError(
            f"only {len(feasible)} of {CANDIDATES} random candidates are feasible; ask for at "
            "most as many starts"
        )
    begins = [initial_decision(evaluator.workcell.task), *candidates[feasible[:starts]]]
    cell = collect_cell(evaluator.workcell)
    count = itertools.count(1)
    first = PolishSettings(
        attempts=ATTEMPTS_PER_START, rounds=ROUNDS_PER_ATTEMPT, fill=FillSettings(attempts=0)
    )
    with LocalWorkers(jobs) as workers:
        parts = workers.map(
            partial(_polished, cell, first),
            list(zip([start[None] for start in begins], rng.spawn(len(begins)), strict=True)),
            lambda *_: tell(f"start {next(count)} of {len(begins)}"),
        )
    union = np.concatenate([part.x for part in parts])
    front = _polished(
        cell, PolishSettings(attempts=attempts, rounds=ROUNDS_PER_ATTEMPT), (union, rng)
    )
    tell(f"reference front: {len(front.x)} points")
    return ReferenceFront(evaluator.workcell.digest, front.objectives, front.x)


def _polished(
    files: CellFiles, settings: PolishSettings, start: tuple[Array, np.random.Generator]
) -> PolishedFront:
    x, rng = start
    use_one_thread()
    front = Front.of(loaded_cell(files, PAPER_OBJECTIVES), x)
    done = polish(front, rng=rng, settings=settings).polished
    assert done is not None
    return done


def encode(front: ReferenceFront, command: str) -> bytes:
    """Return the content of a reference front's file in CSV.

    Two comment lines state the command that made the front and the workcell's digest. A header and
    one line per point follow, with both peak forces and the decision vector.

    Args:
        front: the reference front.
        command: command line that made the front.
    """
    n_var = front.x.shape[1]
    lines = [
        f"# made with: {command}",
        f"# workcell: {front.digest}",
        ",".join(["peak_force_1", "peak_force_2", *(f"x_{k + 1}" for k in range(n_var))]),
    ]
    for objectives, x in zip(front.objectives.tolist(), front.x.tolist(), strict=True):
        lines.append(",".join(map(repr, [*objectives, *x])))
    return ("\n".join(lines) + "\n").encode()


def read_reference_front(path: Path) -> ReferenceFront:
    """Read a reference front from a file that contains the result of `encode`.

    Raises:
        ResultsError: the file cannot be read or is damaged.
    """
    try:
        content = read_bytes(path)
        if content.count(b",") + content.count(b"\n") > safe_io.MAX_JSON_VALUES:
            raise ValueError(f"it holds more than {safe_io.MAX_JSON_VALUES} values")
        lines = content.decode("ascii").splitlines()
        digest = lines[1].removeprefix("# workcell: ")
        values = np.array([[float(word) for word in line.split(",")] for line in lines[3:]])
        if values.ndim != 2 or values.shape[1] < 3:
            raise ValueError("its lines do not hold two objectives and a decision")
        if not np.isfinite(values).all():
            raise ValueError("it holds a number that is not finite")
        objectives, x = values[:, :2].copy(), values[:, 2:].copy()
    except (ValueError, IndexError) as error:
        told = str(error).splitlines()[0][:200]
        text = f"{path}: no reference front ({told}); make it again"
        raise ResultsError(text, code="no-reference-front") from error
    for array in (objectives, x):
        array.setflags(write=False)
    return ReferenceFront(digest, objectives, x)


def reference_front(options: argparse.Namespace) -> int:
    """Compute and write the reference front that the options request. Return the exit code."""
    command = (
        f"python -m studies.research.reference_front {options.workcell} --output FILE "
        f"--starts {options.starts} --attempts {options.attempts} --seed {options.seed}"
    )
    front = compute_reference_front(
        CandidateEvaluator(load_workcell(options.workcell)),
        options.starts,
        options.attempts,
        np.random.default_rng(options.seed),
        options.jobs,
        lambda text: print(text, file=sys.stderr, flush=True),
    )
    write_atomically(options.output, encode(front, command), AGAIN)
    print(
        f"{options.output}: {len(front.x)} points, hypervolume "
        f"{metrics.hypervolume(front.objectives):.6f}"
    )
    return 0
