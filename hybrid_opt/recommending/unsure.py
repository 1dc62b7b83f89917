"""Forces to press with if friction, mass or centre of mass are less sure than stated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.robust.force import RobustModel, robust_model
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty, Workcell

LEADER = 0
"""The arm that keeps its place; the other's force is commanded."""


@dataclass(frozen=True)
class Unsure:
    """One doubt, and the forces that hold all the same.

    Attributes:
        doubt: what may be off, and by how much.
        peak_force: (2,) largest normal force of each robot along the carry [N].
        within_reference: whether both stay within their reference forces.
    """

    doubt: str
    peak_force: Array
    within_reference: bool


def usual_doubts(workcell: Workcell) -> dict[str, Uncertainty]:
    """Doubts by what they are called; the cell's own set comes first where it has one."""
    doubts = {
        "friction 10 % off": Uncertainty(friction=0.1),
        "friction 20 % off": Uncertainty(friction=0.2),
        "mass 5 % off": Uncertainty(mass=0.05),
        "centre of mass 10 mm off": Uncertainty(centre_of_mass=np.full(3, 0.01)),
    }
    own = workcell.uncertainty
    return ({} if own.is_empty else {"all that [uncertainty] states": own}) | doubts


def unsure_forces(carry: Carry, model: RobustModel | None = None) -> tuple[Unsure, ...]:
    """The forces that hold a carry under each of the usual doubts.

    A doubt that leaves no friction or no patch is left out; so are all where the pads cannot hold
    whatever happens.
    """
    workcell = carry.workcell
    try:
        model = model or robust_model(workcell)
    except SettingsError:
        return ()
    found = []
    for doubt, uncertainty in usual_doubts(workcell).items():
        try:
            peak = model.robust_force(carry, uncertainty, LEADER).peak
        except SettingsError:
            continue
        fits = bool((peak <= workcell.task.reference_force).all())
        found.append(Unsure(doubt, peak, fits))
    return tuple(found)
