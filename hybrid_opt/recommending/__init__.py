"""The carry to run: chosen from a drivable front, compared with the hand-made one, explained.

choice: the carry that a wish names, the knee of the front without one. comparison: another path,
and whole fronts, at the same force. recommendation: all of it as one record, with how hard to
press.
"""
