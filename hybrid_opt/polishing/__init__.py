"""Polishing of Pareto fronts by nonlinear programming on a smooth form of the problem.

`polisher` chooses the polisher of a cell, `front` has its run over one front, `point` the
trust-region loop. docs/explanation/polish.md explains them.
"""
