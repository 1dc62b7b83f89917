"""The carry to run: chosen from a drivable front, compared with the hand-made one, explained.

choice: every path as options of a duration and a force to command, and the best of them for a
wish. advice: margins at the commanded force, and what changes of the cell would change.
recommendation: all of it as one record, with the job, and other paths at the same force.
"""
