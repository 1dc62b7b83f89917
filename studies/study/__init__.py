"""Stages of a study, what they write, and how a terminal shows it."""
