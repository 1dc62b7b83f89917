"""Evaluation of candidates."""
