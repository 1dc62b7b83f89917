"""What every number of the cell does to a carry's force and duration."""

import hybrid_opt as ho

cell = ho.example("rack")
found: ho.Sensitivities = ho.sensitivities(cell.carry(cell.initial))
print(found)
friction = found["contacts[0].friction"]
print("newtons per unit of friction:", friction.force, "- not told of:", *found.missing)
