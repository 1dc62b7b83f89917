"""The carry to run, as words: the terminal and the page say the same."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hybrid_opt.campaign.recommended import StoredPrice, StoredRecommendation, StoredRival, set_text
from hybrid_opt.campaign.summary import CampaignSummary
from hybrid_opt.timing.document import StoredJerk
from hybrid_opt.timing.records import TimingStatus
from symbolic.array import Array

EXPORT_FORM = "ros2"


@dataclass(frozen=True)
class RecommendationText:
    """The opening text of a study.

    Attributes:
        headline: the carry in one line.
        facts: heading and text, in the order in which they matter.
        warnings: what speaks against it.
    """

    headline: str
    facts: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]

    def terminal(self) -> str:
        """Text for a terminal."""
        width = max(len(heading) for heading, _ in self.facts)
        lines = [self.headline]
        lines += [f"  {heading:<{width}}  {text}" for heading, text in self.facts]
        return "\n".join(lines + [f"  WARNING: {text}" for text in self.warnings])


def study_words(summary: CampaignSummary, folder: str) -> RecommendationText | None:
    """What a study opens with: the carry to run, or why there is none; None where nothing is known
    of either.

    Args:
        folder: as for `recommendation_text`.
    """
    if summary.recommendation is not None:
        return recommendation_text(summary.recommendation, summary.robots, folder)
    if not summary.no_recommendation:
        return None
    return RecommendationText("No carry is recommended", (("why", summary.no_recommendation),), ())


def recommendation_text(
    found: StoredRecommendation, robots: Sequence[str], folder: str
) -> RecommendationText:
    """The words for a stored recommendation.

    Args:
        robots: both robots' names.
        folder: of the results, in front of the files' names; '' where the reader is in it.
    """
    headline = (
        f"Run this carry: {found.duration:.2f} s, {found.force_kind.pressing} "
        f"{max(found.limited_force):.2f} N ({_of_robots(found.limited_force, robots)})"
    )
    facts = [
        ("why", f"{found.why}; of {found.considered} drivable carries, from {found.source}"),
        ("file", str(Path(folder) / found.file)),
        ("export", export_command(Path(folder) / found.file, found.force_limit)),
        *([] if found.jerk is None else [("within jerk limits", _jerk(found.jerk))]),
        *_planned(found, robots),
        ("press with", f"{_of_robots(found.squeeze, robots)}, {found.squeeze_reason}"),
        ("payload", f"up to {found.payload_limit:.2f} kg on the same motion"),
        *[(rival.label, _rival(rival, found)) for rival in found.rivals],
        ("margins", "; ".join(_margins(found)) or "not known"),
    ]
    if found.price is not None:
        facts.append(("robust", _robust(found.price)))
    if found.unsure:
        facts.append(
            (
                "if less sure",
                "command "
                + "; ".join(
                    f"{max(doubt.peak_force):.1f} N if {doubt.doubt}"
                    + ("" if doubt.within_reference else " (beyond the reference force)")
                    for doubt in found.unsure
                )
                + "; state it as [uncertainty] in the workcell",
            )
        )
    return RecommendationText(headline, tuple(facts), found.warnings)


def _planned(found: StoredRecommendation, robots: Sequence[str]) -> list[tuple[str, str]]:
    """The planned forces, where limits are about others."""
    if found.robust_force is None:
        return []
    return [("planned", f"{_of_robots(found.peak_force, robots)}, if nothing is uncertain")]


def export_command(path: Path, force: float) -> str:
    """The command that makes of a trajectory file, timed within a force limit [N], what robots
    need."""
    output = path.with_name(f"{path.stem}-{EXPORT_FORM}")
    return (
        f"python -m studies.export {shlex.quote(str(path))} --form {EXPORT_FORM} "
        f"--force-limit {force:.6g} --output {shlex.quote(str(output))}"
    )


def _jerk(jerk: StoredJerk) -> str:
    """Cost of the cell's limits on jerk."""
    if jerk.status != TimingStatus.OK:
        return f"not found: {jerk.status}"
    return (
        f"{jerk.duration:.2f} s ({_percent(jerk.duration / jerk.without)}), at rest without "
        "acceleration at both ends; this is what the export drives"
    )


def _of_robots(values: Array, robots: Sequence[str]) -> str:
    return ", ".join(f"{name} {value:.1f} N" for name, value in zip(robots, values, strict=True))


def _rival(rival: StoredRival, found: StoredRecommendation) -> str:
    """Another path beside the recommended carry."""
    duration, force = rival.duration_at_force, rival.force_at_duration
    same_force, same_time = "cannot move with so little force", "is never so fast"
    if math.isfinite(duration):
        same_force = f"{duration:.2f} s at the same force ({_percent(duration / found.duration)})"
    if math.isfinite(force):
        same_time = f"{force:.2f} N in the same time ({_percent(force / found.force_limit)})"
    return f"{same_force}, {same_time}"


def _robust(price: StoredPrice) -> str:
    """Cost of the set, the largest multiple of it that the arms allow, and random cases."""
    named = "[uncertainty]" if price.stated else "a usual set"
    plan, sure = (max(values) for values in (price.peak[0], price.commanded))
    allowed = (
        f"up to {price.largest_factor:.2f} times the set"
        if math.isfinite(price.largest_factor)
        else "any multiple of the set"
    )
    if not price.largest_factor:
        allowed = "not even the nominal case"
    return (
        f"{sure:.1f} N hold in every case of {named} ({set_text(price)}), "
        f"{_percent(sure / plan)} against the nominal case; the reference forces allow {allowed}; "
        f"{price.failing or 'none'} of {price.cases} random cases "
        f"{'slip' if price.failing != 1 else 'slips'}"
    )


def _percent(ratio: float) -> str:
    return f"{100.0 * (ratio - 1.0):+.1f} %"


def _margins(found: StoredRecommendation) -> list[str]:
    """Friction of both contacts, and the nearest limit of the centre of mass along each axis."""
    texts = []
    for margin in found.margins:
        if margin.quantity == "friction of both contacts":
            end = f" ({margin.fails} beyond)" if margin.fails else ""
            texts.append(f"friction down to {margin.limit:.2f}{end}")
    offs = {
        margin.quantity[-1]: abs(margin.limit - margin.nominal)
        for margin in sorted(found.margins, key=lambda m: -abs(m.limit - m.nominal))
        if margin.quantity.startswith("centre of mass")
    }
    if offs:
        along = ", ".join(f"{1e3 * offs[axis]:.0f} mm along {axis}" for axis in sorted(offs))
        texts.append(f"centre of mass off by {along}")
    return texts
