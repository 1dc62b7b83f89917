"""What stiffness makes of forces: arms that track positions, and arms that do not start together.

An arm that tracks positions presses by aiming into the box; its stiffness k at the pad turns the
penetration into force. Both arms hold the box in series, so that a relative displacement d of the
pads changes the squeeze by k d / 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from hybrid_opt.job.records import Job, Phase
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.physics.pose import rotation_from_rpy

STIFFNESSES = (2e3, 1e4, 5e4, 2e5, 1e6)
"""From a soft Cartesian impedance to a stiff industrial arm [N/m]."""

POSITION_ERROR = 1e-4
"""Of each arm [m]."""

TRACKED = 0.05
"""Share of the force by which it may miss its reference and count as tracked."""

SKEWS = (0.001, 0.002, 0.005, 0.01, 0.02)
"""Delays of the second arm [s]."""

HELD = ("lift", "carry", "set_down")
"""Phases in which the box is held and moves."""


@dataclass(frozen=True)
class PositionControl:
    """What position control makes of the forces at one stiffness.

    Attributes:
        stiffness: of each arm at its pad [N/m].
        penetration: (2,) largest that each arm has to aim into the box [m].
        force_error: change of force by `POSITION_ERROR` of both arms [N].
        share: of the least commanded force while the box is held.
        margin: least force beyond what holds the box while it is held [N].
    """

    stiffness: float
    penetration: Array
    force_error: float
    share: float
    margin: float

    @property
    def verdict(self) -> str:
        """Whether position control can do it, in words."""
        if self.share <= TRACKED:
            return "yes"
        if self.force_error <= self.margin:
            return "holds, but the force misses its reference"
        return "no"


@dataclass(frozen=True)
class Skew:
    """What a delay of the second arm does while the box is held, at one stiffness.

    Attributes:
        delay: [s].
        stiffness: of each arm at its pad, in all directions [N/m].
        displacement: largest relative displacement of the pads [m].
        force_change: largest change of the normal forces [N].
        margin: least normal force beyond what then holds the box [N].
    """

    delay: float
    stiffness: float
    displacement: float
    force_change: float
    margin: float

    @property
    def survived(self) -> bool:
        """Whether friction still holds the box everywhere."""
        return self.margin >= 0.0


def position_control(job: Job, stiffness: float) -> PositionControl:
    """What arms of a stiffness [N/m] that track positions make of a job's forces.

    Raises:
        SettingsError: the stiffness is not positive.
    """
    _require(stiffness)
    held = [phase for phase in job.phases if phase.name in HELD]
    least = min(float(phase.force.normal.min()) for phase in held)
    error = stiffness * POSITION_ERROR
    return PositionControl(
        stiffness, job.peak_normal_force / stiffness, error, error / least, force_margin(job)
    )


def force_margin(job: Job) -> float:
    """Least commanded beyond least necessary normal force while the box is held [N]."""
    held = [phase.force for phase in job.phases if phase.name in HELD]
    return min(float((force.normal - force.least).min()) for force in held)


def skewed(job: Job, delay: float, stiffness: float) -> Skew:
    """What happens while the box is held if the second arm is late.

    Pads and box as springs, quasi-static: the pads' relative displacement along the normal changes
    the squeeze, the one across it has to be borne by friction as well.

    Args:
        delay: [s].
        stiffness: of each arm at its pad [N/m].

    Raises:
        SettingsError: the stiffness is not positive.
    """
    _require(stiffness)
    found = [_skewed(job, phase, delay, stiffness) for phase in job.phases if phase.name in HELD]
    displacement, change, margin = zip(*found, strict=True)
    return Skew(delay, stiffness, max(displacement), max(change), min(margin))


def _skewed(job: Job, phase: Phase, delay: float, stiffness: float) -> tuple[float, float, float]:
    motion, contacts = phase.motion, job.workcell.contacts
    keep = np.concatenate([[True], np.diff(motion.time) > 0.0])
    time = motion.time[keep]
    path = CubicHermiteSpline(time, motion.pose[keep], motion.rate[keep])
    point = contacts[1].T_box_pad[:3, 3]
    now = path(time)
    late = path(np.clip(time - delay, 0.0, None))
    rotation = _rotations(now)
    moved = late[:, :3] + _rotations(late) @ point - now[:, :3] - rotation @ point
    normal = rotation @ contacts[1].T_box_pad[:3, 2]
    along = np.einsum("ni,ni->n", moved, normal)
    across = np.linalg.norm(moved - along[:, None] * normal, axis=1)
    change = stiffness / 2.0 * along
    friction = min(contact.friction for contact in contacts)
    needed = phase.force.least[keep] + (stiffness / 2.0 * across / friction)[:, None]
    margin = phase.force.normal[keep] + change[:, None] - needed
    displacement = float(np.linalg.norm(moved, axis=1).max())
    return displacement, float(np.abs(change).max()), float(margin.min())


def _rotations(poses: Array) -> Array:
    return np.array([rotation_from_rpy(pose[3:]) for pose in poses])


def _require(stiffness: float) -> None:
    if not 0.0 < stiffness < float("inf"):
        raise SettingsError(f"stiffness {stiffness:g} N/m: give a finite positive one")
