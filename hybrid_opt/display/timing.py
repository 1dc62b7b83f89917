"""A timing as text, and in a notebook as its limits' use beside the carry under it."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

from hybrid_opt.display.carry import carry_html
from hybrid_opt.display.table import lines, table

if TYPE_CHECKING:
    from hybrid_opt.timing.records import Timing


def timing_text(timing: Timing) -> str:
    """Text of a timing."""
    return "\n".join([heading(timing), *lines(limit_use(timing))])


def timing_html(timing: Timing) -> str:
    """HTML of a timing for a notebook."""
    carry = "" if timing.carry is None else carry_html(timing.carry)
    return f"<div><p>{html.escape(heading(timing))}</p>{table(limit_use(timing))}{carry}</div>"


def heading(timing: Timing) -> str:
    """A timing in one line."""
    return f"Timing, {timing.status}: {timing.reason}"


def limit_use(timing: Timing) -> dict[str, str]:
    """How far each limit is used and where, the most used first."""
    ranked = sorted(timing.use.items(), key=lambda item: -item[1].ratio)
    return {
        name: f"{100.0 * excess.ratio:5.1f} %  {_where(excess.place.robot, excess.place.joint)}"
        f"u = {excess.place.parameter:.3f}"
        for name, excess in ranked
    }


def _where(robot: str, joint: str) -> str:
    who = " ".join(part for part in (robot, joint) if part)
    return f"{who}, " if who else ""
