"""The first screen of the page as HTML: the verdict, four facts, and what to do next."""

from __future__ import annotations

import html

from hybrid_opt.robust.cases import LEADER
from studies.report.data import ReportData
from studies.study.answer import Fact, StudyAnswer, newtons
from studies.study.recommendation import StoredRecommendation


def answer_html(data: ReportData) -> str:
    """Return the recommendation of a study, or the reason why there is none, as HTML; '' if the
    study has neither."""
    found = data.summary.answer("")
    if found is None:
        return ""
    tiles = "".join(_tile(fact, data.summary.recommendation) for fact in found.facts)
    commands = "".join(_command(fact) for fact in found.commands)
    warnings = "".join(
        f"<p class='warning'>Warning: {html.escape(text)}</p>" for text in found.warnings
    )
    play = "<button id='play-job' type='button'>Play it</button>" if found.facts else ""
    return (
        f"<section class='answer {found.state}'><h2>{html.escape(found.headline)}</h2>{warnings}"
        f"<ul class='tiles'>{tiles}</ul><div class='next'>{play}{commands}</div>"
        f"{_details(found)}</section>"
    )


def _tile(fact: Fact, choice: StoredRecommendation | None) -> str:
    bar = _bar(choice) if fact.heading == "force" and choice is not None else ""
    note = f"<small>{html.escape(fact.note)}</small>" if fact.note else ""
    return (
        f"<li class='{'wide' if bar else 'tile'}'><span>{html.escape(fact.heading)}</span>"
        f"<b>{html.escape(fact.text)}</b>{bar}{note}</li>"
    )


def _bar(choice: StoredRecommendation) -> str:
    """Return a bar as HTML that shows the commanded force and its contributions, beside the allowed
    force."""
    allowed = choice.force if choice.allowed is None else float(choice.allowed[1 - LEADER])
    whole = max(allowed, choice.force)
    parts = "".join(
        f"<i style='width:{100.0 * part.force / whole:.2f}%' "
        f"title='{html.escape(part.name, quote=True)} {newtons(part.force)}'></i>"
        for part in choice.parts
    )
    listed = ", ".join(f"{part.name} {newtons(part.force)}" for part in choice.parts)
    label = html.escape(f"{newtons(choice.force)} of {newtons(allowed)}: {listed}", quote=True)
    limit = f"<em style='left:{100.0 * allowed / whole:.2f}%'></em>"
    bar = f"<div class='bar' role='img' aria-label='{label}'>{parts}{limit}</div>"
    least, *doubts = choice.parts
    largest = sorted(doubts, key=lambda part: -part.force)[:LISTED]
    told = ", ".join(f"{part.name} {part.force:.1f}" for part in largest)
    more = ", ..." if len(doubts) > LISTED else ""
    rest = f", for what may be off {choice.force - least.force:.1f} ({told}{more})" if told else ""
    return f"{bar}<small>{html.escape(f'{least.name} {newtons(least.force)}{rest}')}. </small>"


LISTED = 3
"""Most contributions to the force that are listed below the bar, the largest first."""


def _command(fact: Fact) -> str:
    text = html.escape(fact.text)
    if not fact.is_command:
        return f"<span>{html.escape(fact.heading)} <code>{text}</code></span>"
    return (
        f"<span>{html.escape(fact.heading)} <code>{text}</code></span>"
        "<button class='copy' type='button'>Copy</button>"
    )


def _details(found: StudyAnswer) -> str:
    if not found.details:
        return ""
    facts = "".join(
        f"<dt>{html.escape(fact.heading)}</dt><dd>{html.escape(fact.sentence)}</dd>"
        for fact in found.details
    )
    opened = "" if found.state == "good" else " open"
    return f"<details{opened}><summary>Why, and what may be off</summary><dl>{facts}</dl></details>"
