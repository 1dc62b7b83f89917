"""Commanded normal forces over time: smooth, and never below the forces that hold the box.

The motion fixes N_1 - N_2, so the force of one arm decides both. The leading arm is position
controlled, the other arm is force controlled (`hybrid_opt.robust`). Additional force presses both
pads against each other and moves nothing. For pads without opposite normals it is an internal
squeeze within all friction cones.

Planned forces may assume pads that distribute their pressure freely. Commanded forces also suffice
for pads that press evenly (`hybrid_opt.robust.force`), in every case of the workcell's uncertainty.
`Squeeze.parts` lists the contributions to the largest commanded force.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d

from hybrid_opt.carry import Carry, HeldMotion, at_standstill, box_motion
from hybrid_opt.robust.force import RobustModel, robust_model
from symbolic.array import Array
from symbolic.contact.registry import command_model
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty, Workcell

LARGEST_FACTOR = 10.0
SMOOTHING = 0.1
"""Half the width of the time window over which commanded forces are smoothed [s]."""

MOST = 16
"""Number of samples with the largest forces for which contributions are computed."""

STEP = 1e-3
"""Time step of the smoothing [s]."""


@dataclass(frozen=True)
class SqueezeSettings:
    """Settings of the commanded normal forces.

    Attributes:
        factor: ratio of the commanded squeeze to the least squeeze that holds the box; None to
            command the force that holds the box in every case of the workcell's uncertainty.
        leader: index of the position-controlled arm; the other arm is force controlled.
        smoothing: half the width of the time window over which the forces are smoothed [s].
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
class Contribution:
    """Part of the largest commanded force that is due to one source of uncertainty.

    Attributes:
        name: name of the source, such as 'friction', or 'least force' for the force without
            uncertainty.
        force: rise of the largest commanded force by this source [N].
    """

    name: str
    force: float


def breakdown_text(contributions: Iterable[Contribution]) -> str:
    """Format contributions as a sum, such as '70.0 least force + 10.0 friction = 80.0 N'."""
    known = list(contributions)
    terms = " + ".join(f"{each.force:.1f} {each.name}" for each in known)
    return f"{terms} = {sum(each.force for each in known):.1f} N"


