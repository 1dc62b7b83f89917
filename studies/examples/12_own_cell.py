"""Change a cell: the rack with a heavier box and other pads, and a search in it.

A workcell is a file (docs/tutorials/two-robots.md). `cell.changed` gives another cell in memory, by
the keys of the file: `payload.mass`, `contacts.friction` of both contacts, `contacts[0].friction`
of one, `environment.top board.xyz` by the body's name. The changed cell is checked like a file. It
can be searched, polished, stored and exported like any other. Nothing is compiled anew where only
numbers differ (docs/explanation/speed.md).
"""

import numpy as np

import hybrid_opt as ho

rack = ho.Cell.load("studies/workcells/rack.toml")
cell = rack.changed({"payload.mass": 14.0, "contacts.friction": 0.95})
front = ho.search(cell, "nsga2", evaluations=300, rng=np.random.default_rng(1))
print(front.balanced())
