"""Judge many candidates: how many are feasible, and what the others fail of."""

import numpy as np

import hybrid_opt as ho

cell = ho.example("rack")
x = cell.random(500, np.random.default_rng(1))
found = cell.evaluate(x)
print(found)
best = found.penalised.mean(axis=1).argmin()
print(cell.carry(x[best]))
