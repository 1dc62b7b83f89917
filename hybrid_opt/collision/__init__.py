"""Collision checking: compiled bounds decide most pairs, python-fcl the others."""
