"""Polishing of Pareto fronts by nonlinear programming. docs/polish.md explains it."""
