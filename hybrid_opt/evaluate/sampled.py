"""What the samples of candidates say: constraints and collisions, before objectives are known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.collision.checker import CollisionChecker
from hybrid_opt.collision.verdict import sample_durations
from symbolic.array import Array


@dataclass(frozen=True)
class SampledVerdicts:
    """n candidates on their samples.

    Attributes:
        outputs: 'time' (n, samples) [s], 'violation' and 'violation_time' (n, constraints), and
            what else was asked for, as `symbolic.functions.candidate_function` has them.
        first_sample: (n,) the first sample that violates a constraint; the number of samples
            where none does.
        first_reason: (n,) the first constraint violated there, -1 where none is.
        colliding: (n, samples) whether a sample collides; only samples that both arms reach can.
    """

    outputs: Mapping[str, Array]
    first_sample: NDArray[np.int64]
    first_reason: NDArray[np.int64]
    colliding: NDArray[np.bool_]


def one_by_one(outputs: Mapping[str, Array], checker: CollisionChecker) -> SampledVerdicts:
    """The verdicts from every per-sample output of the candidate function, in NumPy.

    What `hybrid_opt.evaluate.kernel` does in lanes; used where there can be no kernel.
    """
    violated = np.asarray(outputs["constraint"] > 0.0)
    bad = np.asarray(np.any(violated, axis=2))
    n, samples = bad.shape
    first = np.where(bad.any(axis=1), np.argmax(bad, axis=1), samples)
    at = np.minimum(first, samples - 1)
    reason = np.where(first < samples, np.argmax(violated[np.arange(n), at], axis=1), -1)
    colliding = np.zeros((n, samples), dtype=bool)
    totals = np.column_stack([outputs["violation"], outputs["time"]])
    finite = np.isfinite(totals).all(axis=1)
    for row in np.flatnonzero(finite).tolist():
        reached = reached_samples(outputs, row)
        pose, q_1, q_2, time = (
            outputs[name][row, :reached] for name in ("pose", "q_1", "q_2", "time")
        )
        colliding[row, :reached] = checker.check(pose, q_1, q_2, time).colliding
    return SampledVerdicts(outputs, first, reason, colliding)


def reached_samples(outputs: Mapping[str, Array], row: int) -> int:
    """Number of samples of a candidate before an arm loses the path: those that can collide."""
    lost = (outputs["lost_1"][row] > 0.0) | (outputs["lost_2"][row] > 0.0)
    return int(np.argmax(lost)) if lost.any() else len(lost)


def collision_shares(colliding: NDArray[np.bool_], time: Array) -> Array:
    """Share (n,) of the duration that the colliding samples (n, samples) stand for."""
    shares = np.zeros(len(time))
    durations = sample_durations(time)
    for row in np.flatnonzero(colliding.any(axis=1)).tolist():
        shares[row] = durations[row, colliding[row]].sum() / time[row, -1]
    return shares
