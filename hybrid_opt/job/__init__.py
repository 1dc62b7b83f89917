"""A whole job: approach, press, lift, carry, set down, release, retreat. docs/explanation/job.md
describes it."""
