"""Applications around a carry: proposals, calibration, bundles, simulation, sweeps, the live view.

The core imports none of them. The extras `propose`, `sim`, `ros` and `live` of the distribution
install their dependencies.
"""
