"""Tests of fields and enclosures, of the library and of users.

`check_field(MyField())` samples every promise of a field; `check_enclosure(MyEnclosure)` tries an
enclosure on random functions of every kind, among them the extremal ones. Both raise
`BrokenPromiseError`.
"""

from __future__ import annotations

from harnack.testing.enclosure_contracts import check_enclosure
from harnack.testing.field_contracts import check_field, check_ray_samples
from harnack.testing.violation_search import BrokenPromiseError, mutated_enclosure

__all__ = [
    "BrokenPromiseError",
    "check_enclosure",
    "check_field",
    "check_ray_samples",
    "mutated_enclosure",
]
