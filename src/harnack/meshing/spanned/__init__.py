"""Surfaces that curves span: level sets of angles, which end exactly at their curve."""

from harnack.meshing.spanned.surface import Spanned, spanned_surface

__all__ = ["Spanned", "spanned_surface"]
