"""Files.

trajectory_file: a carry with its whole cell in one file, and evaluated again from it. json_records:
records as JSON. files: atomic writes.
"""
