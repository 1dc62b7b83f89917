"""Run a whole study of a workcell: `dual-arm-carry run WORKCELL`."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES, OBJECTIVES, PAPER_OBJECTIVES
from hybrid_opt.polishing.settings import (
    DRIVABLE_ATTEMPTS,
    QUICK_ATTEMPTS,
    QUICK_DRIVABLE_ATTEMPTS,
    SOLVERS,
    PolishSettings,
)
from hybrid_opt.workers import warm_up
from studies.options import (
    QUICK_EVALUATIONS,
    QUICK_REPLICAS,
    add,
    add_looks,
    add_wishes,
    require_extra,
    stated,
)
from studies.program import Parser, Program, carry_out
from symbolic.errors import SettingsError

DESCRIPTION = (
    "Make a whole study of a dual-arm workcell: search for carries of least force and duration, "
    "polish them, recommend one to run, and write a report."
)

KNOWN: tuple[str, ...] = stated("hybrid_opt.metaheuristics.run.REGISTRY")

DEFAULT_ALGORITHMS = "hybrid_opt.campaign.settings.ALGORITHMS"

FURTHER = (
    "--algorithm",
    "--population",
    "--objective",
    "--first-generation",
    "--constraint-handling",
    "--polish",
    "--polish-attempts",
    "--polish-solver",
    "--drivable",
    "--drivable-replicas",
    "--simulate",
    "--report",
    "--executor",
    "--scheduler",
    "--quiet",
    "--animation",
    "--view",
    "--port",
)
"""Options of a study that `--help` lists by name only, without a description."""

WORKERS_LOAD = (
    "hybrid_opt.campaign.polish_stage",
    "studies.study.recommendation",
    "studies.report.generate",
)
"""Modules that the server process of a study loads in advance, before it forks workers."""


def add_options(parser: Parser, output: str) -> None:
    """Add the options of a study to a program's parser; `output` is the default folder in the help
    text."""
    search = parser.add_argument_group("search (decides the results)")
    search.add_argument(
        "--quick",
        action="store_true",
        help=f"a small but complete study: {QUICK_REPLICAS} replicas of {QUICK_EVALUATIONS} "
        "evaluations by default, a shorter polish, pictures as PNG only",
    )
    search.add_argument(
        "--recommend-only",
        action="store_true",
        help="only the carry to run: one drivable search, its polish and the recommendation; no "
        "experiment of the paper, no page",
    )
    search.add_argument(
        "--evaluations",
        type=int,
        metavar="N",
        help=f"candidates that each replica may evaluate (default: {_stated('evaluations')})",
    )
    search.add_argument(
        "--replicas",
        type=int,
        metavar="N",
        help=f"independent runs per algorithm (default: {_stated('replicas')})",
    )
    search.add_argument(
        "--algorithm",
        nargs="+",
        action="extend",
        metavar="NAME",
        help=f"algorithms, of {', '.join(KNOWN)} (default: {' '.join(stated(DEFAULT_ALGORITHMS))})",
    )
    search.add_argument(
        "--population",
        nargs="+",
        action="extend",
        type=_population,
        metavar="NAME=N",
        help="candidates per generation of an algorithm (default: each algorithm's own)",
    )
    search.add_argument(
        "--objective",
        nargs="+",
        action="extend",
        metavar="NAME",
        help=f"objectives to minimise, of {', '.join(OBJECTIVES)} "
        f"(default: {' '.join(PAPER_OBJECTIVES)}, in a cell under the time law 'optimal' "
        f"{' '.join(DRIVABLE_OBJECTIVES)})",
    )
    search.add_argument(
        "--first-generation",
        choices=stated("hybrid_opt.campaign.settings.FirstGeneration"),
        default=_stated("first_generation"),
        help="start of searches: random candidates with the workcell's hand-made trajectory, or "
        "random ones alone",
    )
    search.add_argument(
        "--constraint-handling",
        choices=stated("hybrid_opt.metaheuristics.run.ConstraintHandling"),
        default=_stated("constraint_handling"),
        help="constraints of the search: the paper's penalised objectives, or constraint "
        "domination",
    )
    add(
        search,
        "--seed",
        type=int,
        default=_stated("seed"),
        help="the same seed gives the same results",
    )
    after = parser.add_argument_group("after the search (decides everything but the candidates)")
    after.add_argument(
        "--polish",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="improve every front further (default: yes for the paper's two objectives and for "
        "drivable carries)",
    )
    after.add_argument(
        "--polish-attempts",
        type=int,
        metavar="N",
        help="attempts of the polish of one front before its gaps are filled (default: "
        f"{PolishSettings().attempts}, with --quick {QUICK_ATTEMPTS}); for a drivable front, force "
        f"limits of the sweep (default: {DRIVABLE_ATTEMPTS}, {QUICK_DRIVABLE_ATTEMPTS})",
    )
    after.add_argument(
        "--polish-solver",
        choices=SOLVERS,
        default=PolishSettings().solver,
        help="solver of the polish of both peak forces: a dense interior-point method, or IPOPT "
        "for comparison",
    )
    after.add_argument(
        "--drivable",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="also search for drivable carries of least duration and force, and recommend one",
    )
    after.add_argument(
        "--drivable-replicas",
        type=int,
        metavar="N",
        help="independent runs per algorithm of that search (default: as --replicas, at most "
        f"{stated('hybrid_opt.campaign.stages.DRIVABLE_REPLICAS')})",
    )
    add_wishes(after)
    add(after, "--target")
    after.add_argument(
        "--simulate",
        action="store_true",
        help="simulate the selected carries in MuJoCo: pip install 'dual-arm-carry[sim]'",
    )
    after.add_argument(
        "--report",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="write report.html, the pictures of the recommended carry, and all tables",
    )
    add(after, "--paper")
    work = parser.add_argument_group("work (does not change the results)")
    add(
        work,
        "--output",
        metavar="DIR",
        help=f"results folder (default: {output}, "
        "with --recommend-only its name ends in -recommended)",
    )
    work.add_argument(
        "--resume",
        action="store_true",
        help="continue the study in the results folder",
    )
    work.add_argument(
        "--overwrite",
        action="store_true",
        help="remove the study in the results folder and begin anew",
    )
    add(work, "--jobs", type=int)
    work.add_argument(
        "--executor",
        choices=stated("hybrid_opt.campaign.folder.ExecutorName"),
        default="processes",
        help="workers: processes of this machine, or a Dask cluster",
    )
    work.add_argument(
        "--scheduler", metavar="ADDRESS", help="Dask scheduler, as tcp://HOST:8786 (default: none)"
    )
    add(work, "--quiet")
    add_looks(parser)


def study_of(workcell: Path, options: argparse.Namespace, with_paper: bool = False) -> int:
    """Make the study of a workcell file with parsed options. Return the exit code.

    Args:
        workcell: path of the workcell file.
        options: options that were parsed with those of `add_options`.
        with_paper: True to add rows to tables with the paper's values.
    """
    again = [part for part in options.arguments if part not in ("--resume", "--overwrite")]
    command = " ".join([options.called, shlex.join([*again, "--resume"])])

    def work() -> int:
        if options.executor == "processes":
            warm_up(*WORKERS_LOAD)  # their server loads much of the same while this process does
        from studies.programs.study import make_study

        make_study(workcell, options, with_paper)
        return 0

    interrupted = f"interrupted, nothing is lost; continue with: {command}"
    return carry_out(options.called, work, interrupted)


def _stated(field: str) -> Any:
    """Return the default value of a field of `CampaignSettings`, without importing the class."""
    return stated(f"hybrid_opt.campaign.settings.CampaignSettings.{field}")


def _population(text: str) -> tuple[str, int]:
    name, separator, size = text.partition("=")
    if not separator or not size.isdecimal():
        raise argparse.ArgumentTypeError(f"found {text!r}; allowed is NAME=N, as nsga2=40")
    if name not in KNOWN:
        raise SettingsError(f"unknown algorithm '{name}'; known are {', '.join(KNOWN)}")
    return name, int(size)


def _add_options(parser: Parser) -> None:
    add(parser, "WORKCELL")
    add_options(parser, "results/WORKCELL")


def complete(options: argparse.Namespace, name: str) -> None:
    """Set the results folder to `results/NAME` unless the options state one, and check that the
    extras which the options need are installed.

    Args:
        options: parsed command line, which is changed.
        name: name of the study.

    Raises:
        SettingsError: an extra is not installed.
    """
    ending = "-recommended" if options.recommend_only else ""
    options.output = options.output or Path("results") / f"{name}{ending}"
    if options.simulate:
        require_extra("sim", "--simulate")
    if options.executor == "dask":
        require_extra("dask", "--executor dask")


main = Program(
    "run",
    DESCRIPTION,
    _add_options,
    lambda options: study_of(options.workcell, options),
    complete=lambda options: complete(options, options.workcell.stem),
    further=FURTHER,
)


if __name__ == "__main__":
    main.start()
