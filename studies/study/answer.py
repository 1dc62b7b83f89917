"""Texts of a study's result: the carry to run, the same in every program.

The terminal prints them, the page shows them first, `studies.replay` and `studies.export` repeat
the carry's line. Forces are commanded ones unless they are called planned.
"""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from hybrid_opt.job.records import Job
from hybrid_opt.recommending.recommendation import Alternative
from hybrid_opt.robust.cases import LEADER
from hybrid_opt.robust.price import RobustPrice
from hybrid_opt.robust.squeeze import breakdown_text
from studies.study.recommendation import StoredRecommendation

State = Literal["good", "doubtful", "bad"]
"""Verdict on a carry: 'good' if it holds in every case of the uncertainty without a warning,
'doubtful' if it holds but warnings are left, 'bad' if it exceeds the reference forces, slips in a
random case, or no job can be planned."""

ADVICE, NOTICED = 3, 0.05
"""Most changes of the cell that an answer lists, and the least effect on the force that a listed
change must have [N]."""


@dataclass(frozen=True)
class Fact:
    """One line of an answer: a heading and a text.

    Attributes:
        heading: the subject of the line, as 'time' or 'file'.
        text: one phrase.
        is_command: True if the text is a command to copy into a shell.
        note: remark that the page shows in smaller letters, '' for none.
    """

    heading: str
    text: str
    is_command: bool = False
    note: str = ""

    @property
    def sentence(self) -> str:
        """The text and, if there is one, the note after a comma."""
        return f"{self.text}, {self.note}" if self.note else self.text


@dataclass(frozen=True)
class StudyAnswer:
    """The result of a study in words, which the terminal prints and the page shows first.

    Attributes:
        state: the verdict on the recommended carry.
        headline: the recommended carry in one line, or a statement that there is none.
        facts: lines that the page shows first: time, force, job, and whether the forces hold.
        commands: path of the trajectory file, and the command to run next.
        details: all other lines, the most important first.
        warnings: objections against the carry.
    """

    state: State
    headline: str
    facts: tuple[Fact, ...] = ()
    commands: tuple[Fact, ...] = ()
    details: tuple[Fact, ...] = ()
    warnings: tuple[str, ...] = ()

    def terminal(self) -> str:
        """Return the answer as lines of text for a terminal, warnings last."""
        shown = (*self.facts, *self.commands, *self.details)
        width = max(len(fact.heading) for fact in shown)
        lines = [self.headline]
        lines += [f"  {fact.heading:<{width}}  {fact.sentence}" for fact in shown]
        return "\n".join(lines + [f"  WARNING: {text}" for text in self.warnings])


def carry_text(duration: float, force: float, job_duration: float, order: str) -> str:
    """Return a carry in one line of text.

    Args:
        duration: duration of the carry [s].
        force: largest commanded normal force of the force-controlled arm [N].
        job_duration: duration of the whole job [s]; NaN if there is no job, to leave it out.
        order: words before the force, such as 'press with'.
    """
    job = f", the whole job {seconds(job_duration)}" if math.isfinite(job_duration) else ""
    return f"{seconds(duration)}, {order} {newtons(force)}{job}"


def job_text(job: Job) -> str:
    """Return durations and commanded force of a planned job in one line of text."""
    carried, squeeze = job.phase("carry").duration, job.squeeze
    return carry_text(carried, squeeze.force, job.duration, squeeze.order)


def seconds(duration: float) -> str:
    """Return a duration [s] as text with two decimals and the unit."""
    return f"{duration:.2f} s"


def newtons(force: float) -> str:
    """Return a force [N] as text with one decimal and the unit."""
    return f"{force:.1f} N"


def answer(found: StoredRecommendation, folder: str) -> StudyAnswer:
    """Describe a stored recommendation in words, as the answer of a study.

    Args:
        found: the stored recommendation.
        folder: path of the results, put in front of the files' names; '' if it is the working
            folder.
    """
    carry = carry_text(found.duration, found.force, found.job_duration, found.order)
    headline, file = f"Run this carry: {carry}", Path(folder) / found.file
    details = [
        Fact("why", f"{found.why}; of {found.considered} drivable carries, from {found.source}")
    ]
    if not found.fits:
        headline = f"No carry fits: {found.at_rest}"
        details = [
            Fact("what would do", ", or ".join(map(str, found.remedies))),
            Fact(f"if you allow {newtons(found.required)}", carry),
            *details,
        ]
    details += [
        Fact("the force", f"{breakdown_text(found.parts)}; {found.squeeze_reason}"),
        *[Fact(rival.label, _rival(rival, found)) for rival in found.rivals],
    ]
    if found.reserve is not None and math.isfinite(found.reserve.payload):
        details.append(Fact("reserve", f"{found.reserve}, {_WITHIN}"))
    if found.at_rest and found.fits:
        details.append(Fact("grip", found.at_rest))
    told = [str(each) for each in found.advice if abs(each.force) >= NOTICED][:ADVICE]
    if told:
        details.append(Fact("on this path", "; ".join(told)))
    if found.price is not None:
        details.append(Fact("checked", _checked(found.price)))
    commands = [Fact("file", str(file))]
    if found.has_job:
        commands.append(Fact("next", export_command(file, found.target), is_command=True))
    details.append(Fact("with this force", f"{'; '.join(_margins(found)) or 'not known'}"))
    return StudyAnswer(
        state_of(found),
        headline,
        _facts(found),
        tuple(commands),
        tuple(details),
        found.warnings,
    )


