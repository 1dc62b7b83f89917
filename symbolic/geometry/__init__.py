"""Collision shapes.

pieces, hulls, bodies: convex pieces of all bodies. pairs: the pairs that are checked, and the
reasons to exclude the others. clearance, covers, expressions, screen: bounds of distances, and of
the motion between two samples.
"""
