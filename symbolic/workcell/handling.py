"""How the box is taken hold of and let go: the record, and the section of a workcell file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from symbolic.workcell.reader import Table


@dataclass(frozen=True)
class Handling:
    """What the robots do before and after the carry.

    Attributes:
        stand_off: distance of both pads from the box before it is gripped and after it is let
            go, along the contact normals [m].
        pressing_speed: fastest of the pads between there and the box [m/s].
        pressing_rate: fastest rise and fall of the normal forces there [N/s].
        lifting_speed: fastest of the box when it is lifted off and set down [m/s].
        lift_height: how far below the carry's start the box stands [m]; None for the height above
            what lies beneath it.
        set_down_height: likewise below the carry's goal.
    """

    stand_off: float = 0.05
    pressing_speed: float = 0.05
    pressing_rate: float = 100.0
    lifting_speed: float = 0.1
    lift_height: float | None = None
    set_down_height: float | None = None


def read_handling(table: Table) -> Handling:
    """How the box is taken hold of and let go, by default as `Handling` says."""
    # Not imported at the top: the records, which hold this one, are free of reading.
    from symbolic.workcell import quantities as quantity

    usual = Handling()

    def height(key: str) -> float | None:
        given = table.raw(key, None) is not None
        return table.number(key, quantity.LIFT) if given else None

    handling = Handling(
        stand_off=table.number("stand_off", quantity.STAND_OFF, usual.stand_off),
        pressing_speed=table.number("pressing_speed", quantity.SPEED, usual.pressing_speed),
        pressing_rate=table.number("pressing_rate", quantity.FORCE_RATE, usual.pressing_rate),
        lifting_speed=table.number("lifting_speed", quantity.SPEED, usual.lifting_speed),
        lift_height=height("lift_height"),
        set_down_height=height("set_down_height"),
    )
    table.close()
    return handling
