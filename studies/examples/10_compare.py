"""Compare two algorithms over some seeds; the spread between seeds is part of the answer.

Campaigns with replicas, rank tests and effect sizes are `dual-arm-carry run` and
`dual-arm-carry compare`.
"""

import numpy as np

import hybrid_opt as ho

cell = ho.example("rack")
small = {
    "nsga2": ho.SearchSettings(algorithm=ho.GeneticSettings(population=20)),
    "mopso": ho.SearchSettings(algorithm=ho.MopsoSettings(swarm=20)),
}
for algorithm, own in small.items():
    rngs = [np.random.default_rng(seed) for seed in range(5)]
    fronts = [ho.search(cell, algorithm, evaluations=300, rng=rng, settings=own) for rng in rngs]
    volumes = [front.hypervolume() for front in fronts]
    print(algorithm, np.median(volumes), min(volumes), max(volumes))
