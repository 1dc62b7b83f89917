"""A whole job: grip, press, lift, carry, set down, let go. docs/job.md describes it."""

from hybrid_opt.job.plan import JobModel, plan_job
from hybrid_opt.job.records import PHASES, Job, Phase
from hybrid_opt.robust.squeeze import SqueezeSettings

__all__ = ["PHASES", "Job", "JobModel", "Phase", "SqueezeSettings", "plan_job"]
