"""Search for drivable carries, and have one of them recommended."""

import numpy as np

import hybrid_opt as ho

cell = ho.Cell.load("studies/workcells/rack.toml").drivable()
front = ho.search(cell, "nsga2", evaluations=1000, rng=np.random.default_rng(1))
print(ho.recommend(cell, front))
found = ho.recommend(cell, front, ho.Wish(force=100.0))
print(found)
print(found.squeeze.account, *found.advice, *found.margins, sep="\n")
print(found.carry)
