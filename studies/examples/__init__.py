"""A way to learn the library: a notebook, and numbered programs of at most twenty lines.

Run them from the repository's root, or from a folder into which `dual-arm-carry examples FOLDER`
copied them, as `python studies/examples/01_evaluate.py`.
"""
