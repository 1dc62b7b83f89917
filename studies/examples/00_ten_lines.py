"""From a cell's file to a robot's trajectory."""

import numpy as np

import hybrid_opt as ho

rng = np.random.default_rng(1)
cell = ho.Cell.load("studies/workcells/rack.toml")
front = ho.search(cell, "nsga2", evaluations=1000, rng=rng)
front = ho.polish(cell, front, rng=rng)
carry = front.balanced()
timing = ho.time_path(cell, carry, ho.TimingLimits(force=52.0))
ho.export(timing, "ros2", "out/")
