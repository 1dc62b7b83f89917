"""Polishing of Pareto fronts by nonlinear programming on a smooth form of the problem.

`polisher` is the entry, `point` has the trust-region loop. docs/explanation/polish.md explains
both.
"""
