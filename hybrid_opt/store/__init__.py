"""Files, written atomically, and read without trust.

files: atomic writes, frozen records as JSON. trajectory_file: a carry with its whole cell in one
file, and evaluated again from it. bundle_file: a bundle and its manifest.
"""
