"""What a candidate is worth.

evaluation: the verdict that searches call, and what can make a candidate infeasible. kernel: what
the samples of candidates say, in lanes. objectives: what may be minimised. explanation: why a
candidate is infeasible.
"""
