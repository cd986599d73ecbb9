"""Sums over points: potentials of oriented points, with and without screening."""
