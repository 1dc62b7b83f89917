"""Constraints of the polish, one file per kind: rows near their bounds, required values, violated
rows."""
