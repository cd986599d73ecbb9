"""Sums of waves, such as gyroids."""
