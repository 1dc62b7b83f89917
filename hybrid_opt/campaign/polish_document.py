"""A polished front as the document that is stored of it."""

from __future__ import annotations

import math

import numpy as np

from hybrid_opt.campaign.documents import FrontPoint, PolishDocument, PolishEffort
from hybrid_opt.polishing.records import PolishedFront, outcome_to_json


def polish_document(front: PolishedFront) -> PolishDocument:
    """A polished front as it is stored."""
    # Others were judged as they are, without a solver.
    solved = [o for o in front.outcomes if o.rounds or o.status == "failed"]
    # What was dominated later, probes most of all, is no result.
    standing = {x.tobytes() for x in front.x}
    accepted = [o for o in solved if o.status == "accepted" and o.x.tobytes() in standing]
    points = zip(front.objectives, front.x, front.parent, front.polished, strict=True)
    return PolishDocument(
        front=tuple(
            FrontPoint(objectives, x, int(parent), bool(polished))
            for objectives, x, parent, polished in points
        ),
        figures=PolishEffort(
            solver=front.solver,
            attempts=len(solved),
            counts=front.counts,
            success_share=front.success_share,
            seconds=front.seconds,
            median_attempt_seconds=_median([o.seconds for o in solved]),
            equivalent_evaluations=front.equivalent_evaluations,
            widest_gap=front.widest_gap,
            worst_stationarity=_worst([o.residuals.stationarity for o in accepted]),
            worst_feasibility=_worst([o.residuals.feasibility for o in accepted]),
            median_stationarity=_median([o.residuals.stationarity for o in accepted]),
        ),
        attempts=tuple(outcome_to_json(outcome) for outcome in front.outcomes),
    )


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else math.nan


def _worst(values: list[float]) -> float:
    return max(values, default=math.nan)
