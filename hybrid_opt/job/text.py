"""A job in words: its phases, how hard it presses, what position control makes of it."""

from __future__ import annotations

from collections.abc import Sequence

from hybrid_opt.display.table import text_table
from hybrid_opt.job.compliance import PositionControl, Skew
from hybrid_opt.job.records import Job

_PHASE_HEAD = ["phase", "begins [s]", "takes [s]", "presses [N]", "most used"]


def job_text(job: Job) -> str:
    """The phases with their times and most used limits, and the forces."""
    rows = [
        [
            phase.name.replace("_", " "),
            f"{phase.begin:.3f}",
            f"{phase.duration:.3f}",
            f"{phase.force.normal.max():.1f}",
            f"{100.0 * phase.use[phase.most_used]:.1f} % {phase.most_used}",
        ]
        for phase in job.phases
    ]
    stands = [" and ".join(names) or "nothing" for names in job.stands_on]
    return "\n".join(
        [
            f"Job, {job.duration:.3f} s; the box stands on {stands[0]}, then on {stands[1]}",
            text_table([_PHASE_HEAD, *rows], left=(0, 4)),
            f"commanded: {job.squeeze}; robot "
            f"{job.workcell.robots[1 - job.squeeze.leader].name!r} is force-controlled",
        ]
    )


def position_text(found: Sequence[PositionControl]) -> str:
    """Forces under position control, by stiffness."""
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
    """Effect of a late arm, by delay: the worse of both."""
    rows = [
        [
            f"{1e3 * each.delay:g}",
            f"{1e3 * each.displacement:.2f}",
            f"{each.force_change:.1f}",
            f"{100.0 * each.share:.0f} %",
            f"{each.margin:.1f}",
            "holds" if each.survived else "SLIPS",
        ]
        for each in found
    ]
    head = ["late [ms]", "pads apart [mm]", "force [N]", "of force", "left [N]", "the box"]
    return text_table([head, *rows], left=(5,))
