"""The forces of holding the payload still, which no carry can stay far below, and what a force
says of the payload that could be carried."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybrid_opt.per_workcell import kept_per_workcell
from symbolic.array import Array
from symbolic.contact.load import load_function
from symbolic.records import Workcell


@dataclass(frozen=True)
class StaticHold:
    """A level box at rest.

    Attributes:
        normal_force: (2,) normal force of each robot [N], read-only.
        contact_force: (2,) magnitude of each robot's whole force [N], read-only.
        payload_limit: payload at which a robot's whole force reaches its reference force [kg].
    """

    normal_force: Array
    contact_force: Array
    payload_limit: float


def static_hold(workcell: Workcell) -> StaticHold:
    """Forces of the payload held level and still; the same record for the same workcell.

    With equal friction coefficients mu the normal forces are m g / (2 mu) each, and the whole
    forces (m g / 2) sqrt(1 + 1 / mu^2).
    """
    return _kept(workcell)


def _static_hold(workcell: Workcell) -> StaticHold:
    function = load_function(workcell)
    outputs = function(pose=np.zeros(6), rate=np.zeros(6), second_rate=np.zeros(6))
    normal = np.array(outputs["normal_force"], dtype=float).reshape(2)
    whole = np.linalg.norm(np.array(outputs["contact_force"], dtype=float).reshape(2, 3), axis=1)
    for force in (normal, whole):
        force.setflags(write=False)
    return StaticHold(normal, whole, payload_limit(workcell, whole))


_kept = kept_per_workcell(_static_hold)


def mass_at_reference(workcell: Workcell, force: Array) -> Array:
    """(2,) payload [kg] at which a force of each robot reaches its reference force.

    Forces along an unchanged motion are proportional to the mass (paper Figure 12).

    Args:
        workcell: the cell.
        force: (2,) peak forces with the workcell's own mass [N].
    """
    mass: Array = workcell.payload.mass * (workcell.task.reference_force / force)
    return mass


def payload_limit(workcell: Workcell, contact_force: Array) -> float:
    """Payload [kg] at which the first robot's whole force reaches its reference force.

    Args:
        workcell: the cell.
        contact_force: (2,) peak magnitudes of the whole forces, with the workcell's own mass [N].
    """
    return float(mass_at_reference(workcell, contact_force).min())
