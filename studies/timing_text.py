"""Timing, payload and margins of a trajectory as text for a terminal."""

from __future__ import annotations

from hybrid_opt.timing import ForceCurve, TimedTrajectory, Timing
from hybrid_opt.timing.robustness import KILOGRAM_FORCE, Margin
from hybrid_opt.timing.use import joint_use
from studies.text_table import number, text_table


def timing_text(timed: TimedTrajectory) -> str:
    """A table of the timings, their reasons, the margins and the force curve."""
    report = timed.report
    head = ("timing", "status", "s", "N1/Nref", "N2/Nref", "payload kg", "torque %", "shift mm")
    rows = [[name, t.status.value, *_cells(t)] for name, t in report.timings.items()]
    parts = [
        f"Timing (at the reference speeds without ramps: {number(report.nominal_duration, 3)} s)\n"
        + text_table([head, *rows], left=(0, 1)),
        "\n".join(f"{name}: {timing.reason}" for name, timing in report.timings.items()),
    ]
    if report.jerk is not None:
        without, cost = report.jerk.without, 100.0 * report.jerk.cost
        parts.append(f"Limits on jerk cost {number(cost, 1)} % of {number(without, 3)} s")
    if timed.margins:
        parts.append(_margins(timed.margins))
    if timed.curve is not None:
        parts.append(_curve(timed.curve))
    return "\n\n".join(parts)


def _cells(timing: Timing) -> list[str]:
    carry = timing.carry
    if carry is None:
        return ["-"] * 6
    torque = joint_use(carry, carry.workcell)["joint torque"].max()
    return [
        number(timing.duration, 3),
        *(number(ratio, 4) for ratio in carry.force_ratio),
        number(carry.payload_limit, 2),
        number(torque, 1, 100.0),
        number(float(carry.pressure_shift.max()), 1, 1e3),
    ]


def _margins(margins: tuple[Margin, ...]) -> str:
    rows = [("quantity", "nominal", "limit", "unit", "what fails beyond it")]
    rows += [
        (m.quantity, number(m.nominal, 4), number(m.limit, 4), m.unit, m.fails or "nothing")
        for m in margins
    ]
    table = text_table(rows, left=(0, 3, 4))
    return f"Margins under the timing closest to the reference speed\n{table}"


def _curve(curve: ForceCurve) -> str:
    rows = [("N", "kgf", "s", "status")]
    rows += [
        (number(force, 2), number(force / KILOGRAM_FORCE, 2), number(duration, 3), status.value)
        for force, duration, status in zip(curve.force, curve.duration, curve.status, strict=True)
    ]
    rest = number(curve.static_force, 2)
    return f"Duration against force limit (at rest {rest} N)\n{text_table(rows, left=(3,))}"
