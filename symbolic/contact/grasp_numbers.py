"""What formulas of pads anywhere hold beside the pads' own numbers, as NumPy derives it.

That is the squeeze to start from, and how wrenches balance a load.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from symbolic.array import Array
from symbolic.contact.force_closure import (
    EVEN,
    WRENCH_SIZE,
    balance_maps,
    closing_squeeze,
    presses_evenly,
    scaled_patch,
    state_size,
)
from symbolic.errors import SettingsError
from symbolic.records import Contact, Workcell
from symbolic.records.numbered import GraspNumbers
from symbolic.records.poses import box_rotation, skew
from symbolic.records.quantities import GRAVITY

LOAD_SIZE = 6
"""Force and moment about the box frame's origin, along the box's axes [N, N m]."""

MOMENT_ARM = 0.1
"""Lever of moments in the load's scale [m]: about half a payload, so they count like forces."""


LEAST_NEW = 0.1
"""Share of a component's effect that no earlier one has, for it to be one that is left."""


def left_components(workcell: Workcell) -> tuple[int, ...]:
    """Components of the scaled wrenches that are what the others leave: all of the last pad's, or
    of pads that press evenly the first ones that reach every load, forces before moments.

    The choice is structure: it knows neither friction nor sizes, and slightly other places of pads
    do not change it, as they would change pivots that are nearly alike.
    """
    if not presses_evenly(workcell):
        n = WRENCH_SIZE * len(workcell.pads)
        return tuple(range(n - WRENCH_SIZE, n))
    effects = np.hstack(balance_maps(workcell, in_units=True)).astype(float)
    effects[3:LOAD_SIZE] /= MOMENT_ARM
    effects /= np.linalg.norm(effects, axis=0)
    moments = np.arange(effects.shape[1]) % len(EVEN) == len(EVEN) - 1
    order, least = np.argsort(moments, kind="stable").tolist(), LEAST_NEW
    while len(taken := _new_columns(effects, order, least)) < len(effects) and least > 1e-9:
        least *= 0.1
    return tuple(sorted(taken))


def _new_columns(matrix: Array, order: Sequence[int], least: float) -> list[int]:
    """Columns, in an order, of which more than a length is outside the span of those before."""
    taken: list[int] = []
    span = np.zeros((len(matrix), 0))
    for k in order:
        beyond = matrix[:, k] - span @ (span.T @ matrix[:, k])
        length = np.linalg.norm(beyond)
        if length > least and len(taken) < len(matrix):
            taken.append(k)
            span = np.column_stack([span, beyond / length])
    return taken


def derived(workcell: Workcell, reach: float = 1.0) -> GraspNumbers:
    """The numbers of a grasp, without those of its place at rest.

    Args:
        reach: size of the patches that the squeeze has to lie within, over the cell's own.

    Raises:
        SettingsError: no squeeze holds the payload whatever is asked.
    """
    left = np.array(left_components(workcell))
    cell = workcell if reach == 1.0 else smaller_patches(workcell, reach)
    squeeze = closing_squeeze(cell)
    if squeeze is None:
        raise SettingsError(
            "the pads do not close their grasp: no internal squeeze lies within their friction "
            "cones; raise the friction or turn them towards one another"
        )
    # The least states that balance a load, whether they lie within the cones or not.
    whole, in_units = (np.hstack(balance_maps(cell, units)) for units in (False, True))
    free = np.setdiff1d(np.arange(in_units.shape[1]), left)
    to_left = np.linalg.inv(in_units[:, left]).astype(float)
    return GraspNumbers(
        left=tuple(left.tolist()),
        squeeze=np.concatenate(squeeze.states),
        spread=np.linalg.pinv(whole)[:, :LOAD_SIZE],
        load_to_left=_cleaned(to_left[:, :LOAD_SIZE]),
        free_to_left=_cleaned(to_left @ in_units[:, free]),
        to_robots=robot_wrenches(workcell),
        shapes=tuple(_shape(presses_evenly(workcell), pad) for pad in workcell.pads),
        load_at_rest=_load_at_rest(workcell),
        rest=None,
        rest_slopes=None,
        reach=reach,
        least_reaches=np.array(least_reaches(workcell)),
    )


