"""Polish a front, and see what each attempt became.

The polish minimises the paper's two objectives (docs/explanation/polish.md). The result is a front
again. Fronts of `Cell.drivable()` are polished by duration and force; carries whose paths are known
to be good take part with `paths=[carry]`.
"""

import numpy as np

import hybrid_opt as ho

rng = np.random.default_rng(1)
front = ho.search(ho.example("rack"), "nsga2", evaluations=1000, rng=rng)
polished = ho.polish(front, rng=rng, settings=ho.PolishSettings(attempts=60), progress=True)
print(polished)
print("hypervolume:", front.hypervolume(), "->", polished.hypervolume())
print("payload [kg]:", front.balanced().payload_limit, "->", polished.balanced().payload_limit)
