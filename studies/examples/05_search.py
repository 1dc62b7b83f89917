"""Search for the best compromises between the two arms' forces.

A front knows every candidate that its search evaluated. `ho.SearchSettings` has the settings of the
algorithm, how it learns of infeasibility, and where it starts.
"""

import numpy as np

import hybrid_opt as ho

print("algorithms:", *ho.algorithms())
cell = ho.example("rack")
settings = ho.SearchSettings(algorithm=ho.MopsoSettings(inertia=0.5))
rng = np.random.default_rng(1)
front: ho.Front = ho.search(cell, "mopso", evaluations=1000, rng=rng, settings=settings)
print(front)
print("hypervolume:", front.hypervolume())
print("infeasible candidates:", front.evaluations.infeasible_by_reason)
print(front[0])
