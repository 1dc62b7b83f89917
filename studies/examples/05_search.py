"""Search for the best compromises between the two arms' forces."""

import numpy as np

import hybrid_opt as ho

cell = ho.Cell.load("studies/workcells/rack.toml")
front = ho.search(cell, "mopso", evaluations=1000, rng=np.random.default_rng(1))
print(front)
print("hypervolume:", front.hypervolume())
print("infeasible candidates:", front.evaluations.infeasible_by_reason)
print(front[0])
