"""The winding number of triangle meshes, exact or by a tree."""
