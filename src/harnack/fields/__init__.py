"""Fields: what f is. One family a folder.

This package exports what all fields share. The fields themselves are names of `harnack`, which
`harnack/__init__.pyi` lists.
"""

from __future__ import annotations

from harnack.fields.capabilities import NO_SHEET, Crossing
from harnack.fields.field import Field, Sample
from harnack.fields.formula import Formula
from harnack.fields.solids.solid import Shape, Solid
from harnack.name_suggestions import names_that_moved

__all__ = ["NO_SHEET", "Crossing", "Field", "Formula", "Sample", "Shape", "Solid"]

__getattr__ = names_that_moved(__name__)
