"""What a candidate is worth.

evaluation: the verdict that searches call. kernel: what the samples of candidates say, in lanes.
evaluations: verdicts, and what can make a candidate infeasible. objectives: what may be minimised.
explanation: why a candidate is infeasible.
"""
