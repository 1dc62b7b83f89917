"""Files: atomic writes, and checked reading.

files: atomic writes, frozen records as JSON. trajectory_file: a carry with its whole cell in one
file, and its re-evaluation. bundle_file: a bundle and its manifest.
"""
