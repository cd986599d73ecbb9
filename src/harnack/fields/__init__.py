"""Fields: the functions f whose level sets are drawn, with a folder for each family.

This package exports the base classes and helpers of all fields. The fields themselves are names of
`harnack`, which `harnack/__init__.pyi` lists.
"""

from __future__ import annotations

from harnack.fields.capabilities import NO_FACET, JumpCrossing
from harnack.fields.field import Field, Sample
from harnack.fields.formula import Formula
from harnack.fields.solids.solid import FormulaSolid, Solid

__all__ = ["NO_FACET", "Field", "Formula", "FormulaSolid", "JumpCrossing", "Sample", "Solid"]
