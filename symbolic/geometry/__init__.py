"""Collision shapes.

pieces, meshes, bodies, scene: what there is. pairs: what is checked, and why not the rest.
clearance, covers, softness: bounds of distances. motion_bounds: bounds between two samples.
"""
