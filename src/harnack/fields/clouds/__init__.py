"""Potentials of oriented points."""
