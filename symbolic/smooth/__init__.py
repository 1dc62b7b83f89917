"""Smooth model of the polish as expressions: rows at samples, rows at points of the path,
separating axes, and limits along a driven path."""
