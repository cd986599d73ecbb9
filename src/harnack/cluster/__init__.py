"""Jobs split into tasks that run on the workers of a Dask cluster; results are kept in a folder.

`serialization` turns an object into bytes and computes a digest of its contents; `executor` runs
tasks and keeps their results; `workers` checks that a cluster's workers can run them; `dask_arrays`
evaluates fields at the points of Dask arrays, and `zarr_files` writes the results. Nothing here
knows a field or a picture. Dask is imported only on demand: `pip install harnack[cluster]`.
"""
