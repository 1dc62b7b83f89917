"""Evaluate one carry: the hand-made trajectory of the rack."""

import hybrid_opt as ho

cell = ho.example("rack")
print(cell)
carry: ho.Carry = cell.carry(cell.initial)
print(carry)
print("peak normal forces [N]:", carry.peak_normal_force)
print("payload limit [kg]:", carry.payload_limit)
print("first arm at the start [rad]:", carry.arms[0].q[0])
