"""Normal forces of the joint allocation in the smooth problem: from a sample's load, smoothly."""

from __future__ import annotations

import casadi as ca
import numpy as np

from symbolic.contact.grasp import Grasp
from symbolic.contact.soft_grasp import SoftGrasp
from symbolic.records import Workcell
from symbolic.smooth.keys import HeldKey

WEIGHT = 1e-4
"""Of the barriers, see `symbolic.contact.soft_grasp`. Forces exceed the least ones by about as
much, relatively, times the number of constraints that bind, which the polish corrects at every
round's candidate."""


def held_functions(workcell: Workcell) -> dict[HeldKey, ca.Function]:
    """See `symbolic.contact.soft_grasp.SoftGrasp.first` and `second`.

    Raises:
        SettingsError: the pads do not close their grasp.
    """
    friction = np.array([contact.friction for contact in workcell.contacts])
    soft = SoftGrasp(Grasp(workcell), friction, WEIGHT)
    return {HeldKey("first"): soft.first(), HeldKey("second"): soft.second()}
