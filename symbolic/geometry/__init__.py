"""Collision shapes.

pieces, meshes, bodies: what there is. pairs: what is checked, and why not the rest. clearance,
covers, expressions: bounds of distances, and of the motion between two samples.
"""
