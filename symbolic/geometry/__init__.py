"""Collision shapes of all bodies, the pairs that are checked, and bounds of distances and motions.

pieces, hulls, bodies: convex pieces of all bodies. pairs: the pairs that are checked, and the
reasons to exclude the others. clearance, covers, expressions, screen: lower bounds of distances,
and upper bounds of the motion between two samples.
"""
