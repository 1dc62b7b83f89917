"""Independent work: in this process, in several of this machine, on a Dask cluster.

`service` says what is asked and how answers come back, and does it in this process; `processes` and
`dask_cluster` do it elsewhere.
"""
