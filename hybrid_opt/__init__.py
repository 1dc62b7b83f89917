"""Collision checking, the optimisation problem, the searches, their metrics, polish and timing."""
