"""Effects of the arms' stiffness on the contact forces, if the arms are position controlled or if
one arm starts later than the other.

A position-controlled arm presses by aiming at a point inside the box; its stiffness k [N/m] at the
pad turns the depth of that point into force. Both arms hold the box like springs in series, so a
relative displacement d of the pads changes the squeeze by k d / 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from hybrid_opt.display.table import text_table
from hybrid_opt.errors import JobError
from hybrid_opt.job.records import Job, Phase
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.errors import SettingsError
from symbolic.records.poses import box_rotation

STIFFNESSES = (2e3, 1e4, 5e4, 2e5, 1e6)
"""Stiffnesses that are reported, from a soft Cartesian impedance to a stiff industrial arm
[N/m]."""

POSITION_ERROR = 1e-4
"""Position error of each arm [m]."""

TRACKED = 0.05
"""A force counts as tracked if it misses its reference by at most this share."""

SKEWS = (0.001, 0.002, 0.005, 0.01, 0.02)
"""Delays of one arm that are reported [s]."""

LARGEST_SKEW = 0.1
"""Largest delay of one arm that is considered [s]."""

_BISECTIONS = 16


@dataclass(frozen=True)
class PositionControl:
    """Contact forces of a job if both arms are position controlled with a given stiffness.

    Attributes:
        stiffness: stiffness of each arm at its pad [N/m].
        penetration: (2,) depth inside the box at which each arm has to aim, the largest of the job
            [m].
        force_error: change of the normal force if each arm's position is wrong by `POSITION_ERROR`
            [N].
        share: ratio of `force_error` to the least commanded force while the box is held.
        margin: least excess of the commanded normal force over the force that holds the box [N].
    """

    stiffness: float
    penetration: Array
    force_error: float
    share: float
    margin: float

    @property
    def verdict(self) -> str:
        """Text that states whether position control is feasible."""
        if self.share <= TRACKED:
            return "yes"
        if self.force_error <= self.margin:
            return "holds, but the force misses its reference"
        return "no"


@dataclass(frozen=True)
class Skew:
    """Effect on the contact forces if one arm is late while the box is held, for arms of a given
    stiffness.

    The values are the worst of two cases: either arm may be the late one.

    Attributes:
        delay: time by which one arm is behind the other [s].
        stiffness: stiffness of each arm at its pad, the same in all directions [N/m].
        displacement: largest relative displacement of the pads [m].
        force_change: largest change of a normal force [N].
        share: largest ratio of the change of a normal force to the force commanded at the same
            time.
        margin: least excess of the changed normal force over the force that holds the box [N].
        late: index of the delayed arm in the case with the least margin.
    """

    delay: float
    stiffness: float
    displacement: float
    force_change: float
    share: float
    margin: float
    late: int

    @property
    def is_held(self) -> bool:
        """True if friction still holds the box in every phase."""
        return self.margin >= 0.0


def position_control(job: Job, stiffness: float) -> PositionControl:
    """Compute what position control of both arms would mean for the contact forces of a job, in
    which one arm is planned to be force controlled.

    Args:
        job: the whole job.
        stiffness: stiffness of each arm at its pad [N/m].

    Returns:
        Depth at which the arms have to aim inside the box to exert the commanded forces, and the
        changes of force by position errors.

    Raises:
        SettingsError: the stiffness is not positive.
    """
    require_stiffness(stiffness)
    least = min(float(phase.force.normal.min()) for phase in job.held)
    error = stiffness * POSITION_ERROR
    return PositionControl(
        stiffness, job.peak_normal_force / stiffness, error, error / least, force_margin(job)
    )


def force_margin(job: Job) -> float:
    """Compute the least difference between commanded and planned normal force [N], over both robots
    and all phases in which the box is held. The planned force is the least one that holds the box
    if everything is exactly as described.
    """
    return min(float((p.force.normal - p.force.least).min()) for p in job.held)


def skewed(job: Job, delay: float, stiffness: float) -> Skew:
    """Compute how the contact forces change if one arm is late while the box is held. Either arm is
    taken as the late one, and the worse result is returned.

    The arms act as quasi-static springs. A relative displacement of the pads along the contact
    normal changes the squeeze. A displacement across the normal adds a tangential force that
    friction has to bear.

    Args:
        job: the whole job.
        delay: time by which one arm is behind the other [s].
        stiffness: stiffness of each arm at its pad [N/m].

    Raises:
        SettingsError: the stiffness is not positive, or the delay out of range.
    """
    require_stiffness(stiffness)
    require_delay(delay)
    return _worst(job, delay, stiffness)


def _worst(job: Job, delay: float, stiffness: float) -> Skew:
    found = [_skewed(job, phase, late, delay, stiffness) for phase in job.held for late in (0, 1)]
    worst = min(found, key=lambda each: each.margin)
    return replace(
        worst,
        displacement=max(each.displacement for each in found),
        force_change=max(each.force_change for each in found),
        share=max(each.share for each in found),
    )


def separation(job: Job, delay: float) -> float:
    """Compute the largest relative displacement of the pads [m] if either arm is late while the box
    is held.

    The result also applies to an arm that stops alone: the delay is then the time for which the
    other arm continues at the planned speed.

    Args:
        job: the whole job.
        delay: delay of the late arm [s].
    """
    return max(
        float(np.linalg.norm(_displacement(job, phase, late, delay)[1], axis=1).max())
        for phase in job.held
        for late in (0, 1)
    )


def largest_skew(job: Job, stiffness: float, longest: float = LARGEST_SKEW) -> float:
    """Compute the longest delay of either arm [s] for which friction still holds the box.

    Args:
        job: the whole job.
        stiffness: stiffness of each arm at its pad [N/m].
        longest: largest delay that is tried, and largest result [s].

    Raises:
        SettingsError: the stiffness is not positive.
    """
    require_stiffness(stiffness)
    low, high = 0.0, longest
    if _worst(job, high, stiffness).is_held:
        return high
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2.0
        if _worst(job, middle, stiffness).is_held:
            low = middle
        else:
            high = middle
    return low


def require_skew(job: Job, delay: float, stiffness: float) -> None:
    """Check that friction holds the box of a job if either arm is late.

    Args:
        job: the whole job.
        delay: delay of one arm behind the other [s].
        stiffness: stiffness of each arm at its pad [N/m].

    Raises:
        SettingsError: the stiffness is not positive, or the delay out of range.
        JobError: friction would not hold the box. The message states the missing force and what
            would help.
    """
    found = skewed(job, delay, stiffness)
    if found.is_held:
        return
    raise JobError(
        f"a skew of {1e3 * delay:g} ms brings the pads {1e3 * found.displacement:.1f} mm apart; "
        f"arms of {stiffness:g} N/m then miss {-found.margin:.1f} N to hold the box, with "
        f"{1e3 * largest_skew(job, stiffness):.1f} ms they hold it: press more (squeeze), choose "
        "a slower timing, or give the stiffness and the skew that your arms have",
        code="skew-too-long",
    )


def _displacement(job: Job, phase: Phase, late: int, delay: float) -> tuple[Array, Array, Array]:
    """Compute how far the pad of a late arm lags behind its planned position.

    Args:
        job: the whole job.
        phase: phase of the job in which the box is held, at m samples.
        late: index of the late arm.
        delay: time by which the arm is late [s].

    Returns:
        - Mask (m,) of the n samples at which the displacement is computed: all but those with the
          same time as the sample before.
        - Displacement (n, 3) of the late pad from its planned position, world frame [m].
        - Normal (n, 3) of the late pad, world frame.
    """
    motion, contact = phase.motion, job.workcell.contacts[late]
    keep = np.concatenate([[True], np.diff(motion.time) > 0.0])
    time = motion.time[keep]
    path = CubicHermiteSpline(time, motion.pose[keep], motion.rate[keep])
    now, before = path(time), path(np.clip(time - delay, 0.0, None))
    orientation, point = job.workcell.task.orientation, contact.T_box_pad[:3, 3]
    rotation, earlier = box_rotation(orientation, now), box_rotation(orientation, before)
    moved = before[:, :3] + earlier @ point - now[:, :3] - rotation @ point
    return keep, moved, rotation @ contact.T_box_pad[:3, 2]


def _skewed(job: Job, phase: Phase, late: int, delay: float, stiffness: float) -> Skew:
    keep, moved, normal = _displacement(job, phase, late, delay)
    along = np.einsum("ni,ni->n", moved, normal)
    across = np.linalg.norm(moved - along[:, None] * normal, axis=1)
    model = contact_model(job.workcell)
    change, more = model.pulled_apart(along, across, stiffness)
    commanded, least = model.held_with(phase.force.normal[keep]), phase.force.least[keep]
    needed = least + more[:, None]
    return Skew(
        delay,
        stiffness,
        displacement=float(np.linalg.norm(moved, axis=1).max()),
        force_change=float(np.abs(change).max()),
        share=float((np.abs(change)[:, None] / commanded).max()),
        margin=float((commanded + change[:, None] - needed).min()),
        late=late,
    )


def require_stiffness(stiffness: float) -> None:
    """Check that a stiffness [N/m] is positive.

    Raises:
        SettingsError: the stiffness is not positive.
    """
    if not 0.0 < stiffness < float("inf"):
        raise SettingsError(
            f"stiffness {stiffness:g} N/m: give a finite positive one", code="stiffness"
        )


def require_delay(delay: float) -> None:
    """Check that a delay [s] is in range.

    Raises:
        SettingsError: the delay is out of range.
    """
    if not 0.0 <= delay <= LARGEST_SKEW:
        raise SettingsError(f"skew of {delay:g} s: allowed is 0 to {LARGEST_SKEW:g} s", code="skew")


def position_text(found: Sequence[PositionControl]) -> str:
    """Format a table of contact forces under position control, one row per stiffness."""
    rows = [
        [
            f"{each.stiffness:g}",
            " / ".join(f"{1e3 * value:.2f}" for value in each.penetration),
            f"{each.force_error:.1f}",
            f"{100.0 * each.share:.1f} %",
            each.verdict,
        ]
        for each in found
    ]
    head = ["stiffness [N/m]", "aim into the box [mm]", "0.1 mm each [N]", "of force", "enough"]
    return text_table([head, *rows], left=(4,))


def skew_text(found: Sequence[Skew]) -> str:
    """Format a table of the effects of a late arm on the contact forces, one row per delay."""
    rows = [
        [
            f"{1e3 * each.delay:g}",
            f"{1e3 * each.displacement:.2f}",
            f"{each.force_change:.1f}",
            f"{100.0 * each.share:.0f} %",
            f"{each.margin:.1f}",
            "holds" if each.is_held else "SLIPS",
        ]
        for each in found
    ]
    head = ["late [ms]", "pads apart [mm]", "force [N]", "of force", "left [N]", "the box"]
    return text_table([head, *rows], left=(5,))
