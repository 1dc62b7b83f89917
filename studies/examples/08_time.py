"""Time a carry as robots can drive it: within all limits, and with little force."""

import hybrid_opt as ho

cell = ho.example("rack")
carry = cell.carry(cell.initial)
print(ho.time_path(cell, carry))
print(ho.time_path(cell, carry, ho.TimingLimits(force=51.0)))
every = ho.time_every_way(cell, carry, force_limit=51.0, curve_points=5)
for name, timing in every.timings.items():
    print(f"{name}: {timing.duration:.3f} s, {timing.status}")
for margin in every.margins:
    print(margin)
