"""Constraints of the polish: rows near their bounds, required values and violations; one file per
kind."""
