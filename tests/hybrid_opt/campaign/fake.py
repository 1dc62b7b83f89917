"""A cheap problem with the evaluator's interface, and a program that runs a campaign on it."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hybrid_opt.campaign import (
    CampaignSettings,
    ExecutionSettings,
    Stage,
    open_folder,
    run_stages,
    search_stage,
)
from hybrid_opt.campaign.candidates import EvaluatedCandidates, encode
from hybrid_opt.campaign.search_stage import SearchRequest
from hybrid_opt.evaluate.evaluation import FEASIBLE, REASONS, Evaluations
from hybrid_opt.metaheuristics.run import SearchSettings, search_carries
from hybrid_opt.progress import Progress, ShowProgress
from symbolic.array import Array
from symbolic.errors import DualArmError
from symbolic.read.cell import load

ROOT = Path(__file__).parents[3]
RACK = ROOT / "studies/workcells/rack.toml"
OBJECTIVES = ("peak_force_1", "peak_force_2")


def verdicts(x: Array) -> Evaluations:
    """Two paraboloids with feasible x_1 + x_2 > 0.4 and x_3 < 0.9, NaN in a stripe of x_1."""
    values = np.column_stack([(x**2).mean(axis=1), ((x - 1.0) ** 2).mean(axis=1)])
    values[(x[:, 0] > 0.30) & (x[:, 0] < 0.33)] = np.nan
    violation = np.zeros((len(x), len(REASONS)))
    violation[:, 0] = np.maximum(0.4 - x[:, 0] - x[:, 1], 0.0)
    violation[:, REASONS.index("collision")] = np.maximum(x[:, 2] - 0.9, 0.0)
    allowed = violation.max(axis=1) <= 0.0
    reason = np.where(allowed, FEASIBLE, np.argmax(violation > 0.0, axis=1)).astype(np.int8)
    share = np.minimum(violation, 1.0)
    penalised = np.where(allowed[:, None], values, 1.0 + share.sum(axis=1)[:, None])
    position = np.where(allowed, np.nan, x[:, 1])
    return Evaluations(x, values, penalised, allowed, reason, position, violation, share)


class FakeEvaluator:
    objective_names: tuple[str, ...] = OBJECTIVES
    n_var = 4
    lower = np.zeros(4)
    upper = np.ones(4)

    def __init__(self, source: FakeSource) -> None:
        self._source = source
        self._count = 0

    def evaluate(self, x: Array) -> Evaluations:
        time.sleep(self._source.delay)
        if self._source.log:
            # One write per call, so that several processes can share the file.
            with open(self._source.log, "ab", buffering=0) as log:
                log.write(x.tobytes())
        self._count += len(x)
        if self._count > self._source.dies_at and self._source.must_die():
            os.kill(os.getpid(), signal.SIGKILL)
        if (
            self._source.dies_beyond
            and len(logged(Path(self._source.log))) > self._source.dies_beyond
        ):
            os.kill(os.getpid(), signal.SIGKILL)
        return verdicts(x)

    def certified(self, evaluations: Evaluations) -> Evaluations:
        return evaluations


@dataclass(frozen=True)
class FakeSource:
    """Searches the fake problem as a campaign searches a cell.

    delay: seconds per call. log: file that every evaluated x is appended to. An evaluator kills
    its process after dies_at evaluations, if it always_dies or if the file dies_once is missing,
    and whenever the log holds more than dies_beyond evaluations, if that is not 0.
    """

    delay: float = 0.0
    log: str = ""
    dies_at: int = 0
    dies_once: str = ""
    always_dies: bool = False
    dies_beyond: int = 0

    def __call__(self, request: SearchRequest, progress: ShowProgress = False, /) -> bytes:
        settings, name = request.settings, request.algorithm
        found = search_carries(
            FakeEvaluator(self),
            name,
            settings.evaluations,
            settings.replica_rng(name, request.replica),
            SearchSettings(settings.algorithms[name], settings.constraint_handling),
        )
        return encode(EvaluatedCandidates(found[0], OBJECTIVES, 0.0))

    def must_die(self) -> bool:
        if self.dies_once and not Path(self.dies_once).exists():
            Path(self.dies_once).touch()
            return True
        return self.always_dies


def logged(path: Path) -> Array:
    """(n, 4) every decision vector that was evaluated."""
    return np.frombuffer(path.read_bytes()).reshape(-1, FakeEvaluator.n_var)


def run_search(
    settings: CampaignSettings,
    execution: ExecutionSettings,
    source: FakeSource | None = None,
    further: tuple[Stage, ...] = (),
) -> Path:
    """Run the search stage on the fake problem; returns the results folder.

    The fake problem is not the workcell's, so the workcell's initial trajectory is left out.
    """
    settings = replace(settings, first_generation="random")
    with open_folder(settings, execution, load(RACK)) as folder:
        stages = [search_stage(source or FakeSource()), *further]
        run_stages(folder, stages, Progress(shown=False))
    return execution.output


def files_of(root: Path) -> dict[str, bytes]:
    """The results of all replicas by path."""
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for path in sorted(root.glob("replicas/*/*.csv.gz"))
    }


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("output", type=Path)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--delay", type=float, default=0.0)
    parser.add_argument("--log", default="")
    parser.add_argument("--evaluations", type=int, default=200)
    options = parser.parse_args()
    settings = CampaignSettings(evaluations=options.evaluations, replicas=2)
    try:
        run_search(
            settings,
            ExecutionSettings(options.output, options.jobs, resume=True),
            FakeSource(options.delay, options.log),
        )
    except DualArmError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
