"""Let start branches of the arms compete.

Where the workcell says `start_branch = "search"`, pairs of branches compete before the search
(docs/reference/results.md).
"""

import numpy as np

import hybrid_opt as ho

cell = ho.example("rack").changed({"robots[0].start_branch": "search"})
found = ho.search_branches(cell, evaluations=2000, rng=np.random.default_rng(1))
print(found)
print(cell.with_start_branches(found.winner))
