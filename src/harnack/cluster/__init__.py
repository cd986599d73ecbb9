"""Work in parts: on the workers of a Dask cluster, with finished parts kept in a folder.

`packing` makes bytes of an object, and a name from what is in it; `parts` has parts of a task done
and keeps them; `workers` checks that a cluster's workers can do them; `lazy` evaluates fields at
the points of Dask arrays, and `zarr_files` writes what comes of it. Nothing here knows a field or a
picture. Dask is imported only by those who ask for it: `pip install harnack[cluster]`.
"""
