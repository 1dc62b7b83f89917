"""The description of a dual-arm cell and its physics as CasADi expressions.

records: the data of a cell. path, contact: physics as functions of records. read: readers from
bytes to records. robot, geometry: models of arms and bodies. path_motion, limits: inputs of a
timing. smooth: the polish's program. functions: the compiled functions. Imports run against this
order. No optimiser is called here.
"""
