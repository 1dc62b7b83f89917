"""Independent work: in this process, in several of this machine, on a Dask cluster.

`job` says what is asked and how answers come back; `serial`, `processes` and `dask_cluster` do it.
"""
