"""How hard to press along a recommended carry: what its exported job commands as well."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.robust.squeeze import Squeeze, SqueezeSettings, chosen_squeeze, extra_force
from symbolic.array import Array


@dataclass(frozen=True)
class Commanded:
    """The forces to press with.

    Attributes:
        peak: (2,) largest normal force to command of each robot [N].
        squeeze: how it came about.
    """

    peak: Array
    squeeze: Squeeze

    @property
    def reason(self) -> str:
        """How it came about, in words."""
        return str(self.squeeze)


def commanded(carry: Carry, settings: SqueezeSettings | None = None) -> Commanded:
    """The forces to command along a carry.

    Raises:
        SettingsError: the cell's uncertainty leaves no friction or patch, or its pads do not face
            one another.
    """
    squeeze = chosen_squeeze(carry.workcell, settings or SqueezeSettings())
    extra = extra_force(carry.workcell, squeeze, carry.time, carry, carry.normal_force)
    return Commanded(np.asarray((carry.normal_force + extra[:, None]).max(axis=0)), squeeze)
