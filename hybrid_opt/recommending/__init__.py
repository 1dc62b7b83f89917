"""The carry to run: chosen from a drivable front, compared with the hand-made one, explained.

wish: what a user asks for. driven_paths: paths that are timed anew at any force or duration.
choice: the carry that a wish names, the knee of the front without one. rival: another path at the
same force, and in the same time. force_table: whole fronts at the same forces. squeeze: how hard to
press. unsure: what to press with if the cell is less sure than stated. recommendation: all of it as
one record.
"""
