"""Arithmetic with fields: the operators + - * / of fields and numbers, which make new fields. They
are methods of the base class of `harnack.fields.Field`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from harnack.name_suggestions import with_article

if TYPE_CHECKING:
    from harnack.fields.field import Field


class FieldOperators:
    """The operators of fields. f, g are fields, and c is a number of Python or NumPy, or a Dr.Jit
    number. A Dr.Jit number stands behind the field, as in f * c: Dr.Jit refuses it in front.

    `f + g`, `f - g`, `f + c`, `c - f`, `-f`, `c * f`, `f / c`: a weighted sum of fields
    (`harnack.fields.FieldSum`). `f * g`: a product (`harnack.fields.FieldProduct`).

    Solids, which are sets, have operators of their own.
    """

    __array_ufunc__ = None  # NumPy numbers leave the operation to the field

    def __add__(self, other: Any) -> Field:
        from harnack.fields.combining import added

        return added(self, other)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Field:
        from harnack.fields.combining import added

        return added(self, other, sign=-1.0)

    def __rsub__(self, other: Any) -> Field:
        from harnack.fields.combining import added, multiplied

        return added(multiplied(self, -1.0), other)

    def __neg__(self) -> Field:
        from harnack.fields.combining import multiplied

        return multiplied(self, -1.0)

    def __mul__(self, other: Any) -> Field:
        from harnack.fields.combining import has_own_operators, make_product, multiplied
        from harnack.fields.field import Field

        if not isinstance(other, Field):
            return multiplied(self, other)
        if has_own_operators(other):
            return cast("Any", NotImplemented)
        return make_product(cast("Any", self), other)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Field:
        from harnack.fields.combining import divided

        return divided(self, other)

    def _refuse_operator(self, *operands: Any) -> Any:
        """Refuse an operator that fields do not have.

        Raises:
            TypeError: always.
        """
        name = with_article(type(cast("Any", self)).__name__)
        raise TypeError(
            f"{name} is a function of space: fields and numbers are combined by +, - and *, and "
            "fields are divided by numbers; all else is written as one formula, "
            "harnack.expression(lambda x, y, z: ...); and solids, which harnack.solid makes of "
            "fields, are combined by |, & and -"
        )

    __rtruediv__ = __pow__ = __rpow__ = __abs__ = _refuse_operator
    __lt__ = __le__ = __gt__ = __ge__ = _refuse_operator
