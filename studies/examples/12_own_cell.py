"""A cell of one's own: the rack with a heavier box and other pads, and a search in it."""

import numpy as np

import hybrid_opt as ho

rack = ho.Cell.load("studies/workcells/rack.toml")
cell = rack.changed({"payload.mass": 14.0, "contacts.friction": 0.95})
front = ho.search(cell, "nsga2", evaluations=300, rng=np.random.default_rng(1))
print(front.balanced())
