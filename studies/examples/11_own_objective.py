"""Search with an objective of one's own: the box's largest height, beside a robot's force.

An objective is a function of the compiled outputs, each with a leading axis over candidates, and of
the workcell. The candidate's function in `symbolic/functions.py` lists the outputs. Scale the
objective so that values of interest lie below one: infeasible candidates get values above.
"""

from collections.abc import Mapping

import numpy as np

import hybrid_opt as ho


def height(outputs: Mapping[str, np.ndarray], workcell: ho.Workcell) -> np.ndarray:
    """Return the box's largest height over twice its height at the goal, one per candidate."""
    goal = workcell.task.waypoints[-1].lower[2]
    return np.asarray(outputs["pose"][:, :, 2].max(axis=1) / (2.0 * goal))


print("known objectives:", *ho.objectives())
low = ho.Objective("height", "largest height / twice the goal's", height)
cell = ho.example("rack", objectives=("peak_force_1", low))
front = ho.search(cell, "nsga2", evaluations=1000, rng=np.random.default_rng(1))
print(front)
print(front.lowest("height"))
