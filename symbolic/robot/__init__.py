"""Kinematics and dynamics of an arm as CasADi expressions.

model: Pinocchio's kinematics and dynamics as CasADi functions, through the compiled bridge. arm:
inverse kinematics along a path by Newton's method. branches: start postures.
"""
