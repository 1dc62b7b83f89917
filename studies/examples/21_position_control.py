"""Ask whether position control can press, and what happens if both arms do not start together.

Arms that only track positions press by aiming into the box, so the force depends on their stiffness
[N/m] (docs/explanation/job.md). A target that gives each arm a controller of its own is refused
where the box would not survive 10 ms between their starts, or the skew that
`ho.BundleOptions(skew=...)` names.
"""

import hybrid_opt as ho
from hybrid_opt.job.compliance import largest_skew, position_control, skewed

cell = ho.example("rack")
timing = ho.time_path(cell, cell.initial, ho.TimingLimits(force=55.0))
job = ho.plan_job(timing, ho.SqueezeSettings(factor=1.3))
for phase in job.phases:
    print(phase.name, phase.duration, "free of collisions:", phase.certificate.is_free)
for stiffness in (1e4, 1e5, 1e6):
    print(stiffness, position_control(job, stiffness).verdict)
print("10 ms late:", skewed(job, 0.01, 1e4).is_held)
print("is_held [ms]:", 1e3 * largest_skew(job, 1e4))
