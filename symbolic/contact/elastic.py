"""Elastic layers between the payload and arms that keep their poses: their shares of a load, and
the resulting shift of the pressure.

Each pad is a layer of springs with equal stiffness over its area. The payload moves by six numbers
until all layers together balance the load. With a pad's stiffness K_i and the map A_i from its
wrench to one about the box frame, its share is K_i A_i^T (sum_j A_j K_j A_j^T)^-1 of the load: a
constant matrix.

Evenly pressing pads (`symbolic.contact.soft_finger`) are a limit: the box on a soft layer turns a
little relative to the arms, and its pressure tilts. The layer's moments about its tangents shift
its centre of pressure. A shift of a quarter of a disc's radius, of half a cup's, or of a third of a
rectangle's half side, makes the pressure at a rim vanish.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from symbolic.array import Array
from symbolic.contact.force_closure import wrench_to_box
from symbolic.records import Contact, Workcell

SHEAR = 1.0 / 3.0
"""Stiffness of a layer along it over that across it: rubber keeps its volume."""


def layer_shares(pads: Sequence[Contact]) -> Array:
    """Compute the matrices (n, 6, 6) from a load to its shares, the wrenches of n pads.

    The load is force and moment about the box frame's origin, box axes; a wrench is that of the pad
    on the payload about the pad's place, in the pad's axes [N, N m].
    """
    maps, stiff = [wrench_to_box(pad) for pad in pads], [layer_stiffness(pad) for pad in pads]
    whole = sum(A @ K @ A.T for A, K in zip(maps, stiff, strict=True))
    return np.array([K @ A.T @ np.linalg.inv(whole) for A, K in zip(maps, stiff, strict=True)])


def pressure_shifts(workcell: Workcell, load: Array, normal: Array) -> Array:
    """Compute the shifts (n, 2) of the centres of pressure over the shifts at which the pressure at
    a rim vanishes; the largest of a robot's pads.

    Args:
        workcell: its pads share each robot's normal force in proportion to their areas.
        load: (n, 6) force and moment about the box frame's origin, box axes [N, N m].
        normal: (n, 2) normal forces of the robots [N].
    """
    pads, robots = workcell.pads, workcell.pad_robots
    area = np.array([pad.area for pad in pads])
    own = np.bincount(robots, area, 2)[list(robots)]
    found = np.zeros((len(load), 2))
    for i, share in enumerate(layer_shares(pads)):
        tilting = share[3:5] @ load.T
        # A normal force N n at d turns about d x n = (d_y, -d_x).
        shift = np.abs(tilting[::-1]) / (normal[:, robots[i]] * area[i] / own[i])
        use = shift / np.array(kern(pads[i]))[:, None]
        is_round = pads[i].half_sides is None
        use = np.linalg.norm(use, axis=0) if is_round else use.sum(axis=0)
        found[:, robots[i]] = np.maximum(found[:, robots[i]], use)
    return found


def free_shift(pad: Contact) -> float:
    """Compute the shift of a pad's centre of pressure at which the pressure at a rim vanishes
    [m]."""
    return float(min(kern(pad)))


def kern(pad: Contact) -> tuple[Any, Any]:
    """Compute the shifts along a pad's axes at which the pressure at a rim vanishes, numbers or
    symbols [m]."""
    if pad.half_sides is None:
        share = 2.0 if pad.is_ring else 4.0
        return pad.patch_radius / share, pad.patch_radius / share
    return pad.half_sides[0] / 3.0, pad.half_sides[1] / 3.0


def layer_stiffness(pad: Contact) -> Array:
    """Compute the stiffness (6, 6) of a pad's layer, in its axes, over the normal stiffness per
    area."""
    area = pad.area
    # Means of the squared coordinates: the side, or the radius of a ring or a disc, times the kern.
    if pad.half_sides is None:
        squares = [pad.patch_radius * shift for shift in kern(pad)]
    else:
        squares = [side * shift for side, shift in zip(pad.half_sides, kern(pad), strict=True)]
    x_squared, y_squared = squares
    torsion = SHEAR * (x_squared + y_squared)
    return area * np.diag([SHEAR, SHEAR, 1.0, y_squared, x_squared, torsion])
