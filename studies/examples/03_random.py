"""Judge many candidates: how many are feasible, and why the others are not.

`cell.evaluate(x)` takes (n, n_var) and judges on the task's samples. `penalised` is what a search
minimises: the objectives, or a value above one that grows with the time in violation.
"""

import numpy as np

import hybrid_opt as ho

cell = ho.example("rack")
x = cell.random(500, np.random.default_rng(1))
found = cell.evaluate(x)
print(found)
best = found.penalised.mean(axis=1).argmin()
print(cell.carry(x[best]))
