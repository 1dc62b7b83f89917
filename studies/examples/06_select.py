"""Select from a front: the balanced carry, or the one that spares a robot.

A front is a sequence of carries by increasing first objective. `balanced()`, the paper's selection,
has the least mean of both robots' peak forces; `lowest_force(robot)` and `lowest(objective)` are
its ends.
"""

import numpy as np

import hybrid_opt as ho

cell = ho.example("rack")
front = ho.search(cell, "nsga2", evaluations=1000, rng=np.random.default_rng(1))
for name, carry in {
    "balanced": front.balanced(),
    "least force of the left robot": front.lowest_force(0),
    "least force of the right robot": front.lowest_force(1),
}.items():
    print(f"{name}: {carry.peak_normal_force} N, {carry.excess_above_static} % above static")
