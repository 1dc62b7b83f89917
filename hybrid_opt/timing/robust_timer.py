"""Timings of many paths whose robust forces keep to a limit, by the compiled passes.

Robust forces are convex in (u'', u'^2) (`hybrid_opt.robust.path_force`), but take an interior-point
method per case. So they enter as supporting lines: the passes drive the paths, where the forces
come near the limit their tangents are added, and the passes drive again (Kelley's cutting planes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction
from hybrid_opt.robust.path_force import BY_TIMING, PathPoints, RobustPath
from symbolic.array import Array

CUTS = 24
"""Supporting lines that a sample has room for; the oldest make room for new ones."""

ROUNDS = 20
TOLERANCE = 1e-4
"""Excess over the limit that counts as none, as a share of it."""

NEAR = 0.98
"""Forces above this share of the limit have a tangent in advance."""

STILL = 1.0 - 1e-6
"""Share of the limit that standing still may use, as in the passes."""


@dataclass(frozen=True)
class RestForce:
    """Where standing still needs more than the limit.

    Attributes:
        force: (2,) largest robust forces of both robots standing still [N].
        sample: where the larger of them is.
    """

    force: Array
    sample: int


@dataclass
class _Paths:
    """Some paths with their limits, and the lines that they have so far.

    Attributes:
        parts: (n, samples, 6) box poses and their derivatives by u.
        limit: (n,) [N].
        cuts: (n, samples, CUTS, 3).
        count: (n, samples) how many each sample was given.
        peak: (n, 2) largest robust forces of the last timing [N].
    """

    parts: tuple[Array, Array, Array]
    limit: Array
    cuts: Array
    count: NDArray[np.intp]
    peak: Array


class RobustPasses:
    """The passes of one workcell with lines for its robust forces."""

    def __init__(self, passes: NumericFunction, forces: RobustPath, intervals: int) -> None:
        """passes: `hybrid_opt.timing.passes.passes_function` with `CUTS`."""
        self._passes, self._forces, self._intervals = passes, forces, intervals
        # Both ends and the middle of every interval, each with its interval's u''.
        first = 2 * np.arange(intervals)[:, None]
        self._sample = (first + np.array([0, 1, 2])).reshape(-1)
        self._share = np.tile([0.0, 0.5, 1.0], intervals)

    def time(
        self, paths: dict[str, Array], options: Array, threads: int
    ) -> tuple[dict[str, Array], Array, list[RestForce | None]]:
        """Drive n paths.

        Args:
            paths: their `hybrid_opt.timing.path_timer.PathTimer.path_limits`.
            options: (n, 4) of the passes, finite force limits first.
            threads: threads that share a batch.

        Returns:
            The passes' outputs; (n, 2) largest robust forces [N]; and of each path whether it
            cannot stand still.
        """
        n, samples = len(options), 2 * self._intervals + 1
        names = ("pose", "pose_first", "pose_second")
        parts = [np.ascontiguousarray(paths[name][:, :, :6]) for name in names]
        cuts = np.zeros((n, samples, CUTS, 3))
        cuts[..., 2] = np.inf
        state = _Paths(
            (parts[0], parts[1], parts[2]),
            options[:, 0],
            cuts,
            np.zeros((n, samples), dtype=np.intp),
            np.zeros((n, 2)),
        )
        still = self._at_rest(state)
        out = self._passes.batch(paths["limits"], options, state.cuts, threads=threads)
        left = np.array([k for k in range(n) if still[k] is None], dtype=np.intp)
        for _ in range(ROUNDS):
            left = left[np.isfinite(out["duration"][left])]
            left = left[self._cut(state, left, out["squared"][left])]
            if not len(left):
                break
            driven = (paths["limits"][left], options[left], state.cuts[left])
            fresh = self._passes.batch(*driven, threads=threads)
            for name, values in fresh.items():
                out[name][left] = values
        return out, state.peak, still

    def _at_rest(self, state: _Paths) -> list[RestForce | None]:
        """Which paths cannot stand still; the others get a tangent there."""
        n, samples = len(state.limit), state.parts[0].shape[1]
        found: list[RestForce | None] = [None] * n
        path, sample = np.divmod(np.arange(n * samples), samples)
        points = self._points(state, path, sample, *np.zeros((2, n * samples)))
        rows, force, slope = self._forces.beyond(points, NEAR * state.limit[path])
        for k in np.unique(path[rows]):
            own = path[rows] == k
            at = int(force[own].max(axis=1).argmax())
            if force[own].max() > STILL * state.limit[k]:
                found[k] = RestForce(force[own].max(axis=0), int(sample[rows][own][at]))
        place = (path[rows], sample[rows])
        self._add(state, place, np.zeros((len(rows), 2)), force, slope[:, :, BY_TIMING])
        return found

    def _cut(self, state: _Paths, chosen: NDArray[np.intp], squared: Array) -> NDArray[np.bool_]:
        """Add tangents where timings (m, intervals + 1) of the chosen paths come near their limits;
        which of them exceed theirs."""
        m, per = len(chosen), len(self._sample)
        if not m:
            return np.zeros(0, dtype=bool)
        begin = np.repeat(squared[:, :-1], 3, axis=1)
        rise = np.repeat(np.diff(squared, axis=1), 3, axis=1)
        w = (begin + self._share * rise).reshape(-1)
        a = (rise * self._intervals / 2.0).reshape(-1)
        path, sample = np.repeat(chosen, per), np.tile(self._sample, m)
        points, limit = self._points(state, path, sample, a, w), state.limit[path]
        rows, ruling = self._forces.ruling_beyond(points, NEAR * limit)
        force = ruling.force
        exceeded = np.zeros(len(state.limit), dtype=bool)
        exceeded[path[rows][force.max(axis=1) > (1.0 + TOLERANCE) * limit[rows]]] = True
        state.peak[chosen] = 0.0
        np.maximum.at(state.peak, path[rows], force)
        for k in chosen[state.peak[chosen].max(axis=1) == 0.0]:
            own = np.flatnonzero(path == k)
            state.peak[k] = self._forces.at(points.at(own))[0].max(axis=0)
        keep = np.flatnonzero(exceeded[path[rows]])
        z = np.stack([a[rows], w[rows]], axis=1)[keep]
        place = (path[rows][keep], sample[rows][keep])
        slope = self._forces.slopes(points.at(rows[keep]), ruling.at(keep))
        self._add(state, place, z, force[keep], slope[:, :, BY_TIMING])
        return exceeded[chosen]

    def _add(
        self,
        state: _Paths,
        place: tuple[NDArray[np.intp], NDArray[np.intp]],
        z: Array,
        force: Array,
        slope: Array,
    ) -> None:
        """Tangents of the larger force at points z (m, 2) of paths and samples `place`."""
        larger, every = force.argmax(axis=1), np.arange(len(force))
        limit = state.limit[place[0]]
        gradient = slope[every, larger] / limit[:, None]
        bound = 1.0 - force[every, larger] / limit + (gradient * z).sum(axis=1)
        lines = np.column_stack([gradient, bound])
        # Ends of neighbouring intervals share a sample: one after the other.
        for path, sample, line in zip(*place, lines, strict=True):
            state.cuts[path, sample, state.count[path, sample] % CUTS] = line
            state.count[path, sample] += 1

    def _points(
        self, state: _Paths, path: NDArray[np.intp], sample: NDArray[np.intp], a: Array, w: Array
    ) -> PathPoints:
        pose, first, second = (part[path, sample] for part in state.parts)
        return PathPoints(pose, first, second, a, w)
