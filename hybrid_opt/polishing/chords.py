"""Points of a front between neighbours that are nearly alike, without a solve.

The best carries of one basin hardly bend away from the straight line between two neighbours'
decision vectors: the error grows with the square of its length. What the full model finds on that
chord is nearly as good as what a solve would find there, and costs a fiftieth.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.archive import GrowingFront
from hybrid_opt.polishing.filling import Gap, gaps
from hybrid_opt.polishing.settings import FillSettings
from symbolic.array import Array

Chord = tuple[bytes, bytes]
"""Its ends, by increasing first objective: decision vectors as bytes."""


def widest(archive: GrowingFront, tried: Collection[Chord]) -> Gap | None:
    """The widest gap whose chord was not tried; None where none is left. Points of the given front
    have no chords."""
    for gap in sorted(gaps(archive), key=lambda gap: -gap.width):
        is_polished = archive.polished[gap.first] and archive.polished[gap.second]
        if is_polished and chord_of(archive, gap) not in tried:
            return gap
    return None


def chord_of(archive: GrowingFront, gap: Gap) -> Chord:
    """The chord across a gap."""
    return archive.x[gap.first].tobytes(), archive.x[gap.second].tobytes()


def between(
    evaluator: CandidateEvaluator, archive: GrowingFront, gap: Gap, settings: FillSettings
) -> tuple[Array, Array] | None:
    """The feasible point on a chord that wins most area from its gap: decision vector (n_var,) and
    objectives (2,); None where every one is dominated or infeasible."""
    share = np.arange(1, settings.chord + 1)[:, None] / (settings.chord + 1)
    x = (1.0 - share) * archive.x[gap.first] + share * archive.x[gap.second]
    found = evaluator.evaluate(x)
    corner = archive.objectives[gap.second][0], archive.objectives[gap.first][1]
    won = np.maximum(np.array(corner) - found.objectives, 0.0).prod(axis=1)
    won[~found.feasible] = 0.0
    best = int(won.argmax())
    if won[best] == 0.0 or archive.dominates(found.objectives[best]):
        return None
    return x[best], found.objectives[best]
