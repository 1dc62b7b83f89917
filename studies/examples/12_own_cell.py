"""A cell of one's own: the rack's file with a heavier box, and a search in it."""

from pathlib import Path

import numpy as np

import hybrid_opt as ho

rack = Path("studies/workcells/rack.toml").resolve()
text = rack.read_text().replace("../robots", str(rack.parents[1] / "robots"))
Path("out").mkdir(exist_ok=True)
Path("out/heavy.toml").write_text(text.replace("mass = 10.0", "mass = 14.0"))
cell = ho.Cell.load("out/heavy.toml")
front = ho.search(cell, "nsga2", evaluations=300, rng=np.random.default_rng(1))
print(front.balanced())
