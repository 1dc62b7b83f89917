"""Time a carry within limits on jerk as well.

Without `jerk=` the limits are those that the workcell states as `jerk_max` of its robots
(docs/explanation/timing.md).
"""

import numpy as np

import hybrid_opt as ho

cell = ho.example("rack")
carry = cell.carry(cell.initial)
free: ho.Timing = ho.time_path(cell, carry)
jerk = ho.JerkLimits(joints=np.full(12, 50.0), payload=20.0)
timing: ho.JerkTiming = ho.time_with_jerk(cell, carry, jerk=jerk)
print(free)
print(timing)
