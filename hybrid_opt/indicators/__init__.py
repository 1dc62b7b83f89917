"""Indicators of fronts.

metrics: hypervolume, IGD, spacing, counts, and bounds of variables that optima lie on. statistics:
medians, rank tests, effect sizes, attainment surfaces over replicas.
"""
