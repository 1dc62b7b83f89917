"""What every number of the cell does to a carry's force and duration.

`ho.sensitivities` gives derivatives by the numbers of the cell, named as in its file, the largest
first: of the force to command that holds in every case of the uncertainty, and of the duration. The
path stays. A carry's duration is that of the task's time law; a timing's is that of the fastest
timing within the same limits, so that base, pad and joint limits count. The text shows what a usual
change does (1 mm, 1 degree, 0.01 of a share); `force` and `duration` are per unit. Where a number
costs more one way than the other, `lowered_force` and `lowered_duration` are per unit that it
falls. `missing` names the numbers without derivatives, and why. A timing takes 15 to 35 s; pads
that do not face one another take a minute.
"""

import hybrid_opt as ho

cell = ho.example("rack")
found: ho.Sensitivities = ho.sensitivities(cell.carry(cell.initial))
print(found)
friction = found["contacts[0].friction"]
print("newtons per unit of friction:", friction.force, "- not computed:", *found.missing)
