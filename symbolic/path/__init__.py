"""The box path: its spline, its rotation, its time laws; functions of records alone."""