def grasp_shapes(workcell: Workcell) -> dict[str, Any]:
    """Shapes of all arrays of `GraspNumbers`; `shapes` has one per pad."""
    even, pads = presses_evenly(workcell), workcell.pads
    b, m = len(left_components(workcell)), len(EVEN if even else range(WRENCH_SIZE)) * len(pads)
    n = m if even else sum(state_size(pad) for pad in pads)
    return {
        "squeeze": (n,),
        "spread": (n, LOAD_SIZE),
        "load_to_left": (b, LOAD_SIZE),
        "free_to_left": (b, m - b),
        "to_robots": (LOAD_SIZE, WRENCH_SIZE * len(pads)),
        "shapes": tuple(_shape(even, pad).shape for pad in pads),
        "load_at_rest": (LOAD_SIZE,),
        "rest": (n,),
        "rest_slopes": (n, LOAD_SIZE),
        "reach": (),
        "least_reaches": (2,),
    }


def _shape(even: bool, pad: Contact) -> Array:
    """What a pad's cone depends on: mean distance and spread of an even patch, or the half sides of
    a rectangle, over its radius; none of a disc."""
    if pad.half_sides is None:
        return np.zeros(0)
    if not even:
        return np.array(pad.half_sides) / pad.patch_radius
    patch = scaled_patch(pad)
    return np.array([patch.twist, *np.diag(patch.spread)])


def least_reaches(workcell: Workcell) -> tuple[float, float]:
    """Least radius or half side of each robot's patches [m]."""
    first, second = (
        min(pad.patch_radius if pad.half_sides is None else min(pad.half_sides) for pad in pads)
        for pads in ((contact, *contact.further) for contact in workcell.contacts)
    )
    return first, second


def smaller_patches(workcell: Workcell, share: float) -> Workcell:
    """The cell with smaller patches about the same places."""

    def smaller(contact: Contact) -> Contact:
        sides = contact.half_sides
        return replace(
            contact,
            patch_radius=share * contact.patch_radius,
            half_sides=None if sides is None else (share * sides[0], share * sides[1]),
            further=tuple(smaller(pad) for pad in contact.further),
        )

    first, second = (smaller(contact) for contact in workcell.contacts)
    return replace(workcell, contacts=(first, second))


def robot_wrenches(workcell: Workcell) -> Array:
    """(6, 6 k) from all pads' wrenches, see `grasp_wrenches`, to force and moment of the robot that
    has the pad about its nominal contact point, along the axes of contact 1."""
    axes, columns = workcell.contacts[0].T_box_pad[:3, :3], []
    for pad, robot in zip(workcell.pads, workcell.pad_robots, strict=True):
        force, moment = np.zeros((2, 3, WRENCH_SIZE))
        force[[0, 1, 2], [1, 2, 0]] = 1.0
        # A normal force N n at d turns about d x n = (d_y, -d_x).
        moment[[0, 1, 2], [4, 3, 5]] = 1.0, -1.0, 1.0
        beside = pad.T_box_pad[:3, 3] - workcell.contacts[robot].T_box_pad[:3, 3]
        to_axes = axes.T @ pad.T_box_pad[:3, :3]
        force = to_axes @ force
        moment = to_axes @ moment + skew(axes.T @ beside) @ force
        columns.append(np.vstack([force, moment]))
    return np.hstack(columns)


def _load_at_rest(workcell: Workcell) -> Array:
    """(6,) of the payload as it stands at the start, as a direction that is scaled like loads."""
    turn = box_rotation(workcell.task.orientation, workcell.task.waypoints[0].lower)
    force = -turn.T @ np.array(GRAVITY)
    moment = np.cross(workcell.payload.centre_of_mass, force)
    load = np.concatenate([force, moment])
    return np.asarray(load / np.hypot(np.linalg.norm(force), np.linalg.norm(moment) / MOMENT_ARM))


def _cleaned(matrix: Array) -> Array:
    """Without what is zero but for rounding."""
    return np.where(np.abs(matrix) < 1e-14 * np.abs(matrix).max(), 0.0, matrix)
