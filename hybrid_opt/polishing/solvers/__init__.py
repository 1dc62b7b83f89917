"""Solvers: the interface of programs and answers, and one file for each method."""
