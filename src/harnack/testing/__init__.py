"""Tests of fields and enclosures, of the library and of users. A field with the function f promises
(states as proved) bounds of f near each point. An enclosure derives from a promise a length of a
ray on which f meets no level. `check_field(MyField())` tests every promise of a field by samples.
`check_enclosure(MyEnclosure)` tests an enclosure on random functions of every kind, including the
extremal ones. Both raise `BrokenPromiseError` if a test fails."""

from __future__ import annotations

from harnack.testing.enclosure_contracts import check_enclosure
from harnack.testing.field_contracts import check_field, check_ray_samples
from harnack.testing.violation_search import BrokenPromiseError

__all__ = [
    "BrokenPromiseError",
    "check_enclosure",
    "check_field",
    "check_ray_samples",
]
