"""The description of a dual-arm cell and its physics as CasADi expressions.

workcell, robot, geometry: what a cell is. physics: what a carry asks of it. smooth: the polish's
program. functions: what is compiled. No optimiser is called here; CONTRIBUTING.md lists what is.
"""
