"""A user's wish for the carry to run."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from symbolic.errors import SettingsError

_UNITS = {"duration": "s", "force": "N", "payload": "kg"}


@dataclass(frozen=True)
class Wish:
    """At most one of three wishes; without any, the knee of the front is meant.

    Attributes:
        duration: the carry may take so long; asked for is the least force [s].
        force: neither robot may press harder; asked for is the shortest duration [N].
        payload: both robots have to bear so heavy a box within their reference forces on the same
            motion; asked for is the shortest duration [kg].
    """

    duration: float | None = None
    force: float | None = None
    payload: float | None = None

    def __post_init__(self) -> None:
        """Refuse more than one wish, and what is no positive number.

        Raises:
            SettingsError: with what was found.
        """
        given = self.given
        if len(given) > 1:
            raise SettingsError(f"{' and '.join(given)} are wished for; give at most one of them")
        for name, value in given.items():
            if not 0.0 < value < math.inf:
                raise SettingsError(
                    f"{name} {value:g} {_UNITS[name]}: allowed are positive finite numbers"
                )

    @property
    def given(self) -> dict[str, float]:
        """The wishes by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def __str__(self) -> str:
        for name, value in self.given.items():
            return {
                "duration": f"the least force of all carries of at most {value:g} s",
                "force": f"the shortest of all carries that press with at most {value:g} N",
                "payload": f"the shortest of all carries that would bear {value:g} kg",
            }[name]
        return "the knee of the front: one per cent less time costs more than a per cent of force"
