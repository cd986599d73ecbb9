"""Meshes whose faces are polygons, flat or not."""
