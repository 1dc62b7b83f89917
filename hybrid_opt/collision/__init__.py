"""Collision checking: python-fcl judges, the compiled bounds decide what it has to judge.

judge: FCL's objects. checker: the verdict on samples. between: on the motion between them. certify:
the proof along a continuous path.
"""
