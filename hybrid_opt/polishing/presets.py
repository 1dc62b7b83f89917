"""The settings that studies use where nothing else is asked for."""

from __future__ import annotations

from hybrid_opt.polishing.settings import DrivableSettings, FillSettings, PolishSettings

DRIVABLE_ATTEMPTS = 10
"""At a drivable front. With seven, replicas of the rack differ by 1.1 % at 55 N, with ten by 0.4 %
(docs/measured/drivable-rack.md)."""


def usual_settings(time_law: str) -> PolishSettings:
    """The settings where nothing else is asked for."""
    return PolishSettings(attempts=DRIVABLE_ATTEMPTS) if time_law == "optimal" else PolishSettings()


def quick_settings() -> PolishSettings:
    """Settings of a small study: a third as many points from fewer attempts, and a shorter
    tournament, after which one replica of eight stayed in a slower basin."""
    return PolishSettings(
        attempts=2,
        fill=FillSettings(solved=16, members=16),
        drivable=DrivableSettings(turn=1, members=10),
    )
