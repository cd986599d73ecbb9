"""What a solid is: the points where a function is negative."""

from __future__ import annotations

from harnack.fields.field import Field
from harnack.fields.formula import Formula


class Solid(Field):
    """The points where f <= 0, whose boundary is the level 0.

    lipschitz: a proved bound of |grad f| everywhere, so that f/lipschitz is a bound of the distance
        from outside (Hart 1996, definition 3); None where none is known.
    """


class Shape(Formula, Solid):
    """A solid given by a formula of the coordinates."""
