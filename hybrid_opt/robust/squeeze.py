"""How hard to press, over time: normal forces to command, at least what holds the box, smooth.

With N_1 - N_2 fixed by the motion, the force of one arm decides both: the leading arm keeps its
place and feels what follows, the other is force-controlled (`hybrid_opt.robust`). Force
beyond the plan presses both pads against one another and moves nothing. Of pads without opposite
normals an internal squeeze within all friction cones does.

The plan may assume pads that choose their pressure. What is commanded always holds pads that press
evenly as well (`hybrid_opt.robust.force`), in every case of the cell's set: one number says how
hard to press, and `Squeeze.parts` what it is made of.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d

from hybrid_opt.carry import Carry
from hybrid_opt.robust.force import (
    HeldMotion,
    box_motion,
    robust_model,
    stopped,
)
from symbolic.array import Array
from symbolic.contact.registry import command_model
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty, Workcell

LARGEST_FACTOR = 10.0
SMOOTHING = 0.1
"""Half the width of the time window over which commanded forces are smoothed [s]."""

MOST = 16
"""Samples with the largest demand, for which the share of each doubt is reported."""

STEP = 1e-3
"""Time step of the smoothing [s]."""


@dataclass(frozen=True)
class SqueezeSettings:
    """How hard to press.

    Attributes:
        factor: commanded squeeze over the least that holds; None for what holds in every case of
            the workcell's uncertainty.
        leader: index of the arm that keeps its place.
        smoothing: half the width of the time window of the smoothing [s].
    """

    factor: float | None = None
    leader: int = 0
    smoothing: float = SMOOTHING

    def __post_init__(self) -> None:
        if self.factor is not None and not 1.0 <= self.factor <= LARGEST_FACTOR:
            raise SettingsError(
                f"squeeze {self.factor:g}: allowed is 1 to {LARGEST_FACTOR:g} times the least "
                "squeeze that holds"
            )
        if self.leader not in (0, 1):
            raise SettingsError(f"leader {self.leader}: give 0 or 1, the index of an arm")
        if not 2.0 * STEP <= self.smoothing <= 10.0:
            raise SettingsError(
                f"smoothing over {self.smoothing:g} s: allowed is {2.0 * STEP:g} to 10 s"
            )


@dataclass(frozen=True)
class Part:
    """Rise of the force-controlled arm's largest force by one doubt [N]."""

    name: str
    force: float


def account(parts: Iterable[Part]) -> str:
    """Format parts as a sum."""
    known = list(parts)
    terms = " + ".join(f"{part.force:.1f} {part.name}" for part in known)
    return f"{terms} = {sum(part.force for part in known):.1f} N"


DOUBTS = {
    "friction": ("friction",),
    "mass": ("mass",),
    "centre of mass": ("centre_of_mass",),
    "pads' places": ("pad_position",),
    "tilt of the pads": ("tilt",),
    "arms' relative pose": ("relative_position", "relative_angle"),
    "disturbance": ("disturbance",),
    "arms against one another": ("internal_force",),
    "tracking": ("tracking",),
}
"""Parts of a set in the order in which they add to the force, and whose ranges they are."""


@dataclass(frozen=True)
class Squeeze:
    """How the commanded forces came about.

    Attributes:
        leader: index of the arm that keeps its place; the other is force-controlled.
        factor: commanded squeeze over the least that holds, None where the forces are robust ones.
        uncertainty: the set that the forces hold for, None where a factor was taken.
        smoothing: half the width of the time window of the smoothing [s].
        parts: of the largest force that is commanded, the least that holds first; they add up to
            it.
        holders: what holds the payload, in words.
        order: what the force asks of them, as in 'press with 80 N'.
    """

    leader: int
    factor: float | None
    uncertainty: Uncertainty | None
    smoothing: float
    parts: tuple[Part, ...]
    holders: str
    order: str

    @property
    def force(self) -> float:
        """Largest force that is commanded of the force-controlled arm [N]."""
        return sum(part.force for part in self.parts)

    @property
    def account(self) -> str:
        """The parts as a sum."""
        return account(self.parts)

    def __str__(self) -> str:
        if self.uncertainty is None:
            return f"{self.factor:g} times the least that holds {self.holders}"
        if self.uncertainty.is_empty:
            return f"the least that holds {self.holders}: the cell states that nothing is uncertain"
        return f"holds {self.holders} in every case of {self.uncertainty.title}"


