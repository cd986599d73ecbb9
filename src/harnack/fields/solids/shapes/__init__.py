"""Shapes: solids that are given by a few numbers."""
