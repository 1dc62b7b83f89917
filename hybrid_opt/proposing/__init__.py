"""From a problem (robots, payload, start, goal, environment) to a workcell file with a first carry.

`proposal.py` says it in one page: ways to hold the box, a planner's path of the box with both arms
over the closed chain, via-points that the spline reproduces, bounds around them, the evaluator's
verdict.
"""
