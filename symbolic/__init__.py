"""The description of a dual-arm cell and its physics as CasADi expressions.

records: what a cell is. path, contact: what a carry asks of it, as functions of records. read:
bytes to records. robot, geometry: models of arms and bodies. path_motion, limits: what a timing
needs. smooth: the polish's program. functions: what is compiled. Imports run against this order.
No optimiser is called here; CONTRIBUTING.md lists what is.
"""
