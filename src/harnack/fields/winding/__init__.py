"""Winding numbers: of triangle meshes, exactly or by a tree, and of oriented points."""
