"""Runs jobs, split into tasks, on the workers of a Dask cluster, and keeps their results in a
folder. A "job" is an object with methods that compute arrays; a "task" is one call of such a
method; a "worker" is a process of the cluster that runs tasks, which its "scheduler" distributes.

`serialization` turns an object into bytes and computes a hash of its contents. `executor` runs
tasks and stores their results. `workers` checks that the workers of a cluster can run them.
`dask_arrays` evaluates fields at the points of Dask arrays, and `zarr_files` writes the results.
None of these modules depends on fields or pictures. Dask is imported only when it is used: `pip
install harnack[cluster]`.
"""
