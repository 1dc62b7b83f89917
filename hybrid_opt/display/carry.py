"""A carry as text, and in a notebook as its figures beside its normal forces."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

import numpy as np

from hybrid_opt.display.svg import ARMS, REST, Series, plot
from hybrid_opt.display.table import lines, table
from hybrid_opt.evaluate.static_hold import static_hold
from hybrid_opt.indicators.metrics import excess_above_static
from symbolic.array import Array

if TYPE_CHECKING:
    from hybrid_opt.carry import Carry


def carry_text(carry: Carry) -> str:
    """Text of a carry."""
    return "\n".join([heading(carry), *lines(figures(carry))])


def carry_html(carry: Carry) -> str:
    """HTML of a carry for a notebook."""
    still = float(static_hold(carry.workcell).normal_force.max())
    time = carry.time - carry.time[0]
    series = [
        Series(robot.name, np.column_stack([time, carry.normal_force[:, i]]), ARMS[i])
        for i, robot in enumerate(carry.workcell.robots)
    ]
    rest = np.array([[time[0], still], [time[-1], still]])
    series.append(Series("level and still", rest, REST, size=0.8))
    focus = np.concatenate([one.points for one in series])
    picture = plot(series, "time [s]", "normal force [N]", focus)
    return f"<div><p>{html.escape(heading(carry))}</p>{table(figures(carry))}{picture}</div>"


def heading(carry: Carry) -> str:
    """A carry in one line."""
    timing = "a timing within limits" if carry.timing == "limits" else f"time law {carry.timing!r}"
    verdict = f": {carry.judgement}" if carry.judgement is not None else ""
    return f"Carry of {carry.workcell.name!r} under {timing}, {carry.duration:.3f} s{verdict}"


def figures(carry: Carry) -> dict[str, str]:
    """Figures by name, with units."""
    hold = static_hold(carry.workcell)
    peaks = carry.peak_normal_force
    excess = excess_above_static(peaks, hold.normal_force)
    found = {
        "peak normal force": f"{_pair(peaks, 3)} N",
        "over the reference": _pair(carry.force_ratio, 4),
        "above level and still": f"{_pair(excess, 2)} %",
        "peak whole force": f"{_pair(carry.peak_resultant_force, 3)} N",
        "payload limit": f"{carry.payload_limit:.3f} kg (level and still {hold.payload_limit:.3f})",
        "largest pressure shift": f"{_pair(1e3 * carry.peak_pressure_shift, 2)} mm",
        "torque of the contacts": f"{_pair(100.0 * carry.peak_contact_torque_use, 1)} % of maximum",
    }
    if carry.judgement is not None:
        found |= {
            f"objective {name}": f"{value:.6f}"
            for name, value in carry.judgement.objectives.items()
        }
    return found


def _pair(values: Array, digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)
