"""Polishing of Pareto fronts with IPOPT on the smooth problem. docs/polish.md explains it."""
