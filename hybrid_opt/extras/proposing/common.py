"""Positions of the joints that move both arms of a machine, chosen once for both arms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np

from hybrid_opt.extras.proposing.holding import (
    LIMIT_MARGIN,
    SEARCH_DAMPING,
    HoldQuery,
    possible_spins,
)
from hybrid_opt.extras.proposing.kinematics import REACHED, ArmKinematics
from symbolic.array import Array
from symbolic.records.poses import box_placement

COMPARED_POSITIONS = 64
"""Number of random positions that are compared."""

COMPARED_STARTS = 24
"""Number of random postures of either arm from which a position is evaluated."""

REACHING_STEPS = 25
"""Number of Newton steps from these postures."""

MOVED = 4
"""Number of positions at the start, and at the goal, between which common joints may move."""

MOVE_COST = 0.05
"""Cost of moving common joints by a radian or a metre, as a share of reaching postures."""


def common_positions(
    arms: Sequence[ArmKinematics], query: HoldQuery, rng: np.random.Generator
) -> Iterator[Array | None]:
    """Yield positions of the joints that move both arms, such as a torso, at the start and at the
    goal.

    The most promising positions come first; the very first are zero, as far as the limits allow.
    Positions are promising if many random postures of each arm reach the box at both ends, within
    joint limits and away from singular postures, and if the joints move little.

    Args:
        arms: both arms.
        query: box poses at start and goal, and rotations of the pads to try.
        rng: generator of positions and postures.

    Yields:
        (2, k) positions of the k joints at start and goal [rad or m]; None, once, if there are no
        such joints.
    """
    if not arms[0].common:
        yield None
        return
    spans = [arm.span[:, arm.common] for arm in arms]
    low, high = np.maximum(spans[0][0], spans[1][0]), np.minimum(spans[0][1], spans[1][1])
    held = np.clip(0.0, low, high)
    yield np.array([held, held])
    drawn = rng.uniform(low, high, (COMPARED_POSITIONS - 2, len(low)))
    positions = np.vstack([held, (low + high) / 2.0, drawn])
    start, goal = (
        np.min([_reaching(arm, pose, query.spins, positions, rng) for arm in arms], axis=0)
        for pose in (query.start, query.goal)
    )
    ways = {(k, k) for k in range(COMPARED_POSITIONS)}
    ways |= set(product(np.argsort(-start)[:MOVED].tolist(), np.argsort(-goal)[:MOVED].tolist()))

    def promise(way: tuple[int, int]) -> float:
        move = float(np.linalg.norm(positions[way[1]] - positions[way[0]]))
        return float(min(start[way[0]], goal[way[1]])) - MOVE_COST * move

    ordered = sorted(ways - {(0, 0)}, key=lambda way: (-promise(way), way))
    found = [way for way in ordered if min(start[way[0]], goal[way[1]]) > 0.0]
    yield from (positions[list(way)] for way in found)


def _reaching(
    arm: ArmKinematics, pose: Array, spins: Array, positions: Array, rng: np.random.Generator
) -> Array:
    """Compute the share of an arm's random postures from which Newton's method reaches the box, for
    given positions of the joints that move both arms.

    Args:
        arm: the arm.
        pose: (6,) pose of the box [m, rad].
        spins: (s,) rotations of the pad about its normal that are tried [rad].
        positions: (n, k) positions of the k joints that move both arms [rad or m].
        rng: generator of random postures.

    Returns:
        (n,) shares, one for each row of `positions`.
    """
    T_world_box = box_placement(arm.workcell.task.orientation, pose)
    possible = possible_spins(arm.workcell.contacts[arm.arm], spins)
    targets = np.array([T_world_box @ arm.held(spin) for spin in possible])
    q = arm.drawn(len(positions) * COMPARED_STARTS, rng)
    q[:, arm.common] = np.repeat(positions, COMPARED_STARTS, axis=0)
    found = arm.solve(q, targets[np.arange(len(q)) % len(targets)], REACHING_STEPS, SEARCH_DAMPING)
    q = found.q + np.vstack([arm.central(row[None, None])[0] for row in found.q])
    inside = (q >= arm.lower + LIMIT_MARGIN) & (q <= arm.upper - LIMIT_MARGIN)
    fine = inside.all(axis=1) & (found.residual <= REACHED) & (found.manipulability >= arm.least)
    return np.asarray(fine.reshape(-1, COMPARED_STARTS).mean(axis=1))
