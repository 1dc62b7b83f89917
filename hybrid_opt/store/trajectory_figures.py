"""The figures a trajectory is reported with: stored beside it, recomputed from it."""

from __future__ import annotations

from hybrid_opt.carry import Carry

ABSOLUTE_TOLERANCE = 1e-9
RELATIVE_TOLERANCE = 1e-6
"""Two evaluations of one trajectory may differ by this much: other compiler, other machine."""

OBJECTIVE = "objective_"
"""Before the name of an objective."""


def trajectory_figures(carry: Carry) -> dict[str, float]:
    """Figures of a judged carry, SI units.

    `feasible` is 1 or 0; `objective_<name>` are without penalty; means are over time.
    """
    judgement = carry.judgement
    assert judgement is not None, "figures are those of a carry that the evaluator judged"
    figures = {
        "feasible": float(judgement.feasible),
        "duration": carry.duration,
        "payload_limit": carry.payload_limit,
    }
    figures |= {f"{OBJECTIVE}{name}": value for name, value in judgement.objectives.items()}
    per_robot = {
        "peak_normal_force": carry.peak_normal_force,
        "mean_normal_force": carry.mean_normal_force,
        "peak_resultant_force": carry.peak_resultant_force,
        "peak_pressure_shift": carry.peak_pressure_shift,
        "peak_contact_torque_use": carry.peak_contact_torque_use,
    }
    for i in range(len(carry.arms)):
        figures |= {f"{name}_{i + 1}": float(values[i]) for name, values in per_robot.items()}
    return figures


def same_figure(first: float, second: float) -> bool:
    """Whether two values agree to the tolerances of a re-evaluation."""
    return abs(first - second) <= ABSOLUTE_TOLERANCE + RELATIVE_TOLERANCE * abs(first)
