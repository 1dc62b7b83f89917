"""Recommendation of the carry to run: it is chosen from a drivable front, compared with the
hand-made carry, and explained.

choice: timings of every path as options, each with a duration and a commanded force, and the best
options for a wish. advice: margins at the commanded force, and effects of changes of the cell.
recommendation: one record with the chosen carry, its job, the reasons for it, and other paths at
the same force.
"""
