"""The carry that a wish names among the paths of a drivable front."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hybrid_opt.indicators.knee import knee
from hybrid_opt.recommending.driven_paths import DrivenPaths
from hybrid_opt.recommending.wish import Wish
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell


@dataclass(frozen=True)
class Choice:
    """A path and the force it is driven with.

    Attributes:
        index: of the path.
        force: limit on both normal forces [N].
    """

    index: int
    force: float


def force_for_payload(workcell: Workcell, payload: float) -> float:
    """Normal force limit [N] within which both robots would bear a payload [kg] on the same motion.

    Forces grow in proportion to the mass, and the friction cone bounds the whole force of a contact
    by sqrt(1 + mu^2) times its normal force, so the whole force of neither robot can exceed its
    reference force.
    """
    friction = np.array([contact.friction for contact in workcell.contacts])
    normal = workcell.task.reference_force / np.sqrt(1.0 + friction**2)
    return float(normal.min()) * workcell.payload.mass / payload


def choices(workcell: Workcell, paths: DrivenPaths, points: Array, wish: Wish) -> Iterator[Choice]:
    """Answers to a wish, best first.

    Args:
        workcell: the cell.
        paths: of the front's members.
        points: (k, 2) duration [s] and largest limited force [N] of the members themselves.
        wish: what is asked for.

    Raises:
        SettingsError: no member can do it; the message says what is possible.
    """
    if wish.duration is not None:
        yield from _by_duration(paths, wish.duration)
    elif wish.force is not None or wish.payload is not None:
        yield from _by_force(workcell, paths, wish)
    else:
        # At the knee's force another path may be faster than the one that was a member there.
        force = float(points[knee(points), 1])
        yield from _by_force(workcell, paths, Wish(force=force))


def _by_duration(paths: DrivenPaths, duration: float) -> Iterator[Choice]:
    forces = paths.forces(duration)
    if not np.isfinite(forces).any():
        shortest = float(paths.durations(paths.highest_force).min())
        raise SettingsError(
            f"duration {duration:g} s: no carry of the front is so short; the shortest takes "
            f"{shortest:.3f} s"
        )
    for row in np.argsort(forces, kind="stable")[: int(np.isfinite(forces).sum())].tolist():
        yield Choice(row, float(forces[row]))


def _by_force(workcell: Workcell, paths: DrivenPaths, wish: Wish) -> Iterator[Choice]:
    if wish.payload is not None:
        force = force_for_payload(workcell, wish.payload)
        asked = f"payload {wish.payload:g} kg, so {force:.2f} N at {workcell.payload.mass:g} kg"
    else:
        assert wish.force is not None, "one of both is wished for"
        force, asked = wish.force, f"force {wish.force:g} N"
    force = min(force, paths.highest_force)
    durations = paths.durations(force)
    if not np.isfinite(durations).any():
        still = min(timing.limited_force for timing in paths.timings(1e-6))
        raise SettingsError(
            f"{asked}: no carry of the front moves with so little; holding still takes {still:.2f} "
            "N already"
        )
    for row in np.argsort(durations, kind="stable")[: int(np.isfinite(durations).sum())].tolist():
        yield Choice(row, force)
