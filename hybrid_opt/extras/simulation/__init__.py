"""Simulated carries, which test whether the planned forces hold the box in place.

box: the box between driven pads. hands: the box in gripping hands. arms: a whole cell under its
controllers. reference: commands and controllers of the cell. scene: all of them as MJCF.
"""
