"""Evaluate one carry: the hand-made trajectory of the rack.

A carry is a decision vector (the free waypoints of the box's path) with everything that follows
from it. `cell.carry(x)` gives it under the task's own time law, as a search sees it. Quantities of
both robots have an axis for them (`carry.normal_force` is (n, 2)); those of the joints are in
`carry.arms`.
"""

import hybrid_opt as ho

cell = ho.example("rack")
print(cell)
carry: ho.Carry = cell.carry(cell.initial)
print(carry)
print("peak normal forces [N]:", carry.peak_normal_force)
print("payload limit [kg]:", carry.payload_limit)
print("first arm at the start [rad]:", carry.arms[0].q[0])
