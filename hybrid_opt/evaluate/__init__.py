"""What a candidate is worth.

evaluation: the verdict that searches call. objectives: what may be minimised. certification: the
proof between samples. time_law: a candidate as a `Carry`. static_hold: the forces at rest, and what
a force says of the payload. functions: the compiled functions behind.
"""
