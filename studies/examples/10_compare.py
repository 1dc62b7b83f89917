"""Compare two algorithms over some seeds; the spread between seeds is part of the answer."""

import numpy as np

import hybrid_opt as ho

cell = ho.example("rack")
for algorithm in ("nsga2", "mopso"):
    fronts = [
        ho.search(cell, algorithm, evaluations=300, rng=np.random.default_rng(seed))
        for seed in range(5)
    ]
    volumes = [front.hypervolume() for front in fronts]
    print(algorithm, np.median(volumes), min(volumes), max(volumes))
