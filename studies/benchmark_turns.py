"""Ways of evaluating candidates that take turns on one core, and what they cost.

Times are the thread's own processor time, so that waiting for a busy machine does not count.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping

import numpy as np

from symbolic.array import Array

Evaluate = Callable[[Array], object]

SLICE = 0.05
"""Least time of one way in one round [s]; fast ways go on with the next candidates to fill it, as a
search goes on with its next generation: what another way left in the caches costs no more than
there."""


def interleaved(
    ways: Mapping[str, Evaluate], x: Mapping[str, Array], repeats: int
) -> dict[str, Array]:
    """Seconds per call of every way in every round (rounds,); the ways take turns.

    Args:
        ways: functions of one decision vector, or of one batch of them, by name.
        x: per way what it is called with: decision vectors (n, n_var) or batches
            (n, size, n_var), the same n for all.
        repeats: rounds with each of the n.
    """
    counts = {}
    for name, evaluate in ways.items():
        evaluate(x[name][0])
        counts[name] = max(1, int(np.ceil(SLICE / _seconds(evaluate, x[name], 0, 1))))
    n = len(next(iter(x.values())))
    times: dict[str, list[float]] = {name: [] for name in ways}
    for round_ in range(n * repeats):
        # Every other round backwards: what comes first has no advantage.
        for name in list(ways)[:: 1 if round_ % 2 == 0 else -1]:
            times[name].append(_seconds(ways[name], x[name], round_, counts[name]))
    return {name: np.array(values) for name, values in times.items()}


def _seconds(evaluate: Evaluate, x: Array, first: int, count: int) -> float:
    """Seconds per call for `count` rows of x one after the other."""
    start = time.thread_time()
    for k in range(first, first + count):
        evaluate(x[k % len(x)])
    return (time.thread_time() - start) / count


def summary(
    times: Mapping[str, Array], average: Callable[[Array], np.floating] = np.median
) -> dict[str, float]:
    """Averages [ms] of every way and averages of the ratios within a round.

    Args:
        times: seconds per candidate (rounds,) of 'compiled', 'interpreted' and 'plain'.
        average: over the rounds.
    """
    ratios = {
        f"{name}_over_compiled": float(average(times[name] / times["compiled"]))
        for name in ("plain", "interpreted")
    }
    return {f"{name}_ms": 1e3 * float(average(value)) for name, value in times.items()} | ratios


def progress(text: str) -> None:
    """Tell what is being done, apart from the results."""
    print(text, file=sys.stderr, flush=True)