UNCERTAINTY_SOURCES = {
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
"""Sources of uncertainty in the order in which they are added, with the names of their ranges."""


@dataclass(frozen=True)
class Squeeze:
    """Record of how the commanded normal forces were computed.

    Attributes:
        leader: index of the position-controlled arm; the other arm is force controlled.
        factor: ratio of the commanded squeeze to the least squeeze that holds the box; None if the
            commanded forces are robust forces.
        uncertainty: ranges within which the forces hold the box in every case; None if `factor` was
            used.
        smoothing: half the width of the time window over which the forces were smoothed [s].
        parts: contributions to the largest commanded force, the least force first. Their sum is the
            largest commanded force.
        holders: word for what holds the payload, such as pads or hands.
        order: verb of the command in texts, such as 'press' in 'press with 80 N'.
    """

    leader: int
    factor: float | None
    uncertainty: Uncertainty | None
    smoothing: float
    parts: tuple[Contribution, ...]
    holders: str
    order: str

    @property
    def force(self) -> float:
        """Largest commanded normal force of the force-controlled arm [N]."""
        return sum(part.force for part in self.parts)

    @property
    def breakdown(self) -> str:
        """The contributions to the force as a sum in text, such as '70.0 least force + 10.0
        friction = 80.0 N'."""
        return breakdown_text(self.parts)

    def __str__(self) -> str:
        if self.uncertainty is None:
            return f"{self.factor:g} times the least that holds {self.holders}"
        if self.uncertainty.is_empty:
            return f"the least that holds {self.holders}: the cell states that nothing is uncertain"
        return f"holds {self.holders} in every case of {self.uncertainty.title}"


def extra_normal_force(
    workcell: Workcell,
    settings: SqueezeSettings,
    time: Array,
    motion: HeldMotion,
    least: Array,
    itemised: bool = True,
) -> tuple[Array, Squeeze]:
    """Compute the force (n,) [N] that the force-controlled arm is to press in addition to its
    planned force.

    By default the commanded force holds the box in every case of the uncertainty, in motion and at
    rest. With `SqueezeSettings.factor` it is a multiple of the force that holds the box without
    uncertainty. In both cases it is smooth over time and never below the planned force. The force
    of the position-controlled arm rises by `ContactModel.internal_force_ratio` times the result.

    Args:
        workcell: the workcell.
        settings: settings of the commanded forces.
        time: (n,) times of the samples, not decreasing [s].
        motion: motion of the box at the samples.
        least: (n, 2) planned normal force of each robot [N].
        itemised: True for one contribution per source of uncertainty; False for a single
            contribution.

    Returns:
        The additional force, and a record of how it was computed.

    Raises:
        SettingsError: the uncertainty leaves no friction or contact patch.
    """
    leader, contact, model = settings.leader, command_model(workcell), robust_model(workcell)
    planned, uncertainty = least[:, 1 - leader], workcell.uncertainty
    if settings.factor is None:
        needed = _in_every_case(model, uncertainty, leader, motion, planned)
        parts = [Contribution("in every case", float(needed.max()))]
        if itemised:
            most = np.union1d(np.argsort(-needed)[:MOST], np.argsort(-planned)[:MOST])
            there = box_motion(motion).at(most)
            parts = _contributions(model, leader, there, planned[most])
    else:
        least = np.maximum(least, model.nominal(motion, leader))
        still = model.nominal(at_standstill(motion), leader)[:, 1 - leader]
        held = least[:, 1 - leader]
        own = least.mean(axis=1) if contact.has_scalar_squeeze else held
        needed = np.maximum(held + (settings.factor - 1.0) * own, still)
        parts = [Contribution("least force", float(held.max()))]
        parts.append(Contribution("factor", float(needed.max() - held.max())))
    squeeze = Squeeze(
        leader,
        settings.factor,
        uncertainty if settings.factor is None else None,
        settings.smoothing,
        tuple(parts),
        contact.holders,
        contact.order,
    )
    return smooth_above(time, needed, settings.smoothing) - planned, squeeze


def _contributions(
    model: RobustModel, leader: int, motion: HeldMotion, planned: Array
) -> list[Contribution]:
    """Divide the largest commanded force over a motion into the part that is needed without
    uncertainty and one part per source of uncertainty.

    The sources are added one after the other; the part of a source is the rise of the force when it
    is added.

    Args:
        model: computes robust normal forces, which hold the box in every case of the uncertainty.
        leader: index of the position-controlled arm.
        motion: motion of the box at n samples.
        planned: (n,) planned normal force of the force-controlled arm [N].
    """
    uncertainty, names = model.workcell.uncertainty, tuple[str, ...]()
    before = float(
        _in_every_case(model, uncertainty.restrict_to(names), leader, motion, planned).max()
    )
    parts = [Contribution("least force", before)]
    for name, ranges in UNCERTAINTY_SOURCES.items():
        names += ranges
        if not uncertainty.restrict_to(ranges).is_empty:
            force = _in_every_case(
                model, uncertainty.restrict_to(names), leader, motion, planned
            ).max()
            parts.append(Contribution(name, float(force) - before))
            before = float(force)
    return parts


def _in_every_case(
    model: RobustModel,
    uncertainty: Uncertainty,
    leader: int,
    motion: HeldMotion,
    planned: Array | float,
) -> Array:
    """Compute the least force (n,) [N] with which the force-controlled arm holds the box in every
    case of an uncertainty, both in motion and at a standstill in each of n poses.

    Args:
        model: computes robust normal forces, which hold the box in every case of the uncertainty.
        uncertainty: ranges of the uncertain quantities.
        leader: index of the position-controlled arm.
        motion: motion of the box at n samples.
        planned: lower bound of the result, (n,) or one for all samples [N].
    """
    held = model.commanded(motion, uncertainty, leader, planned)
    return model.commanded(at_standstill(motion), uncertainty, leader, held)


def largest_commanded(
    workcell: Workcell, motion: HeldMotion, planned: Array, uncertainty: Uncertainty, leader: int
) -> Array:
    """Compute the largest normal force (2,) [N] of each robot along a motion, if the
    force-controlled robot presses hard enough for every case of an uncertainty.

    Only the few samples where the largest forces can lie are computed.

    Args:
        workcell: the workcell.
        motion: motion of the box at n samples.
        planned: (n, 2) planned normal force of each robot [N].
        uncertainty: ranges of the uncertain quantities.
        leader: index of the position-controlled arm.

    Raises:
        SettingsError: the uncertainty leaves no friction or contact patch.
    """
    follower, box = 1 - leader, box_motion(motion)
    most = np.argsort(-planned[:, follower])[:MOST]
    there, own, model = box.at(most), planned[most, follower], robust_model(workcell)
    level = _in_every_case(model, uncertainty, leader, there, own).max()
    forces = np.full(2, _in_every_case(model, uncertainty, leader, box, level).max())
    raised = command_model(workcell).raised(planned[most], forces[follower] - own, leader)
    forces[leader] = raised[:, leader].max()
    return forces


def commanded_forces(
    workcell: Workcell, carry: Carry, settings: SqueezeSettings, itemised: bool = True
) -> tuple[Array, Squeeze]:
    """Compute the normal forces (n, 2) [N] that both robots exert along a carry under a commanded
    squeeze.

    The force of the force-controlled arm is the planned force plus `extra_normal_force`. The force
    of the position-controlled arm follows by `ContactModel.raised`.

    Args:
        workcell: the workcell.
        carry: the carry at n samples.
        settings: settings of the commanded forces.
        itemised: True for one contribution per source of uncertainty; False for a single
            contribution.

    Returns:
        The forces, and a record of how they were computed.
    """
    held = carry.normal_force
    extra, squeeze = extra_normal_force(workcell, settings, carry.time, carry, held, itemised)
    return command_model(workcell).raised(held, extra, settings.leader), squeeze


def smooth_above(time: Array, values: Array, width: float) -> Array:
    """Compute a smooth curve that is nowhere below a given curve and has zero slope at both ends.

    At each time the maximum of the curve within a window is taken, and these maxima are averaged
    over the same window with a smooth kernel. Each averaged maximum belongs to a window that
    contains the time in question, so the average is not below the curve there.

    Args:
        time: (n,) times, not decreasing [s].
        values: (n,) values of the curve, which is linear between the times.
        width: half the width of the window [s].

    Returns:
        Values (n,) of the smooth curve, in the unit of `values`.
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
