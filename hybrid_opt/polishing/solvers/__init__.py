"""Solvers: what a program is, what comes of it, and one file for each method."""
