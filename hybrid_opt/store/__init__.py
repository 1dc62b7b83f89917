"""Files.

trajectory_file: a carry with its whole cell in one file. trajectory_figures: what is stored beside
it. replay: a stored carry evaluated again. export: timings for robots. files: atomic writes.
"""
