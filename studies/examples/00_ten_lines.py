"""From a cell's file to a robot's trajectory."""

import numpy as np

import hybrid_opt as ho

rng = np.random.default_rng(1)
cell = ho.example("rack").drivable()
front = ho.search(cell, "nsga2", evaluations=1000, rng=rng)
front = ho.polish(front, rng=rng)
found = ho.recommend(front)
print(found)
ho.export(ho.plan_job(found), "ros2-control", "out/")