_WITHIN = "each alone, in every case within the reference force on this path"


def state_of(found: StoredRecommendation) -> State:
    """Return the verdict on a recommended carry, one of the values of `State`."""
    failing = found.price is not None and found.price.check.failing > 0
    if not found.fits or failing or not math.isfinite(found.job_duration):
        return "bad"
    return "doubtful" if found.warnings else "good"


def _facts(found: StoredRecommendation) -> tuple[Fact, ...]:
    allowed = "" if found.allowed is None else f"{newtons(found.allowed[1 - LEADER])} are allowed"
    job = Fact("whole job", "cannot be planned")
    if math.isfinite(found.job_duration):
        job = Fact("whole job", seconds(found.job_duration), note="from approach to retreat")
    return (
        Fact("time", seconds(found.duration), note="limits on jerk kept"),
        Fact("force", f"{newtons(found.force)} commanded", note=allowed),
        job,
        Fact("holds", holds_text(found)),
    )


def holds_text(found: StoredRecommendation) -> str:
    """Return a phrase that says whether the reference forces allow to hold the box in every case of
    the uncertainty."""
    if not found.fits:
        return f"not within the reference force: {newtons(found.required)} are needed"
    if found.price is None:
        return "if everything is exactly as described: the cell states no uncertainty"
    failing = found.price.check.failing
    if failing:
        return f"not in {failing} of {found.price.check.cases} random cases"
    return f"in every case of {found.price.uncertainty.title}"


def export_command(path: Path, target: str) -> str:
    """Return the shell command that exports a trajectory file, timed within the limits stored in
    it.

    Args:
        path: path of the trajectory file.
        target: name of the export's target, such as 'torque'.
    """
    output = path.with_name(f"{path.stem}-{target}")
    return (
        f"dual-arm-carry export {shlex.quote(str(path))} --target {target} "
        f"--output {shlex.quote(str(output))}"
    )


def _rival(rival: Alternative, found: StoredRecommendation) -> str:
    """Return a phrase on another path: its duration with the force of the recommended carry, and
    its force in the duration of the recommended carry.

    Args:
        rival: figures of the other path.
        found: the recommendation.
    """
    duration, force = rival.duration_at_force, rival.force_at_duration
    same_force = "cannot be held with the same force"
    same_time = "cannot be driven in the same time"
    if math.isfinite(duration):
        slower = _percent(duration / found.duration)
        same_force = f"{seconds(duration)} at the same force ({slower})"
    if math.isfinite(force):
        same_time = f"{newtons(force)} in the same time ({_percent(force / found.force)})"
        if found.allowed is not None and force > found.allowed.min():
            same_time += f", above the reference force of {newtons(found.allowed.min())}"
    return f"{same_force}, {same_time}"


def _checked(price: RobustPrice) -> str:
    """Return a phrase on the robustness of the recommended carry.

    It states how many random cases of the uncertainty slip, and of which uncertainty; the largest
    force of the position-controlled arm; and the largest factor on the uncertainty at which the
    needed forces still are within the reference forces.

    Args:
        price: robust forces of the carry, by factor on the uncertainty.
    """
    slips = "slips" if price.check.failing == 1 else "slip"
    return (
        f"{price.check.failing or 'none'} of {price.check.cases} random cases {slips} "
        f"({price.uncertainty}); the leading arm needs up to {newtons(max(price.commanded))}; "
        f"the reference forces would hold {price.largest_factor:.2f} times as much"
    )


def _percent(ratio: float) -> str:
    return f"{100.0 * (ratio - 1.0):+.1f} %"


def _margins(found: StoredRecommendation) -> list[str]:
    """Return phrases on two errors up to which the commanded force still holds the box: the share
    of this force that may be missing, and the offset of the centre of mass along each axis.
    """
    texts = [
        f"up to {100.0 * margin.limit:.0f} % of it may be missing"
        for margin in found.margins
        if margin.quantity == "share of the force that is missing"
    ]
    offs = {
        margin.quantity[-1]: abs(margin.limit - margin.nominal)
        for margin in sorted(found.margins, key=lambda m: -abs(m.limit - m.nominal))
        if margin.quantity.startswith("centre of mass")
    }
    if offs:
        along = ", ".join(f"{1e3 * offs[axis]:.0f} mm along {axis}" for axis in sorted(offs))
        texts.append(f"or the centre of mass off by {along}, all else as described")
    return texts
