"""Smooth model of the polish as expressions: samples, places, separating axes, and driven
points."""
