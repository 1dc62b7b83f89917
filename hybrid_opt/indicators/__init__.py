"""Figures of fronts.

metrics: hypervolume, IGD, spacing, counts, bounds that decide. statistics: medians, rank tests,
effect sizes, surfaces over replicas.
"""
