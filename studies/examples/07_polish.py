"""Polish a front, and see what each attempt became."""

import numpy as np

import hybrid_opt as ho

rng = np.random.default_rng(1)
cell = ho.Cell.load("studies/workcells/rack.toml")
front = ho.search(cell, "nsga2", evaluations=1000, rng=rng)
polished = ho.polish(cell, front, rng=rng)
print(polished)
print("hypervolume:", front.hypervolume(), "->", polished.hypervolume())
print("payload [kg]:", front.balanced().payload_limit, "->", polished.balanced().payload_limit)
