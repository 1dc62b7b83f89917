"""Simulated carries: does the box stay where the planned forces hold it?

box: the box between pads that are driven. arms: a whole cell under its controllers. reference: its
commands and controllers. scene: both as MJCF.
"""
