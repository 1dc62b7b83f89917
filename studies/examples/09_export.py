"""Plan a whole job, export it for robots, and store a carry with its whole cell in one file.

`ho.plan_job` plans what happens before and after the carry (docs/explanation/job.md);
docs/reference/bundles.md describes the targets. A stored carry holds its whole cell;
`dual-arm-carry replay` evaluates it anywhere.
"""

import hybrid_opt as ho

print("targets:", *ho.targets())
cell = ho.example("rack")
carry = cell.carry(cell.initial)
timing = ho.time_path(cell, carry, ho.TimingLimits(reference_speed=True))
job: ho.Job = ho.plan_job(timing, ho.SqueezeSettings(factor=1.3))
print(job)
options = ho.BundleOptions(step=0.01)
for target in ("data", "torque"):
    print(*ho.export(job, target, "out", origin=ho.Origin("first"), options=options))
ho.save(carry, "out/carry.json", {"by": "hand"})
print(ho.load("out/carry.json"))
