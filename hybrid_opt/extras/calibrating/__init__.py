"""Calibration of a cell from recorded runs: sensors, payload, friction, forces."""
