"""Where elastic pads press when arms keep their orientation: shifts of their centres of pressure.

Pads that press evenly are a limit (`symbolic.contact.soft_finger`): a layer that gives lets the box
turn a little against the arms, and its pressure tilts with it. Each pad is a layer of springs, of
equal stiffness all over its area; the box moves by six numbers until all layers together carry the
load. What a layer then carries as moments about its tangents shifts its pressure. A shift of a
quarter of a disc's radius, or of a third of a rectangle's half side, takes the pressure off a rim.
"""

from __future__ import annotations

import numpy as np

from symbolic.array import Array
from symbolic.contact.force_closure import wrench_to_box
from symbolic.records import Contact, Workcell

SHEAR = 1.0 / 3.0
"""Stiffness of a layer along it over that across it: rubber keeps its volume."""


def pressure_shifts(workcell: Workcell, load: Array, normal: Array) -> Array:
    """(n, 2) shifts of the centres of pressure over those that take the pressure off a rim; the
    largest of a robot's pads.

    Args:
        workcell: whose pads share each robot's normal force by their areas.
        load: (n, 6) force and moment about the box frame's origin, box axes [N, N m].
        normal: (n, 2) normal forces of the robots [N].
    """
    pads, robots = workcell.pads, workcell.pad_robots
    maps, stiff = [wrench_to_box(pad) for pad in pads], [_stiffness(pad) for pad in pads]
    whole = sum(A @ K @ A.T for A, K in zip(maps, stiff, strict=True))
    moved = np.linalg.solve(whole, load.T)
    area = np.array([K[2, 2] for K in stiff])
    own = np.bincount(robots, area, 2)[list(robots)]
    found = np.zeros((len(load), 2))
    for i, (pad, robot) in enumerate(zip(pads, robots, strict=True)):
        tilting = (stiff[i] @ maps[i].T @ moved)[3:5]
        # A normal force N n at d turns about d x n = (d_y, -d_x).
        shift = np.abs(tilting[::-1]) / (normal[:, robot] * area[i] / own[i])
        if pad.half_sides is None:
            use = np.linalg.norm(shift, axis=0) / free_shift(pad)
        else:
            use = np.abs(shift / (np.array(pad.half_sides)[:, None] / 3.0)).sum(axis=0)
        found[:, robot] = np.maximum(found[:, robot], use)
    return found


def free_shift(pad: Contact) -> float:
    """Shift of a pad's centre of pressure that takes the pressure off its rim [m]."""
    if pad.half_sides is None:
        return pad.patch_radius / 4.0
    return min(pad.half_sides) / 3.0


def _stiffness(pad: Contact) -> Array:
    """(6, 6) of a pad's layer, in its axes, over that of a unit of area across it."""
    if pad.half_sides is None:
        area = np.pi * pad.patch_radius**2
        x_squared = y_squared = area * pad.patch_radius**2 / 4.0
    else:
        x, y = pad.half_sides
        area = 4.0 * x * y
        x_squared, y_squared = area * x**2 / 3.0, area * y**2 / 3.0
    along = [SHEAR * area, SHEAR * area, area]
    return np.diag([*along, y_squared, x_squared, SHEAR * (x_squared + y_squared)])
