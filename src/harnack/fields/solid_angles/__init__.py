"""Solid angles of curves, winding numbers of meshes and clouds, and what they are sums of."""
