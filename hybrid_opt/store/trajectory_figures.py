"""The figures a trajectory is reported with: stored beside it, recomputed from it."""

from __future__ import annotations

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from symbolic.array import Array

ABSOLUTE_TOLERANCE = 1e-9
RELATIVE_TOLERANCE = 1e-6
"""Two evaluations of one trajectory may differ by this much: other compiler, other machine."""


def trajectory_figures(evaluator: CandidateEvaluator, x: Array) -> dict[str, float]:
    """Figures of one decision vector (n_var,) under the search's timing, SI units.

    `feasible` is 1 or 0; `objective_<name>` are without penalty; means are over time.
    Counts as one evaluation of the evaluator.
    """
    evaluation = evaluator.evaluate(x[None])
    outputs = {name: value[0] for name, value in evaluator.outputs(x[None]).items()}
    task = evaluator.workcell.task
    resultant = np.linalg.norm(outputs["contact_force"].reshape(-1, 2, 3), axis=2).max(axis=0)
    normal, time = outputs["normal_force"], outputs["time"].reshape(-1)
    mean = np.trapezoid(normal, time, axis=0) / (time[-1] - time[0])
    figures = {
        "feasible": float(evaluation.feasible[0]),
        "duration": float(time[-1] - time[0]),
        "payload_limit": float(
            evaluator.workcell.payload.mass * (task.reference_force / resultant).min()
        ),
    }
    for name, value in zip(evaluator.objective_names, evaluation.objectives[0], strict=True):
        figures[f"objective_{name}"] = float(value)
    for i in (0, 1):
        arm = i + 1
        torque = np.abs(outputs[f"joint_torque_{arm}"]) / evaluator.workcell.robots[i].torque_max
        figures |= {
            f"peak_normal_force_{arm}": float(normal[:, i].max()),
            f"mean_normal_force_{arm}": float(mean[i]),
            f"peak_resultant_force_{arm}": float(resultant[i]),
            f"peak_pressure_shift_{arm}": float(outputs["pressure_shift"][:, i].max()),
            f"peak_contact_torque_use_{arm}": float(torque.max()),
        }
    return figures


def same_figure(first: float, second: float) -> bool:
    """Whether two values agree to the tolerances of a re-evaluation."""
    return abs(first - second) <= ABSOLUTE_TOLERANCE + RELATIVE_TOLERANCE * abs(first)
