"""Time a carry as robots can drive it: within all limits, and with little force.

`ho.time_path` finds the fastest timing from rest to rest within the limits of joints, torques,
contacts and payload. `ho.TimingLimits` adds a limit of the normal forces, or keeps to the task's
reference speed. `ho.compare_timings` puts all timings side by side and says how wrong the cell's
description may be (docs/explanation/timing.md).
"""

import hybrid_opt as ho

cell = ho.example("rack")
carry = cell.carry(cell.initial)
print(ho.time_path(cell, carry))
print(ho.time_path(cell, carry, ho.TimingLimits(force=51.0)))
every = ho.compare_timings(cell, carry, force_limit=51.0, curve_points=5)
for name, timing in every.timings.items():
    print(f"{name}: {timing.duration:.3f} s, {timing.status}")
for margin in every.margins:
    print(margin)
