"""Programs to run: `python -m studies.rack` and its siblings, with the cells they need."""
