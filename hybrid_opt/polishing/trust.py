"""The box of trust: how far a program is believed around the best candidate so far.

A trust region in the sense of Conn, Gould and Toint (2000), with the box in place of the ball so
that it is nothing but bounds, and with what a step taught in place of the ratio of its gains: a
step that violated something new is repeated with that in the program, at the same radius.
"""

from __future__ import annotations

from hybrid_opt.polishing.settings import TrustSettings


class TrustRegion:
    """Half the width of the box, in halves of the decision variables' ranges, and its policy.

    Attributes:
        radius: half the width.
    """

    def __init__(self, settings: TrustSettings, radius: float) -> None:
        self._settings, self.radius, self._was_good = settings, radius, False

    @property
    def is_spent(self) -> bool:
        """Whether it has become too small to go on."""
        return self.radius < self._settings.least

    def holds(self, step: float) -> bool:
        """Whether the box stopped a step of this length."""
        return step >= self._settings.inside * self.radius

    def lost(self) -> None:
        """The program had no answer."""
        self.radius *= self._settings.quartered

    def barren(self, step: float) -> None:
        """A step of this length violated nothing and brought nothing."""
        self.radius = min(self.radius, step) * self._settings.quartered

    def refused(self, learned: bool) -> None:
        """A step violated something; where that was asked for already, the box was too large."""
        self._was_good = False
        if not learned:
            self.radius *= self._settings.halved

    def taken(self, step: float) -> None:
        """A step of this length was good."""
        if self._was_good and self.holds(step):
            self.radius = min(self._settings.doubled * self.radius, self._settings.largest)
        self._was_good = True
