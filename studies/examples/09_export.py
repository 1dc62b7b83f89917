"""Plan a whole job, export it for robots, and store a carry with its whole cell in one file."""

import hybrid_opt as ho

cell = ho.Cell.load("studies/workcells/rack.toml")
carry = cell.carry(cell.initial)
timing = ho.time_path(cell, carry, ho.TimingLimits(reference_speed=True))
job = ho.plan_job(timing)
print(job)
for target in ("csv", "json", "ros2-control", "mcap"):
    print(*ho.export(job, target, "out"))
ho.save(carry, "out/carry.json", {"by": "hand"})
