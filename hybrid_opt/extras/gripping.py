"""Choice of the positions of two pads on their faces, by the cost of the hand-made path.

The positions are parameters of the cell, so that a trial costs as much as a changed cell and needs
no compiler. Both pads move alike, so that they stay opposite each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import direct

from hybrid_opt.cell import Cell
from hybrid_opt.progress import Advance, ShowProgress, progress_bar
from hybrid_opt.recommending.choice import DrivenPaths, Goal, Wish, best_of_paths, ranked
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.errors import DualArmError, SettingsError
from symbolic.records import Workcell
from symbolic.records.poses import box_rotation

TRIALS = 40
"""Default number of positions that are tried; equal positions count each time."""

UPRIGHT_FACE = 0.9
"""Least length of the projection of the world's z axis onto a face that counts as upright."""

WORST = 1e9
"""Cost of positions with which the path cannot be driven [N s]."""

Range = tuple[float, float]
"""Lower and upper bound [m]."""


@dataclass(frozen=True)
class Grip:
    """Positions of both pads on their faces of the box, and the effort of the hand-made path with
    them.

    Attributes:
        cell: the cell with the pads at these positions, and nothing else changed.
        up, along: shift of the pads from their positions in the file, upwards and level along
            their faces [m].
        duration: duration of the hand-made path [s] at the least product of duration and commanded
            force, limits on jerk ignored.
        force: largest commanded force at this duration [N].
        before: least product of duration and commanded force with the pads at their positions
            in the file [N s]; infinite if the path could not be driven.
    """

    cell: Cell
    up: float
    along: float
    duration: float
    force: float
    before: float

    def __str__(self) -> str:
        moved = f"pads {1e3 * self.up:+.0f} mm up and {1e3 * self.along:+.0f} mm along their faces"
        was = f", in place of {self.before:.0f} N s" if np.isfinite(self.before) else ""
        return (
            f"{moved}: {self.duration:.3f} s at {self.force:.1f} N, "
            f"{self.duration * self.force:.0f} N s{was}"
        )


def propose_grip(
    cell: Cell, up: Range, along: Range, trials: int = TRIALS, *, progress: ShowProgress = False
) -> Grip:
    """Find the positions of both pads on their faces at which the cell's hand-made path has the
    least product of duration and commanded force. The path with these positions is proven free of
    collisions.

    Args:
        cell: cell with pads on upright faces, and forces in closed form.
        up: range of the shift of the pads upwards [m].
        along: range of the level shift along the faces [m]; positive is to the left of the first
            robot's pad, seen from the robot.
        trials: number of pairs of positions to try.
        progress: True for a progress bar, or a function that is called with the number of trials
            done and their total.

    Raises:
        SettingsError: a range is reversed or begins below -1 m, the forces have no closed form, a
            face is not upright, or the path cannot be driven with any positions in the ranges.
    """
    for low, high in (up, along):
        if not -1.0 <= low <= high <= 1.0:
            raise SettingsError(
                f"a range from {low:g} to {high:g} m: allowed is -1 <= low <= high", code="range"
            )
    drivable = cell.drivable()
    if not all(contact_model(each.workcell).has_closed_form for each in (cell, drivable)):
        raise SettingsError(
            "places of pads are compared where their forces have a closed form: two pads with "
            "opposite normals",
            code="no-closed-form",
        )
    ways, tried = _ways(cell.workcell), dict[tuple[float, float], tuple[float, float, float]]()
    bounds = np.array([up, along])
    open_, middle = bounds[:, 1] > bounds[:, 0], bounds.mean(axis=1)

    def cost(values: Array, advance: Advance) -> float:
        place = middle.copy()
        place[open_] = values
        at = float(np.round(place[0], 4)), float(np.round(place[1], 4))
        if at not in tried:
            tried[at] = _cost(drivable, _changes(cell.workcell, ways, at))
        advance(1)
        return min(tried[at][0], WORST)

    tried[0.0, 0.0] = before = _cost(drivable, {})
    with progress_bar(progress, "places of the pads", trials if open_.any() else 1) as advance:
        if open_.any():
            direct(cost, bounds[open_].tolist(), args=(advance,), maxfun=trials, eps=1e-2)
        else:
            cost(middle[open_], advance)
    inside = [
        at
        for at in sorted(tried, key=lambda each: tried[each][0])
        if np.isfinite(tried[at][0]) and (bounds[:, 0] <= at).all() and (at <= bounds[:, 1]).all()
    ]
    for at in inside:
        found = cell.changed(changes) if (changes := _changes(cell.workcell, ways, at)) else cell
        x = found.initial
        if found.evaluator.certified(found.evaluate(x)).feasible.all():
            return Grip(found, *at, *tried[at][1:], before[0])
    raise SettingsError(
        "no place of the pads within the ranges lets the hand-made path be driven", code="no-place"
    )


def _ways(workcell: Workcell) -> Array:
    """Compute two unit vectors along the pads' faces in the box frame, (2, 3): the first points
    upwards at the start, the second is level.

    Args:
        workcell: the cell.

    Raises:
        SettingsError: the faces are not upright.
    """
    turn = box_rotation(workcell.task.orientation, workcell.task.waypoints[0].lower)
    normal, upwards = workcell.contacts[0].T_box_pad[:3, 2], turn.T @ [0.0, 0.0, 1.0]
    upwards = upwards - (upwards @ normal) * normal
    if np.linalg.norm(upwards) < UPRIGHT_FACE:
        raise SettingsError("places of pads are proposed on upright faces; these are not")
    upwards /= np.linalg.norm(upwards)
    return np.array([upwards, np.cross(upwards, normal)])


def _changes(workcell: Workcell, ways: Array, at: tuple[float, float]) -> dict[str, Any]:
    """Return the changes of the workcell file that shift all pads along their faces: new values by
    key path, as for `Cell.changed`.

    Args:
        workcell: the cell.
        ways: (2, 3) unit vectors of the upward and the level direction, box frame.
        at: shift along each of these vectors [m].
    """
    if at == (0.0, 0.0):
        return {}
    pads = {
        f"contacts[{k}]{further}": pad
        for k, contact in enumerate(workcell.contacts)
        for further, pad in [
            ("", contact),
            *((f".further[{j}]", other) for j, other in enumerate(contact.further)),
        ]
    }
    shift = np.asarray(at) @ ways
    return {
        f"{key}.xyz": np.round(pad.T_box_pad[:3, 3] + shift, 6).tolist()
        for key, pad in pads.items()
    }


def _cost(drivable: Cell, changes: dict[str, Any]) -> tuple[float, float, float]:
    """Compute the least product of duration and commanded force of the hand-made path in a changed
    cell.

    Args:
        drivable: the cell.
        changes: changes of the cell by key path, as for `Cell.changed`.

    Returns:
        The product [N s], the duration [s] and the force [N]; all infinite if the path cannot be
        driven.
    """
    none = np.inf, np.inf, np.inf
    try:
        cell = drivable.changed(changes) if changes else drivable
        if not cell.evaluate(cell.initial).feasible[0]:
            return none
    except DualArmError:
        return none
    paths = DrivenPaths(cell, cell.initial[None, :-1])
    options = paths.all_options(cell.workcell.task.force_limit[1])
    goal = Goal(np.inf, np.full(2, np.inf), Goal.of(Wish(), cell.workcell).cost)
    if not ranked(options, goal):
        return none
    best = next(best_of_paths(paths, options, goal, 1))
    return best.duration * best.commanded, best.duration, best.commanded
