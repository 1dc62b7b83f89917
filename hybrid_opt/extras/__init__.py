"""What stands around a carry: proposals, calibration, bundles, simulation, sweeps, the live view.

The core imports none of it. The extras `propose`, `sim`, `ros` and `live` of the package install
what they need.
"""
