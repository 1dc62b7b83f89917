"""Prove that a carry is free of collisions between its samples too.

`cell.certify` proves the continuous path free, or says where it is not. Fronts hold certified
carries only.
"""

import hybrid_opt as ho

cell = ho.example("rack")
certificate = cell.certify(cell.initial)
print(certificate)
print("free:", certificate.is_free, "- grid points:", certificate.grid_points)
lowered = cell.initial.copy()
lowered[2::6] -= 0.1
print(cell.carry(lowered).judgement)
