"""Simulated carries: whether the planned forces hold the box in place.

box: the box between driven pads. arms: a whole cell under its controllers. reference: its commands
and controllers. scene: both as MJCF.
"""
