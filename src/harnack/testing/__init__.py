"""Tests of fields and bounds: for the library's own, and for those that users write.

    from harnack.testing import check_bound, check_field
    check_field(MyField())
    check_bound(MyBound())
"""

from __future__ import annotations

from harnack.testing.bound_contracts import check_bound
from harnack.testing.failures import BrokenPromiseError
from harnack.testing.field_contracts import check_field
from harnack.testing.scaled import Scaled

__all__ = ["BrokenPromiseError", "Scaled", "check_bound", "check_field"]
