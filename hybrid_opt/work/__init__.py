"""Carrying out independent tasks: in this process, in several, on a Dask cluster."""
