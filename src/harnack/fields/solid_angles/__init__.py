"""Solid angles of curves, winding numbers of meshes and point clouds, and the sums over edges,
triangles and dipoles from which they are computed."""
