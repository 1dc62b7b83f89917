"""What a heavier box or other pads change, for a path that stays as it is."""

import hybrid_opt as ho

cell = ho.example("rack").drivable()
over = {"payload.mass": (8.0, 10.0), "contacts.friction": (0.8, 1.0)}
found: ho.Sweep = ho.sweep(cell, cell.initial, over, fixed=True)
print(found)
