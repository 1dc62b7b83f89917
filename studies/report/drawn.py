"""What pictures of a cell show: where its arms reach, and carries by their labels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.carry import Carry
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry
from symbolic.records.poses import skew

if TYPE_CHECKING:
    from hybrid_opt.timing.robustness import PayloadSensitivity

STEP = 0.05
"""Edge of the cubes [m]: what a drawing of two metres shows."""

POSTURES = 300_000
"""Random postures per arm; some ten per cube of the reach of an arm of 1.3 m."""


@dataclass(frozen=True)
class ReachMap:
    """Where the arms' pads and the box can be, on a grid of cubes, positions only.

    A cube is reached if a sampled posture within the joint limits puts the pad there.

    Attributes:
        lower: (3,) corner of the grid in the world [m].
        step: edge of the cubes [m].
        pads: per arm a boolean (nx, ny, nz).
        common: boolean (nx, ny, nz), box centres from which a level box has both its pads in
            cubes that their arms reach.
    """

    lower: Array
    step: float
    pads: tuple[NDArray[Any], NDArray[Any]]
    common: NDArray[Any]


def reach_map(geometry: CellGeometry, rng: np.random.Generator) -> ReachMap:
    """Sample both arms' pads over their joint limits.

    Sampling leaves single cubes out; holes of a few cubes are closed.
    """
    clouds = [_pad_points(geometry, i, rng) for i in (0, 1)]
    both = np.concatenate(clouds)
    lower = np.floor(both.min(axis=0) / STEP - 3.0) * STEP
    shape = tuple(np.ceil((both.max(axis=0) - lower) / STEP).astype(int) + 4)
    pads = []
    for cloud in clouds:
        reached = np.zeros(shape, dtype=bool)
        index = ((cloud - lower) / STEP).astype(int)
        reached[index[:, 0], index[:, 1], index[:, 2]] = True
        pads.append(_closed(reached))
    return ReachMap(lower, STEP, (pads[0], pads[1]), _common(geometry, pads))


def _closed(reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cubes that are reached, and holes between them: two layers of neighbours are added and taken
    away. Around the grid's edge nothing is reached."""
    for combine in (np.logical_or, np.logical_or, np.logical_and, np.logical_and):
        beside = [np.roll(reached, step, axis) for axis in range(3) for step in (1, -1)]
        reached = combine.reduce([reached, *beside])
    return reached


def _pad_points(geometry: CellGeometry, i: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """(POSTURES, 3) pad positions in the world, of random postures within the joint limits."""
    arm, contact = geometry.arms[i], geometry.workcell.contacts[i]
    pad = (arm.T_joint_box @ contact.T_box_pad)[:3, 3]
    # Single precision is far more than cubes need, and half the work.
    span = (arm.upper - arm.lower).astype(np.float32)
    q = arm.lower[:, None].astype(np.float32) + span[:, None] * rng.random(
        (arm.joints, POSTURES), dtype=np.float32
    )
    # From the pad back to the root: points are a fifth of the work of placements.
    points = np.tile(pad[:, None].astype(np.float32), POSTURES)
    for j in reversed(range(arm.joints)):
        if arm.turning[j]:  # Rodrigues' formula about the joint's axis
            across = skew(arm.axes[j]).astype(np.float32)
            points += np.sin(q[j]) * (across @ points) + (1.0 - np.cos(q[j])) * (
                across @ across @ points
            )
        else:
            points += np.outer(arm.axes[j].astype(np.float32), q[j])
        points = _seen(arm.origins[j], points)
    return _seen(arm.T_world_root, points).T


def _seen(T: Array, points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Points (3, n) from the frame that T (4, 4) maps into another, in that one."""
    placed = T.astype(np.float32)
    return np.asarray(placed[:3, :3] @ points + placed[:3, 3:])


def _common(geometry: CellGeometry, pads: list[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Box centres for which both shifted pad cubes are reached."""
    common = np.ones(pads[0].shape, dtype=bool)
    for reached, contact in zip(pads, geometry.workcell.contacts, strict=True):
        shift = np.round(contact.T_box_pad[:3, 3] / STEP).astype(int)
        common &= _shifted(reached, shift)
    return common


def _shifted(mask: NDArray[np.bool_], shift: NDArray[np.int64]) -> NDArray[np.bool_]:
    """mask[k + shift] at every k, False beyond the grid."""
    result = np.zeros_like(mask)
    source = tuple(slice(max(s, 0), n + min(s, 0)) for s, n in zip(shift, mask.shape, strict=True))
    target = tuple(
        slice(max(-s, 0), n + min(-s, 0)) for s, n in zip(shift, mask.shape, strict=True)
    )
    result[target] = mask[source]
    return result


@dataclass(frozen=True)
class DrawnCarry:
    """One judged trajectory under the search's timing, and its label for legends."""

    label: str
    timed: Carry

    @property
    def x(self) -> Array:
        """(n_var,) decision vector."""
        return self.timed.x

    @property
    def objectives(self) -> Array:
        """(n_obj,) of the campaign, without penalty."""
        assert self.timed.judgement is not None, "carries of a cell are judged"
        return np.array(list(self.timed.judgement.objectives.values()))

    @cached_property
    def sensitivity(self) -> PayloadSensitivity:
        """Its forces against the payload's mass."""
        # Not imported at the top: pictures of a cell need no timing.
        from hybrid_opt.timing.robustness import payload_sensitivity

        return payload_sensitivity(self.timed)
