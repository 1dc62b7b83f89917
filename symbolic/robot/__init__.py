"""An arm as expressions.

model: Pinocchio's kinematics and dynamics as CasADi functions, through the compiled bridge. arm:
Newton's method along a path. branches: start postures.
"""
