"""Collision shapes: pieces, bodies, pairs, clearance bounds, bounds of the motion between."""
