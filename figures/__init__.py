"""Counterparts of the figures of 'Ray Tracing Harmonic Functions', with measured captions.

`python -m figures` from the project's root remakes docs/figures.md and its pictures.
"""
