"""Where on their faces pads press best for a path.

`ho.propose_grip` moves both pads alike on their faces, within ranges [m], to where the hand-made
path of the cell has the least product of duration and commanded force as robots drive it; with the
pads there it is certified. `dual-arm-carry propose --grips` does it for a proposed carry.
"""

import hybrid_opt as ho

cell = ho.example("rack")
grip: ho.Grip = ho.propose_grip(cell, up=(-0.02, 0.0), along=(0.0, 0.0), trials=9)
print(grip)
print(grip.cell.workcell.contacts[0].T_box_pad[:3, 3])
