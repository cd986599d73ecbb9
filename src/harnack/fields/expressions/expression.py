"""A user's own formula as a field."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from harnack.backend.numbers import refuse_derivatives, refuses_derivatives
from harnack.fields.expressions.text import TextFormula
from harnack.fields.formula import Formula, as_jet, probe, warn_of_price

if TYPE_CHECKING:
    from harnack.geometry import Volume


@dataclass(frozen=True, eq=False)
class Expression(Formula):
    """f(x, y, z) as a Python function, written with plain operators and `harnack.sin` and its like.

    function: called with three coordinates while a kernel is being recorded; numbers in it are
        literals of that kernel.
    domain: the volume it is drawn in; None for all of space.
    """

    function: Callable[[Any, Any, Any], Any]
    domain: Volume | None = None
    default_level: float = field(default=0.0, kw_only=True)
    is_convex: bool = field(default=False, kw_only=True)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return self.function(x, y, z)

    def prepare(self, backend: Any) -> Formula:
        del backend
        return self


@refuses_derivatives
def expression(
    function: Callable[[Any, Any, Any], Any] | str,
    *,
    domain: Volume | None = None,
    level: float = 0.0,
    is_convex: bool = False,
) -> Expression:
    """The implicit surface f(x, y, z) = level of a formula of your own.

    function: of three coordinates, written with + - * / **, abs, and the functions `harnack.sin`,
        `cos`, `tan`, `exp`, `log`, `sqrt`, `tanh`, `atan`, `asin`, `acos`, `sinh`, `cosh`,
        `maximum`, `minimum`, `norm`; NumPy's of the same names do too. Or a text, such as
        "x^2 + y^2 = 1 + sin(2*z)", with `max` and `min`; an equation means left - right.
    domain: the volume to draw it in, such as `harnack.Ball()`; None for all of space.
    level: the one drawn when none is asked for.
    is_convex: a promise of yours that the function is convex, as quadrics and norms are: steps
        towards it are longer then. `harnack.testing.check_field` samples it.

        torus = hk.expression(lambda x, y, z: (hk.norm(x, y) - 1) ** 2 + z**2 - 0.1)

    Warns of a formula so long that the first trace takes more than some ten seconds to compile.

    Raises:
        TypeError: function cannot be called with three coordinates, or uses what has no proved
            ranges; domain is no volume.
        NotImplementedError: function uses numbers with derivatives enabled.
        ValueError: level is not finite; a text is no formula.
    """
    if isinstance(function, str):
        function = TextFormula.read(function)
    if not callable(function):
        raise TypeError(
            "function must be callable, such as lambda x, y, z: x * y - z, or a text, such as "
            f'"x * y = z", not {function!r}'
        )
    _check_arguments(function)
    if domain is not None and not callable(getattr(domain, "bounds", None)):
        raise TypeError(f"domain must be a volume, such as harnack.Ball(), not {domain!r}")
    if not math.isfinite(level):
        raise ValueError(f"level must be finite, not {level!r}")
    made = Expression(function, domain, default_level=level, is_convex=is_convex)
    point = probe()
    refuse_derivatives("an expression", as_jet(made.formula(*point), point[0], "expression"))
    warn_of_price(made)
    return made


def _check_arguments(function: Callable[..., Any]) -> None:
    """Raise TypeError for what does not take three coordinates."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # of what is not written in Python nothing may be known
        return
    try:
        signature.bind(0.0, 0.0, 0.0)
    except TypeError:
        raise TypeError(
            "function must take three coordinates, such as lambda x, y, z: x * y - z; this one "
            f"takes {signature}"
        ) from None
