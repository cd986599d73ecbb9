"""Solids: sets of points where a function f is at most 0, and the operations that combine and move
them."""
