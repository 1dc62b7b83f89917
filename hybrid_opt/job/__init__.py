"""A whole job: grip, press, lift, carry, set down, let go. docs/explanation/job.md describes it."""
