"""The way of both arms to where a job begins, from another branch, and back home.

An arm cannot change its branch while it holds the box: it does so before it grips. `ho.plan_reach`
finds corners of both arms' joints; the straight lines between them are proven free of collisions.
"""

import numpy as np

import hybrid_opt as ho

cell = ho.example("rack")
job = ho.plan_job(ho.time_path(cell, cell.initial, ho.TimingLimits(force=70.0)))
home = np.array([0.0, 0.0, 0.0, 0.0, 1.57, 0.0] * 2)
rng = np.random.default_rng(1)
there = ho.plan_reach(job, home, rng=rng)
back = ho.plan_reach(job, home, rng=rng, after=True)
print("corners [rad]:", there.round(2), back.round(2), sep="\n")
