"""Search for drivable carries, and have one of them recommended."""

import numpy as np

import hybrid_opt as ho

cell = ho.Cell.load("studies/workcells/rack.toml").drivable()
front = ho.search(cell, "nsga2", evaluations=1000, rng=np.random.default_rng(1))
print(ho.recommend(cell, front.x))
found = ho.recommend(cell, front.x, ho.Wish(force=52.0))
print(found)
print(found.commanded, found.squeeze, *found.unsure, sep="\n")
print(found.carry)
