"""The carry to run: chosen from a drivable front, compared with the hand-made one, explained.

choice: every path as options, each with a duration and a commanded force, and the best options for
a wish. advice: margins at the commanded force, and effects of changes of the cell. recommendation:
one record with all of it, with the job, and with other paths at the same force.
"""
