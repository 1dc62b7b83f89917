"""Propose a first carry and a complete workcell file for a problem."""

from pathlib import Path

import numpy as np

import hybrid_opt as ho

problem = "studies/problems/past-a-post.toml"
settings = ho.ProposeSettings(seconds=60.0)
try:
    found: ho.Proposal = ho.propose(problem, rng=np.random.default_rng(1), settings=settings)
    print(found)
    print(found.text(Path("out")))
except ho.DualArmError as error:
    print("nothing found:", error)
