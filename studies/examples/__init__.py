"""A way to learn the library: numbered programs of about ten lines. docs/reference/library.md lists
them.

Run them from the repository's root, or from a folder into which `python -m studies.examples FOLDER`
copied them, as `python studies/examples/01_evaluate.py`.
"""