def pressed_beyond(
    workcell: Workcell,
    settings: SqueezeSettings,
    time: Array,
    motion: HeldMotion,
    least: Array,
    in_parts: bool = True,
) -> tuple[Array, Squeeze]:
    """Compute the force (n,) commanded beyond the planned normal force [N], in the proportion of
    `ContactModel.pressed_together` for the other robot, and its origin.

    Smooth where the planned forces are; with it neither robot ever presses less than the plan, or
    than what holds pads that press evenly, moving or stopped, in every case of the set, asks for.

    Args:
        time: (n,) of the samples, not decreasing [s].
        motion: of the box at the samples.
        least: (n, 2) planned normal forces [N].
        in_parts: whether each doubt is asked for its part of robust forces; else there is one.

    Raises:
        SettingsError: the uncertainty leaves no friction or patch.
    """
    leader, contact = settings.leader, command_model(workcell)
    planned, doubt = least[:, 1 - leader], workcell.uncertainty
    if settings.factor is None:
        needed = _in_every_case(workcell, doubt, leader, motion, planned)
        parts = [Part("in every case", float(needed.max()))]
        if in_parts:
            most = np.union1d(np.argsort(-needed)[:MOST], np.argsort(-planned)[:MOST])
            there = box_motion(motion).at(most)
            parts = _by_doubt(workcell, leader, there, planned[most])
    else:
        model = robust_model(workcell)
        least = np.maximum(least, model.nominal(motion, leader))
        still = model.nominal(stopped(motion), leader)[:, 1 - leader]
        held = least[:, 1 - leader]
        own = least.mean(axis=1) if contact.has_scalar_squeeze else held
        needed = np.maximum(held + (settings.factor - 1.0) * own, still)
        parts = [Part("least force", float(held.max()))]
        parts.append(Part("factor", float(needed.max() - held.max())))
    squeeze = Squeeze(
        leader,
        settings.factor,
        doubt if settings.factor is None else None,
        settings.smoothing,
        tuple(parts),
        contact.holders,
        contact.order,
    )
    return smooth_above(time, needed, settings.smoothing) - planned, squeeze


def _by_doubt(workcell: Workcell, leader: int, motion: HeldMotion, planned: Array) -> list[Part]:
    """Compute what each uncertainty of a cell adds to the largest robust force, one after the
    other."""
    doubt, names = workcell.uncertainty, tuple[str, ...]()
    before = float(_in_every_case(workcell, doubt.only(names), leader, motion, planned).max())
    parts = [Part("least force", before)]
    for name, ranges in DOUBTS.items():
        names += ranges
        if not doubt.only(ranges).is_empty:
            force = _in_every_case(workcell, doubt.only(names), leader, motion, planned).max()
            parts.append(Part(name, float(force) - before))
            before = float(force)
    return parts


def _in_every_case(
    workcell: Workcell,
    doubt: Uncertainty,
    leader: int,
    motion: HeldMotion,
    planned: Array | float,
) -> Array:
    """Compute the force (n,) to command so that a set is held, moving or stopped: at least the
    planned one [N]."""
    model = robust_model(workcell)
    held = model.commanded(motion, doubt, leader, planned)
    return model.commanded(stopped(motion), doubt, leader, held)


def largest_commanded(
    workcell: Workcell, motion: HeldMotion, planned: Array, doubt: Uncertainty, leader: int
) -> Array:
    """Compute the largest forces (2,) of `commanded_forces` that hold a motion in every case of a
    set [N], from the few samples that can attain them.

    Args:
        planned: (n, 2) normal forces [N].

    Raises:
        SettingsError: the uncertainty leaves no friction or patch.
    """
    follower, box = 1 - leader, box_motion(motion)
    most = np.argsort(-planned[:, follower])[:MOST]
    there, own = box.at(most), planned[most, follower]
    level = _in_every_case(workcell, doubt, leader, there, own).max()
    forces = np.full(2, _in_every_case(workcell, doubt, leader, box, level).max())
    together = command_model(workcell).pressed_together(leader)[leader]
    forces[leader] = (planned[most, leader] + together * (forces[follower] - own)).max()
    return forces


def commanded_forces(
    workcell: Workcell, carry: Carry, settings: SqueezeSettings, in_parts: bool = True
) -> tuple[Array, Squeeze]:
    """Compute the normal forces (n, 2) to command of both robots along a carry [N], and their
    origin; see `pressed_beyond`."""
    held = carry.normal_force
    extra, squeeze = pressed_beyond(workcell, settings, carry.time, carry, held, in_parts)
    together = command_model(workcell).pressed_together(settings.leader)
    return held + np.multiply.outer(extra, together), squeeze


def smooth_above(time: Array, values: Array, width: float) -> Array:
    """Compute a smooth curve that is nowhere below the given one, level at both ends.

    The largest value within a window, averaged over the same window by a smooth kernel: where the
    kernel reaches, every windowed maximum covers the point in its middle.

    Args:
        time: (n,) not decreasing [s].
        values: (n,) linear between the times.
        width: half the width of the window [s].
    """
    count = max(2, int(np.ceil((time[-1] - time[0]) / STEP)) + 1)
    grid = np.linspace(time[0], time[-1], count)
    step = grid[1] - grid[0]
    reach = int(np.ceil(width / step))
    # Between grid points nothing may be missed: each takes the largest of the steps beside it.
    cell = np.clip(np.searchsorted(grid, time, side="right") - 1, 0, count - 2)
    highest = np.interp(grid, time, values)
    np.maximum.at(highest, cell, values)
    np.maximum.at(highest, cell + 1, values)
    highest = maximum_filter1d(highest, 2 * reach + 1, mode="reflect")
    kernel = (1.0 - np.linspace(-1.0, 1.0, 2 * reach + 1) ** 2) ** 3
    padded = np.pad(highest, reach, mode="symmetric")
    smooth = np.convolve(padded, kernel / kernel.sum(), mode="valid")
    return np.asarray(np.interp(time, grid, smooth))
