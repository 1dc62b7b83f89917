"""Elastic layers between the payload and arms that keep their poses: how they share a load, and how
the pressure shifts.

Each pad is a layer of springs with equal stiffness over its area. The payload moves by six numbers
until all layers together balance the load. Pad i has the stiffness K_i; A_i maps its wrench to a
wrench about the box frame. Its share of the load is K_i A_i^T (sum_j A_j K_j A_j^T)^-1, a constant
matrix.

Evenly pressing pads (`symbolic.contact.soft_finger`) are a limit: the box on a soft layer turns a
little relative to the arms, and the pressure tilts. The layer's moments about its tangents shift
its centre of pressure. The pressure at a rim vanishes at a shift of a quarter of a disc's radius,
of half a cup's radius, or of a third of a rectangle's half side.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from symbolic.array import Array
from symbolic.contact.force_closure import wrench_to_box
from symbolic.records import Contact, Workcell


def layer_shares(pads: Sequence[Contact]) -> Array:
    """Compute how a load is shared among n pads on elastic layers.

    Returns:
        (n, 6, 6) one matrix per pad. It maps the load, force [N] and moment [N m] about the box
        frame's origin along the box's axes, to the pad's wrench on the payload, about the pad's
        origin along the pad's axes.
    """
    maps, stiff = [wrench_to_box(pad) for pad in pads], [layer_stiffness(pad) for pad in pads]
    whole = sum(A @ K @ A.T for A, K in zip(maps, stiff, strict=True))
    return np.array([K @ A.T @ np.linalg.inv(whole) for A, K in zip(maps, stiff, strict=True)])


def pressure_shifts(workcell: Workcell, load: Array, normal: Array) -> Array:
    """Compute how far the centres of pressure shift, relative to the shift at which a pad's rim
    lifts off.

    Args:
        workcell: cell whose pads share each robot's normal force in proportion to their areas.
        load: (n, 6) force and moment about the box frame's origin, along the box's axes [N, N m],
            at n samples.
        normal: (n, 2) normal forces of the robots [N].

    Returns:
        (n, 2) largest ratio among each robot's pads. A rim lifts off if it exceeds 1.
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
    """Compute the smallest shift of a pad's centre of pressure along one of its axes at which the
    rim lifts off [m]."""
    return float(min(kern(pad)))


def kern(pad: Contact) -> tuple[Any, Any]:
    """Compute the shifts of the centre of pressure [m] at which a pad's rim lifts off: first for a
    shift along the pad's x axis alone, then along its y axis. They are symbols if the pad's lengths
    are symbols."""
    if pad.half_sides is None:
        share = 2.0 if pad.is_ring else 4.0
        return pad.patch_radius / share, pad.patch_radius / share
    return pad.half_sides[0] / 3.0, pad.half_sides[1] / 3.0


def layer_stiffness(pad: Contact) -> Array:
    """Compute the stiffness (6, 6) of a pad's elastic layer about the pad's origin, along the pad's
    axes.

    The unit is the normal stiffness per area of a layer with `layer_stiffness` 1, so translations
    have entries in m^2 and rotations in m^4.
    """
    area = pad.area
    # Means of the squared coordinates: the side, or the radius of a ring or a disc, times the kern.
    if pad.half_sides is None:
        squares = [pad.patch_radius * shift for shift in kern(pad)]
    else:
        squares = [side * shift for side, shift in zip(pad.half_sides, kern(pad), strict=True)]
    x_squared, y_squared = squares
    along = pad.layer_shear
    torsion = along * (x_squared + y_squared)
    area = area * pad.layer_stiffness
    return area * np.diag([along, along, 1.0, y_squared, x_squared, torsion])
