"""Timing, payload and margins of a trajectory as text for a terminal and as JSON values."""

from __future__ import annotations

from typing import Any

import numpy as np

from hybrid_opt.timing import ForceCurve, TimedTrajectory, Timing
from hybrid_opt.timing.robustness import KILOGRAM_FORCE
from hybrid_opt.timing.use import joint_use


def timing_json(timed: TimedTrajectory) -> dict[str, Any]:
    """Everything as JSON values; infinite durations become null."""
    return {
        "nominal_duration": timed.report.nominal_duration,
        "timings": {name: _one_json(timing) for name, timing in timed.report.timings.items()},
        "margins": [vars(margin) for margin in timed.margins],
        "force_curve": None if timed.curve is None else _curve_json(timed.curve),
    }


def _one_json(timing: Timing) -> dict[str, Any]:
    document: dict[str, Any] = {
        "status": timing.status.value,
        "reason": timing.reason,
        "duration": None,
        "iterations": timing.iterations,
        "slowed": timing.slowed,
        "seconds": timing.seconds,
        "use": {
            limit: {"ratio": excess.ratio, **vars(excess.place)}
            for limit, excess in timing.use.items()
        },
    }
    carry = timing.carry
    if carry is None:
        return document
    return document | {
        "duration": timing.duration,
        "objectives": carry.force_ratio.tolist(),
        "payload_limit": carry.payload_limit,
        "peak_normal_force": carry.peak_normal_force.tolist(),
        "peak_resultant_force": carry.peak_resultant_force.tolist(),
        "least_friction_margin": carry.friction_margin.min(axis=0).tolist(),
        "peak_pressure_shift": carry.peak_pressure_shift.tolist(),
        "peak_point_moment_residual": float(
            np.linalg.norm(carry.point_moment_residual, axis=1).max()
        ),
        "peak_moment_residual": float(np.linalg.norm(carry.moment_residual, axis=1).max()),
        "joint_use": {key: use.tolist() for key, use in joint_use(carry, carry.workcell).items()},
    }


def _curve_json(curve: ForceCurve) -> dict[str, Any]:
    return {
        "static_force": curve.static_force,
        "unlimited_force": curve.unlimited_force,
        "points": [
            {
                "force": force,
                "duration": duration if np.isfinite(duration) else None,
                "status": status.value,
            }
            for force, duration, status in zip(
                curve.force.tolist(), curve.duration.tolist(), curve.status, strict=False
            )
        ],
    }


def timing_text(timed: TimedTrajectory) -> str:
    """A table of the timings, their reasons, the margins and the force curve."""
    report, margins, curve = timed.report, timed.margins, timed.curve
    lines = [
        f"Timing (at the reference speeds without ramps: {report.nominal_duration:.3f} s)",
        f"  {'':<21}{'status':<17}{'s':>8}{'N1/Nref':>9}{'N2/Nref':>9}"
        f"{'payload':>10}{'torque':>8}{'shift':>8}",
    ]
    for name, timing in report.timings.items():
        lines.append(f"  {name:<21}{timing.status.value:<17}{_figures(timing)}")
    lines += [f"  {name}: {timing.reason}" for name, timing in report.timings.items()]
    if margins:
        lines += ["", "Margins under the timing closest to the reference speed"]
        lines += [f"  {margin}" for margin in margins]
    if curve is not None:
        lines += ["", f"Duration against force limit (at rest {curve.static_force:.2f} N)"]
        lines += [
            f"  {force:8.2f} N ({force / KILOGRAM_FORCE:5.2f} kgf)  {duration:8.3f} s  {status}"
            for force, duration, status in zip(
                curve.force, curve.duration, curve.status, strict=False
            )
        ]
    return "\n".join(lines)


def _figures(timing: Timing) -> str:
    carry = timing.carry
    if carry is None:
        return f"{'-':>8}"
    first, second = carry.force_ratio
    torque = joint_use(carry, carry.workcell)["joint torque"].max()
    shift = 1e3 * float(carry.pressure_shift.max())
    return (
        f"{timing.duration:8.3f}{first:9.4f}{second:9.4f}"
        f"{carry.payload_limit:7.2f} kg{100.0 * torque:6.1f} %{shift:5.1f} mm"
    )
