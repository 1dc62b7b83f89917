"""The options that all campaign programs share."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

from hybrid_opt import metaheuristics
from hybrid_opt.campaign import CampaignSettings, ExecutionSettings
from hybrid_opt.campaign.execution import ExecutorName
from hybrid_opt.campaign.experiment_stage import drivable_settings
from hybrid_opt.campaign.settings import FirstGeneration
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES, OBJECTIVES, PAPER_OBJECTIVES
from hybrid_opt.metaheuristics.problem import ConstraintHandling
from hybrid_opt.polishing.settings import (
    DRIVABLE_ATTEMPTS,
    SOLVERS,
    PolishSettings,
    quick_settings,
)
from hybrid_opt.recommending.choice import Wish
from studies.program import Parser
from symbolic.errors import SettingsError

_DEFAULT = CampaignSettings()

QUICK_EVALUATIONS, QUICK_REPLICAS = 300, 2
"""Evaluations and replicas of a small but complete study."""


def campaign_parser(program: str, description: str, output: str) -> Parser:
    """A parser with the options of a campaign.

    Args:
        program: how it is called.
        description: what it does.
        output: the results folder where none is given, for the help.
    """
    parser = Parser(prog=program, description=description)
    search = parser.add_argument_group("search (decides the results)")
    search.add_argument(
        "--quick",
        action="store_true",
        help=f"a small but complete study: {QUICK_REPLICAS} replicas of {QUICK_EVALUATIONS} "
        "evaluations where no other numbers are given, polished to a third as many points in fewer "
        "attempts, its pictures as PNG only (default: off)",
    )
    search.add_argument(
        "--recommend-only",
        action="store_true",
        help="only what the carry to run needs: the drivable search, one replica of one algorithm "
        "where no other numbers are given, its polish and the recommendation; no experiment of the "
        "paper, no pictures (default: off)",
    )
    search.add_argument(
        "--evaluations",
        type=int,
        metavar="N",
        help=f"candidates that each replica may evaluate (default: {_DEFAULT.evaluations})",
    )
    search.add_argument(
        "--replicas",
        type=int,
        metavar="N",
        help=f"independent runs per algorithm (default: {_DEFAULT.replicas})",
    )
    search.add_argument(
        "--algorithm",
        nargs="+",
        action="extend",
        metavar="NAME",
        help=f"which of {', '.join(metaheuristics.names())} "
        f"(default: {' '.join(_DEFAULT.algorithms)})",
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
        help=f"what to minimise, of {', '.join(OBJECTIVES)} "
        f"(default: {' '.join(PAPER_OBJECTIVES)}, in a cell under the time law 'optimal' "
        f"{' '.join(DRIVABLE_OBJECTIVES)})",
    )
    search.add_argument(
        "--first-generation",
        choices=get_args(FirstGeneration),
        default=_DEFAULT.first_generation,
        help="what searches start from: random candidates and the workcell's hand-made initial "
        "trajectory, or random ones alone (default: %(default)s)",
    )
    search.add_argument(
        "--constraint-handling",
        choices=get_args(ConstraintHandling),
        default=_DEFAULT.constraint_handling,
        help="how the search learns of infeasibility: by the paper's penalised objectives, or by "
        "constraint domination (default: %(default)s)",
    )
    search.add_argument(
        "--seed",
        type=int,
        metavar="N",
        default=_DEFAULT.seed,
        help="the same seed gives the same results to the bit (default: %(default)s)",
    )
    after = parser.add_argument_group("after the search (decides what is made of the results)")
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
        help="attempts that the polish of one front may take before it is filled between its ends "
        f"(default: {PolishSettings().attempts}, for a drivable one {DRIVABLE_ATTEMPTS}, "
        f"with --quick {quick_settings().attempts})",
    )
    after.add_argument(
        "--polish-solver",
        choices=SOLVERS,
        default=PolishSettings().solver,
        help="what solves the polish's programs of both peak forces: a dense interior-point "
        "method, or IPOPT, for comparison (default: %(default)s)",
    )
    after.add_argument(
        "--drivable",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="also search for carries as robots drive them, of least duration and force, and "
        "recommend one (default: yes)",
    )
    add_wishes(after)
    after.add_argument(
        "--simulate",
        action="store_true",
        help="have the selected carries driven in the simulated cell, which needs MuJoCo: "
        "pip install 'dual-arm-carry[sim]' (default: off)",
    )
    after.add_argument(
        "--report",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="write pictures, tables and report.html (default: yes)",
    )
    work = parser.add_argument_group("work (does not change the results)")
    work.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help=f"results folder (default: {output}, "
        "with --recommend-only its name ends in -recommended)",
    )
    work.add_argument(
        "--resume",
        action="store_true",
        help="continue what the results folder holds (default: refuse to touch it)",
    )
    work.add_argument(
        "--overwrite",
        action="store_true",
        help="remove the results that the folder holds and begin anew (default: refuse to touch "
        "it)",
    )
    work.add_argument(
        "--jobs",
        type=int,
        metavar="N",
        default=0,
        help="worker processes, 0 for one per core (default: %(default)s)",
    )
    work.add_argument(
        "--executor",
        choices=get_args(ExecutorName),
        default="processes",
        help="where the work is done: on this machine or on a Dask cluster (default: %(default)s)",
    )
    work.add_argument(
        "--scheduler", metavar="ADDRESS", help="of Dask, as tcp://HOST:8786 (default: none)"
    )
    work.add_argument(
        "--quiet", action="store_true", help="no progress on standard error (default: shown)"
    )
    return parser


def add_wishes(parser: argparse._ActionsContainer) -> None:
    """Add what may be asked of the recommended carry; `wish` reads it."""
    parser.add_argument(
        "--duration",
        type=_positive,
        metavar="S",
        help="recommend the least force of the carries of at most S seconds (default: the knee)",
    )
    parser.add_argument(
        "--force-limit",
        type=_positive,
        metavar="N",
        help="recommend the shortest carry with both normal forces below N newtons; a study also "
        "times every selected trajectory with that limit (default: the knee)",
    )
    parser.add_argument(
        "--payload",
        type=_positive,
        metavar="KG",
        help="recommend the shortest carry on whose motion the robots would bear a box of KG "
        "kilograms (default: the knee)",
    )


def campaign_settings(
    options: argparse.Namespace, objectives: tuple[str, ...] = PAPER_OBJECTIVES
) -> CampaignSettings:
    """The settings that the options give.

    Args:
        objectives: what is minimised where the options do not say.

    Returns:
        Those of the drivable experiment where only a recommendation is asked for.

    Raises:
        SettingsError: a value is not allowed.
    """
    evaluations, replicas = options.evaluations, options.replicas
    if evaluations is None:
        evaluations = QUICK_EVALUATIONS if options.quick else _DEFAULT.evaluations
    if replicas is None:
        replicas = QUICK_REPLICAS if options.quick else _DEFAULT.replicas
        replicas = 1 if options.recommend_only else replicas
    usual = _DEFAULT.algorithms[: 1 if options.recommend_only else None]
    settings = CampaignSettings(
        algorithms=_once(options.algorithm, usual),
        evaluations=evaluations,
        replicas=replicas,
        seed=options.seed,
        objectives=_once(options.objective, objectives),
        constraint_handling=options.constraint_handling,
        first_generation=options.first_generation,
        populations=tuple(options.population or ()),
    )
    return drivable_settings(settings) if options.recommend_only else settings


def polish_settings(
    options: argparse.Namespace, usual: bool, settings: PolishSettings
) -> PolishSettings | None:
    """How the options want fronts polished, None for not at all.

    Args:
        usual: whether they are polished where the options do not say.
        settings: where they say nothing of them.

    Raises:
        SettingsError: a value is not allowed.
    """
    if not (usual if options.polish is None else options.polish):
        return None
    chosen = quick_settings() if options.quick else settings
    asked = options.polish_attempts
    attempts = chosen.attempts if asked is None else asked
    return replace(chosen, attempts=attempts, solver=options.polish_solver)


def wish(options: argparse.Namespace) -> Wish:
    """The wish for the recommended carry in the options.

    Raises:
        SettingsError: more than one of them is given.
    """
    return Wish(options.duration, options.force_limit, options.payload)


def execution_settings(options: argparse.Namespace, output: Path) -> ExecutionSettings:
    """How the options want the work done.

    Args:
        options: as parsed.
        output: the results folder where the options name none.

    Raises:
        SettingsError: a value is not allowed.
    """
    return ExecutionSettings(
        output=options.output or output,
        jobs=options.jobs,
        executor=options.executor,
        scheduler=options.scheduler,
        resume=options.resume,
        overwrite=options.overwrite,
    )


def _once(given: Sequence[str] | None, default: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(given) if given else default


def _population(text: str) -> tuple[str, int]:
    name, separator, size = text.partition("=")
    if not separator or not size.isdecimal():
        raise argparse.ArgumentTypeError(f"found {text!r}; allowed is NAME=N, as nsga2=40")
    if name not in metaheuristics.names():
        raise SettingsError(
            f"unknown algorithm '{name}'; known are {', '.join(metaheuristics.names())}"
        )
    return name, int(size)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"found {text!r}; allowed is a positive number")
    return value
