"""Polishing of Pareto fronts by nonlinear programming on a smooth form of the problem: `polisher`
begins, `point` has the loop. docs/explanation/polish.md explains it."""
