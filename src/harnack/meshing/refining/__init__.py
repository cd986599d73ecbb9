"""Meshes made finer and better: edges cut and turned, vertices moved along the surface."""

from harnack.meshing.refining.refinement import improved, refined, smoothed

__all__ = ["improved", "refined", "smoothed"]
