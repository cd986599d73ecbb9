"""Distances to closed triangle meshes."""
