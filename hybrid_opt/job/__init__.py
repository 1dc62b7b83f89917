"""A whole job: grip, press, lift, carry, set down, let go. docs/job.md describes it."""
