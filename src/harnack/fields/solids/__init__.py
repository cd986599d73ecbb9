"""Solids: where a function is negative, and how they are put together."""
