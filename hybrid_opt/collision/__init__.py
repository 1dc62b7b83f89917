"""Collision checking: python-fcl judges, the compiled bounds decide what it has to judge."""
