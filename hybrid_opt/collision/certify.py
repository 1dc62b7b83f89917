"""Continuous certification of a final trajectory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hybrid_opt.collision.between import PROOF_DEPTH, MotionVerdict, check_between
from hybrid_opt.collision.checker import CollisionChecker
from hybrid_opt.collision.verdict import Touch
from symbolic.array import Array
from symbolic.errors import SettingsError

Configuration = Callable[[Array], tuple[Array, Array, Array]]
"""From path parameters (n,) to box poses (n, 6) and joint positions q_1, q_2 (n, 6)."""

STRAIGHTNESS = 1e-4
"""Default for how far two bodies together may be off straight motion between grid points [m]."""

MOST_ROUNDS = 14
"""Halvings of the grid after which a path counts as not smooth."""


@dataclass(frozen=True, repr=False)
class Certificate:
    """The result of a certification.

    Attributes:
        is_free: proven free of collisions, within the meaning of `certify`.
        at_sample: a collision at a grid point, or None.
        at_parameter: path parameter of the earliest collision or undecided place; NaN if free.
        motion: the verdict between the grid points; None where a grid point collides.
        points: grid points used.
        deviation: largest measured distance of a pair from straight motion between them [m].
    """

    is_free: bool
    at_sample: Touch | None
    at_parameter: float
    motion: MotionVerdict | None
    points: int
    deviation: float

    def __repr__(self) -> str:
        if self.is_free:
            return f"Certificate: free of collisions along the whole path ({self.points} points)"
        contact = self.at_sample or (None if self.motion is None else self.motion.contact)
        who = f"{contact.first} and {contact.second}" if contact is not None else "undecided"
        return f"Certificate: not free at u = {self.at_parameter:.4f}, {who}"


def certify(
    checker: CollisionChecker,
    configuration: Configuration,
    parameters: Array,
    straightness: float = STRAIGHTNESS,
    depth: int = PROOF_DEPTH,
) -> Certificate:
    """Prove that a continuous path is free of collisions, or find where it is not.

    The grid is refined until no pair of bodies is, both together, farther than `straightness`
    from straight motion (linear in joints and box pose) in the middle of any interval. The
    straight motion is then checked by adaptive subdivision with a margin of twice that distance.
    So the proof holds for a path whose largest distance from straight motion in an interval is
    at most twice the one in its middle, as for every path that is smooth on the grid.

    Args:
        parameters: (n,) increasing path parameters to start from.

    Raises:
        SettingsError: the path does not become straight on any grid.
    """
    u = np.asarray(parameters, dtype=float)
    for _ in range(MOST_ROUNDS):
        grid = configuration(u)
        middle = configuration((u[:-1] + u[1:]) / 2.0)
        straight = tuple((array[:-1] + array[1:]) / 2.0 for array in grid)
        chords = checker.motion(middle, (straight[0], straight[1], straight[2])).chord
        off = np.max(chords, axis=1, initial=0.0)
        deviation = float(np.max(off))
        if deviation <= straightness:
            break
        split = off > straightness
        u = np.sort(np.concatenate([u, ((u[:-1] + u[1:]) / 2.0)[split]]))
    else:
        raise SettingsError(
            f"the path is still {deviation:g} m off straight motion in an interval of length "
            f"{float(np.min(np.diff(u))):g}; it jumps or the straightness of {straightness:g} m "
            "is too small"
        )
    clearance = checker.bounds(*grid)
    verdict = checker.check(*grid, u, clearance)
    if verdict.first_contact is not None:
        hit = verdict.first_contact
        return Certificate(False, hit, float(u[hit.sample]), None, len(u), deviation)
    motion = check_between(checker, np.hstack(grid), clearance, depth, 2.0 * deviation)
    where = float("nan")
    if motion.contact is not None:
        k = motion.contact.interval
        where = float(u[k] + motion.contact.fraction * (u[k + 1] - u[k]))
    return Certificate(motion.status == "free", None, where, motion, len(u), deviation)
