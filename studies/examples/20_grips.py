"""Where on their faces pads press best for a path."""

import hybrid_opt as ho

cell = ho.example("rack")
grip: ho.Grip = ho.propose_grip(cell, up=(-0.02, 0.0), along=(0.0, 0.0), trials=9)
print(grip)
print(grip.cell.workcell.contacts[0].T_box_pad[:3, 3])
