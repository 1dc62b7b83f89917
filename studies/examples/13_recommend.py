"""Recommend the carry to run, as the robots drive it, and say why.

In a drivable cell each candidate is a path and a force limit, timed as fast as all limits allow. In
a cell that minimises robust forces the limit is about these (docs/explanation/robust.md). Wishes
are about the commanded force, the driven duration, the payload, the reference force or the
uncertainty (docs/reference/results.md). The budget of the grip says before any search whether the
box can be held.
"""

import numpy as np

import hybrid_opt as ho

cell = ho.example("rack").drivable()
budget: ho.GripBudget = ho.grip_budget(cell.workcell)
print(budget)
front = ho.search(cell, "nsga2", evaluations=1000, rng=np.random.default_rng(1))
print(ho.recommend(front, progress=True))
found: ho.Recommendation = ho.recommend(
    front, ho.Wish(force=100.0, uncertainty=ho.Uncertainty(mass=0.02))
)
print(found)
print(found.squeeze.breakdown, *found.advice, *found.margins, sep="\n")
print(found.carry)
