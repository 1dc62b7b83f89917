"""The uncertainty section of a workcell file."""

from __future__ import annotations

from symbolic.workcell import quantities as quantity
from symbolic.workcell.reader import Table
from symbolic.workcell.records import Uncertainty


def read_uncertainty(table: Table) -> Uncertainty:
    """How far from nominal each quantity may be; nothing by default."""
    none = (0.0, 0.0, 0.0)
    uncertainty = Uncertainty(
        friction=table.number("friction", quantity.SHARE, 0.0),
        mass=table.number("mass", quantity.SHARE, 0.0),
        centre_of_mass=table.vector("centre_of_mass", (quantity.DISPLACEMENT,) * 3, none),
        pad_position=table.number("pad_position", quantity.DISPLACEMENT, 0.0),
        disturbance=table.vector("disturbance", (quantity.DISTURBANCE,) * 3, none),
    )
    table.close()
    return uncertainty
