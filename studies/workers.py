"""The workers of a study, on their way before the rest of a program is imported."""

from __future__ import annotations

from collections.abc import Sequence

from hybrid_opt.work.processes import warm_up

WORKERS_LOAD = (
    "hybrid_opt.campaign.polish_stage",
    "studies.timing_stage",
    "studies.recommendation_stage",
    "studies.report.generate",
)
"""Modules that the work of a study needs."""

_WITHOUT = {"-h", "--help", "dask", "--executor=dask"}


def start_workers(arguments: Sequence[str]) -> None:
    """Let the server that workers come from load what they need.

    Args:
        arguments: of the command line; where they ask for help, or for workers of a cluster, none
            is started.
    """
    if _WITHOUT.isdisjoint(arguments):
        warm_up(*WORKERS_LOAD)
