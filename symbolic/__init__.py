"""The description of a dual-arm cell and its physics as CasADi expressions; no solver, no files
written."""
