"""Search for drivable carries, and have one of them recommended."""

import numpy as np

import hybrid_opt as ho

cell = ho.example("rack").drivable()
front = ho.search(cell, "nsga2", evaluations=1000, rng=np.random.default_rng(1))
print(ho.recommend(front, progress=True))
found: ho.Recommendation = ho.recommend(front, ho.Wish(force=100.0))
print(found)
print(found.squeeze.account, *found.advice, *found.margins, sep="\n")
print(found.carry)
