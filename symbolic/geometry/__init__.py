"""Collision shapes.

pieces, meshes, bodies: what there is. pairs: what is checked, and why not the rest. clearance,
covers, expressions: bounds of distances. motion_bounds: bounds between two samples.
"""
