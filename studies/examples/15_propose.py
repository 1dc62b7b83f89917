"""Propose a first carry and a complete workcell file for a problem.

A problem file has no carry yet. `ho.propose` finds one and completes the file
(docs/tutorials/two-robots.md); store its text beside the problem's robots. `ho.propose_classes`
finds several that pass what is in the way on different sides.
"""

from pathlib import Path

import numpy as np

import hybrid_opt as ho

problem = "studies/problems/past-a-post.toml"
settings = ho.ProposeSettings(seconds=60.0)
try:
    found: ho.Proposal = ho.propose(problem, rng=np.random.default_rng(1), settings=settings)
    print(found)
    print(found.text(Path("out")))
    two = ho.ProposeSettings(seconds=60.0, classes=2)
    for each in ho.propose_classes(problem, rng=np.random.default_rng(1), settings=two):
        print(each.sides, each.length)
except ho.DualArmError as error:
    print("nothing found:", error)
