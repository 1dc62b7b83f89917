"""From a cell's file to a robot's trajectory.

Carries as robots drive them are searched for and polished, one of them is recommended, and the job
around it is written for robots. No force has to be named: the recommended carry has the least
product of duration and commanded force of those that hold in every case of the cell's uncertainty.
The first search in a cell compiles for some seconds, the first polish for some minutes; later
programs load what was compiled.
"""

import numpy as np

import hybrid_opt as ho

rng = np.random.default_rng(1)
cell = ho.example("rack").drivable()
front = ho.search(cell, "nsga2", evaluations=1000, rng=rng)
front = ho.polish(front, rng=rng)
found = ho.recommend(front)
print(found)
ho.export(ho.plan_job(found), "torque", "out/")
