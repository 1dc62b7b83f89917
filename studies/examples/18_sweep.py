"""What a heavier box or other pads change, for a path that stays as it is.

`ho.sweep` gives duration and commanded force of the recommended carry for every combination of some
numbers. Without `fixed=True` the path is polished anew in every cell. With `file=` a sweep can be
continued; with `jobs=` workers share it. `dual-arm-carry sweep` adds a table and a figure.
"""

import hybrid_opt as ho

cell = ho.example("rack").drivable()
over = {"payload.mass": (8.0, 10.0), "contacts.friction": (0.8, 1.0)}
found: ho.Sweep = ho.sweep(cell, cell.initial, over, fixed=True)
print(found)
