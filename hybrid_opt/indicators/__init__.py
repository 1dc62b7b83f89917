"""Figures of fronts.

metrics: hypervolume, IGD, spacing, counts. statistics: medians, rank tests, effect sizes.
attainment: surfaces over replicas. selection: one carry of a front.
"""
