"""The functions that are compiled, by who needs them.

candidate: a whole carry from its decision vector. cell: that, postures and collision bounds, for
the evaluator. timing: derivatives along the path, for timings.
"""
