"""A user's own formula f(x, y, z) as a field, whose level sets are drawn. The formula is a Python
function of the coordinates, or a text such as "x^2 + y^2 + z^2 = 1". A text is parsed to a syntax
tree of Python's `ast`, the tree is checked node by node (a node is an operation, a number, a name
or a call of a function), and then evaluated; it is never run as Python."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol, cast

import drjit as dr
import numpy as np

from harnack import arithmetic
from harnack.arithmetic.operators import FormulaNumber
from harnack.backend.validation import as_finite, check_no_derivatives, flag
from harnack.fields.formula import Formula, probe_jets, warn_if_slow_to_compile
from harnack.fields.formula_evaluator import as_jet
from harnack.fields.tape_evaluator import extent_of_formula, recorded_tape
from harnack.fields.vm_formulas import VmFormula
from harnack.geometry import Volume
from harnack.name_suggestions import did_you_mean

if TYPE_CHECKING:
    import os

_COORDINATES = ("x", "y", "z")
_CONSTANTS: Mapping[str, float] = MappingProxyType({"pi": math.pi, "e": math.e})
_FUNCTIONS: Mapping[str, Callable[..., Any]] = MappingProxyType(
    {
        **{name: getattr(arithmetic, name) for name in (
            "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log",
            "sqrt", "norm", "atan2",
        )},
        "ln": arithmetic.log, "abs": arithmetic.absolute,
        "max": arithmetic.maximum, "min": arithmetic.minimum,
    }
)  # fmt: skip
# Functions of more than one argument: the smallest and the largest number of arguments.
_ARGUMENT_COUNTS = {"max": (2, math.inf), "min": (2, math.inf), "norm": (2, 3), "atan2": (2, 2)}
_OPERATORS: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = MappingProxyType(
    {
        ast.Add: lambda a, b: a + b,
        ast.Sub: lambda a, b: a - b,
        ast.Mult: lambda a, b: a * b,
        ast.Div: lambda a, b: a / b,
    }
)
# The largest number of characters of a text, and of operations that are nested in each other.
# Python allows about 1000 nested calls.
_MAX_LENGTH, _MAX_DEPTH = 1_000_000, 200
_TOO_DEEP = (
    f"more than {_MAX_DEPTH} operations are within each other, as in a long sum: bracket its halves"
)


@dataclass(frozen=True)
class TextFormula:
    """A formula f(x, y, z) that is given as a text. An object of this class is called like any
    function of three coordinates and of the formula's parameters, by name.

    text: it is made of + - * / ^ (or **), brackets, numbers, x, y, z, pi, e, parameters and the
        functions `_FUNCTIONS`. An equation "left = right" means left - right.
    tree: the text's syntax tree, which is evaluated node by node. It is never run as Python, so
        that texts from untrusted sources do no harm.
    """

    text: str
    tree: ast.expr

    @classmethod
    def parse(cls, text: str, parameters: Iterable[str] = ()) -> TextFormula:
        """Parse a text to a formula.

        parameters: the names of its parameters.

        Raises:
            ValueError: the text is not a formula (the message states the position and the mistake);
                or a parameter is not in it; or the name of a parameter is already that of a
                function, a constant or a coordinate.
        """
        parameters = tuple(parameters)
        if len(text) > _MAX_LENGTH:
            raise ValueError(f"a formula has at most {_MAX_LENGTH:,} characters, not {len(text):,}")
        # A character that no formula has, or a number that is not decimal, such as 0x1F.
        unknown = re.search(r"[^A-Za-z0-9\s.,+*/^()=<>!-]|\b0[xob]", text, re.IGNORECASE)
        if unknown:
            raise _formula_error(text, f"{unknown[0]!r} has no meaning here")
        # Split at each = that is not part of <=, >=, != or ==.
        sides = [cls._parse_side(text, side) for side in re.split(r"(?<![<>=!])=(?!=)", text)]
        if len(sides) > 2:
            raise _formula_error(text, "more than one = sign")
        tree = sides[0] if len(sides) == 1 else ast.BinOp(sides[0], ast.Sub(), sides[1])
        _check_tree(text, tree, parameters)
        names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        for name in parameters:
            if name in _FUNCTIONS or name in (*_COORDINATES, *_CONSTANTS):
                raise ValueError(f"{name!r} has a meaning in formulas: call a parameter otherwise")
            if name not in names:
                raise ValueError(f"there is no parameter {name!r} in the formula {text!r}")
        return cls(text, tree)

    @staticmethod
    def _parse_side(text: str, side: str) -> ast.expr:
        """Parse one side of an equation to a syntax tree.

        text: the whole formula, for messages.
        side: the side, as a text.

        Raises:
            ValueError: the side is not an expression; the message guesses the mistake.
        """
        try:
            return ast.parse(" ".join(side.replace("^", "**").split()), mode="eval").body
        except (RecursionError, MemoryError):
            raise _formula_error(text, _TOO_DEEP) from None
        except (SyntaxError, ValueError):
            pass
        # Guess the mistake: a function without brackets, as in "sin x", or a missing *, as in "2
        # x".
        bare = re.search(rf"\b({'|'.join(_FUNCTIONS)})\s+[A-Za-z0-9]", side)
        if bare:
            raise _formula_error(text, f"the argument of {bare[1]} stands in brackets")
        # A number (but not the 2 of atan2) or a closing bracket before a name or an opening
        # bracket; or two names with a space between them.
        missing = re.search(r"(?:[0-9](?<!atan2)|\))\s*[A-Za-z(]|[xyz)]\s+[A-Za-z0-9(]", side)
        hint = f"is a * missing at {missing[0]!r}" if missing else "an operator or bracket is amiss"
        raise _formula_error(text, hint)

    def __call__(self, x: Any, y: Any, z: Any, **numbers: Any) -> Any:
        """The value of the formula at coordinates of any kind: numbers, NumPy or Dr.Jit arrays, or
        numbers with proved ranges. numbers: those of the parameters.

        Raises:
            ValueError: a constant part divides by zero, is too large, or is not real.
        """
        try:
            with np.errstate(all="ignore"):  # in constants; a result that is not finite is refused
                return _value(self.tree, {"x": x, "y": y, "z": z, **_CONSTANTS, **numbers})
        except ZeroDivisionError:
            raise _formula_error(self.text, "it divides by zero") from None
        except OverflowError:
            raise _formula_error(self.text, "a number in it is too large, or not real") from None

    def __repr__(self) -> str:
        return self.text


def looks_like_formula(text: str) -> bool:
    """Whether a text looks like a formula: it has an equals sign, a power, a product or a
    bracket."""
    return any(sign in text for sign in ("=", "^", "*", "("))


def _formula_error(text: str, why: str) -> ValueError:
    """The error which says that a text is not a formula, and why."""
    shown = text if len(text) <= 80 else text[:77] + "..."
    return ValueError(
        f'{shown!r} is no formula in x, y and z: {why}; write it as in "x^2 + y^2 = 1 + sin(2*z)"'
    )


def _check_tree(text: str, node: ast.expr, parameters: Iterable[str], depth: int = 0) -> None:
    """Raise ValueError if a syntax tree contains anything that is not allowed in a formula, or an
    unknown name.

    text: the formula, for messages.
    node: the root of the tree.
    parameters: the names of the formula's parameters.
    depth: the number of operations around the node.
    """
    if depth > _MAX_DEPTH:
        raise _formula_error(text, _TOO_DEEP)
    # An operation with two operands; then signs, names, numbers, calls; all else is refused.
    if isinstance(node, ast.BinOp):
        if not isinstance(node.op, ast.Pow) and type(node.op) not in _OPERATORS:
            raise _formula_error(text, "the operators are + - * / ^")
        _check_tree(text, node.left, parameters, depth + 1)
        _check_tree(text, node.right, parameters, depth + 1)
    elif isinstance(node, ast.UnaryOp):
        if not isinstance(node.op, ast.USub | ast.UAdd):
            raise _formula_error(text, "the signs are + and -")
        _check_tree(text, node.operand, parameters, depth + 1)
    elif isinstance(node, ast.Name):
        names = (*_COORDINATES, *_CONSTANTS, *parameters)
        if node.id in _FUNCTIONS:
            raise _formula_error(
                text, f"the argument of {node.id} stands in brackets, and a power behind them"
            )
        if node.id not in names:
            raise _formula_error(
                text,
                f"{node.id!r} is unknown, there are {', '.join(names)} and {', '.join(_FUNCTIONS)}"
                f"{did_you_mean(node.id, (*names, *_FUNCTIONS))}; of a number of your own, give "
                f'parameters={{"{node.id}": 1.0}}',
            )
    elif isinstance(node, ast.Constant):
        value = node.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise _formula_error(text, f"{value!r} is no real number")
        if not math.isfinite(_as_float(text, value)):
            raise _formula_error(text, "a number is too large")
    elif isinstance(node, ast.Call):
        _check_call(text, node, parameters, depth + 1)
    elif isinstance(node, ast.Compare):
        raise _formula_error(text, "an equation has one = between its two sides")
    else:
        raise _formula_error(text, f"{ast.unparse(node)!r} is not understood")


def _as_float(text: str, value: float) -> float:
    """The number `value`, which stands in a formula, as a float.

    text: the formula, for the message.

    Raises:
        ValueError: the number is too large.
    """
    try:
        return float(value)
    except OverflowError:
        raise _formula_error(text, "a number is too large") from None


def _check_call(text: str, node: ast.Call, parameters: Iterable[str], depth: int) -> None:
    """Raise ValueError if a call in a syntax tree is not allowed in a formula: the function is
    unknown, the number of arguments is wrong, or an argument is not allowed.

    text: the formula, for messages.
    node: the call.
    parameters: the names of the formula's parameters.
    depth: the number of operations around the arguments.
    """
    name = node.func.id if isinstance(node.func, ast.Name) else ast.unparse(node.func)
    # Brackets after a number or a parameter, as in x(y + 1), mean a missing *.
    if name in (*_COORDINATES, *_CONSTANTS, *parameters) or not isinstance(node.func, ast.Name):
        raise _formula_error(text, f"is a * missing after {name!r}")
    if name not in _FUNCTIONS:
        names = ", ".join(_FUNCTIONS)
        hint = did_you_mean(name, _FUNCTIONS)
        raise _formula_error(text, f"{name!r} is no known function, there are {names}{hint}")
    # Most functions take one argument.
    fewest, largest = _ARGUMENT_COUNTS.get(name, (1, 1))
    if node.keywords or not fewest <= len(node.args) <= largest:
        count = (
            f"{fewest} or {largest}"
            if fewest < largest < math.inf
            else f"{fewest}{' or more' * (largest == math.inf)}"
        )
        plural = "s" if largest > 1 else ""
        raise _formula_error(text, f"{name} takes {count} argument{plural}, not {len(node.args)}")
    for argument in node.args:
        _check_tree(text, argument, parameters, depth)


def _value(node: ast.expr, names: Mapping[str, Any]) -> Any:
    """The value of a syntax tree that `_check_tree` accepted.

    node: the root of the tree.
    names: the values of coordinates, constants and parameters, by their names.

    Raises:
        OverflowError: a constant part of the tree is infinite or NaN.
    """
    value = _evaluate_node(node, names)
    if isinstance(value, float) and not math.isfinite(value):
        raise OverflowError
    return value


def _evaluate_node(node: ast.expr, names: Mapping[str, Any]) -> Any:
    """The value of a node of a syntax tree that `_check_tree` accepted, from the values of its
    operands. It may be infinite or NaN, which `_value` refuses for constants.

    names: the values of coordinates, constants and parameters, by their names.
    """
    match node:
        case ast.BinOp(left, ast.Pow(), right):
            base, exponent = _value(left, names), _value(right, names)
            return _power(base, exponent)
        case ast.BinOp(left, op, right):
            return _OPERATORS[type(op)](_value(left, names), _value(right, names))
        case ast.UnaryOp(ast.USub(), operand):
            return -_value(operand, names)
        case ast.UnaryOp(_, operand):
            return _value(operand, names)
        case ast.Name(name):
            return names[name]
        case ast.Constant(value):
            # An int becomes a float, too.
            return float(value)  # pyright: ignore
        case ast.Call(ast.Name(name), arguments):
            return _FUNCTIONS[name](*(_value(argument, names) for argument in arguments))
        case _:
            raise AssertionError(f"{node} was checked")


def _power(base: Any, exponent: Any) -> Any:
    """base^exponent. An exponent that is a whole number is turned into an int, because powers with
    an int as exponent are also defined for negative bases.

    Raises:
        OverflowError: both are constants, and the power is complex, or larger than the largest
            float.
    """
    if isinstance(exponent, float) and exponent.is_integer():
        exponent = int(exponent) if abs(exponent) < 2**31 else exponent
    if isinstance(base, float) and isinstance(exponent, int | float):
        result: Any = base ** float(exponent)
        if isinstance(result, complex):
            raise OverflowError
        return result
    return base**exponent


@dataclass(frozen=True, eq=False)
class Expression(Formula):
    """A field whose function f(x, y, z) is a Python function of the coordinates. It is written with
    plain operators and the functions of `harnack.math`.

    function: takes three coordinates. It is called while a kernel is being recorded, and numbers in
        it become literals of that kernel. A text is parsed to a `TextFormula`.
    domain: the volume in which f is drawn; None for all of space.
    numbers: further arguments of the function, or parameters of a text, by name.
    default_level: the level that is drawn by default.
    is_convex: whether f is a convex function.

    Raises:
        The errors of `expression`.
    """

    literals = ("default_level",)
    traits = dataclasses.replace(Formula.traits, differentiable_arguments=("numbers",))

    function: Callable[..., Any]
    domain: Volume | None = None
    numbers: Mapping[str, float] = field(default_factory=dict[str, float])
    default_level: float = field(default=0.0, kw_only=True)
    is_convex: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        """Check all arguments; `function` becomes a function if it is a text."""
        function = cast("Any", self.function)
        if isinstance(function, str):
            function = TextFormula.parse(function, self.numbers)
        if not callable(function):
            raise TypeError(
                "function must be callable, such as lambda x, y, z: x * y - z, or a text, such as "
                f'"x * y = z", not {function!r}'
            )
        _check_arguments(function, self.numbers)
        object.__setattr__(self, "function", function)  # the dataclass is frozen
        numbers = {name: as_finite(number, name) for name, number in self.numbers.items()}
        object.__setattr__(self, "numbers", MappingProxyType(numbers))
        object.__setattr__(self, "default_level", as_finite(self.default_level, "level"))
        object.__setattr__(self, "is_convex", flag(self.is_convex, "is_convex"))
        if recorded_tape(self) is not None:
            return
        # What cannot be recorded is evaluated once at an arbitrary point, as a test: this raises
        # the errors that the docstring of `expression` names.
        point = probe_jets()
        value = as_jet(self.formula(*point), point[0], "expression")
        check_no_derivatives("an expression", value)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        numbers: dict[str, Any] = dict(self.numbers)
        if isinstance(x, FormulaNumber):  # in a product, Dr.Jit's own operators would refuse it
            numbers = {
                name: x.coerce(number) if dr.is_array_v(type(number)) else number
                for name, number in numbers.items()
            }
        return self.function(x, y, z, **numbers)

    def __getstate__(self) -> dict[str, Any]:
        # A read-only view of a dictionary is not copied and not pickled.
        return {**vars(self), "numbers": dict(self.numbers)}

    def __setstate__(self, state: Any) -> None:
        super().__setstate__({**state, "numbers": MappingProxyType(state["numbers"])})

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        if self.domain is not None:
            return self.domain
        return extent_of_formula(self, levels)


class ExpressionFunction(Protocol):
    """The type of `expression`: a function that also reads formulas from files."""

    def __call__(
        self,
        function: Callable[..., Any] | str,
        *,
        parameters: Mapping[str, float] | None = None,
        domain: Volume | None = None,
        level: float = 0.0,
        is_convex: bool = False,
        **numbers: float,
    ) -> Expression: ...

    def from_vm(
        self,
        path: str | os.PathLike[str],
        *,
        domain: Volume | None = None,
        level: float = 0.0,
    ) -> Expression:
        """See `_from_vm`."""
        ...


def _from_vm(
    path: str | os.PathLike[str], *, domain: Volume | None = None, level: float = 0.0
) -> Expression:
    """The implicit surface of a formula in a file of the format .vm, which libfive and Fidget
    write. Such formulas may have many thousands of instructions: they are interpreted, and not
    compiled.

    path: the file.
    domain, level: as for `expression`.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no formula; the message names the line.
        TypeError: domain is not a volume.
    """
    return Expression(VmFormula.read(path), domain, default_level=level)


def _with_files(function: Callable[..., Expression]) -> ExpressionFunction:
    """The function `expression` with `from_vm` as an attribute."""
    result: Any = function
    result.from_vm = _from_vm
    return result


@_with_files
def expression(
    function: Callable[..., Any] | str,
    *,
    parameters: Mapping[str, float] | None = None,
    domain: Volume | None = None,
    level: float = 0.0,
    is_convex: bool = False,
    **numbers: float,
) -> Expression:
    """The implicit surface f(x, y, z) = level of a user's own formula, as a field. The formula is a
    Python function or a text; a text may have parameters, numbers by name.

    function: a Python function of three coordinates. It is written with + - * / **, abs, and the
        functions of `harnack.math`: `sin`, `cos`, `tan`, `exp`, `log`, `sqrt`, `tanh`, `atan`,
        `atan2`, `asin`, `acos`, `sinh`, `cosh`, `maximum`, `minimum`, `norm`. NumPy's functions of
        the same names work too. Or a text, such as "x^2 + y^2 = 1 + sin(2*z)", in which maximum and
        minimum are `max` and `min`; an equation means left - right.
    parameters: numbers by their names, such as {"a": 2.0} for the text "x^2 + y^2 = a"; None for no
        parameters. A Python function takes them as further arguments: lambda x, y, z, a: ... They
        may be Dr.Jit numbers with derivatives, by which values, gradients and hits are then
        differentiated.
    domain: the volume in which the surface is drawn, such as `harnack.Ball()`; None for all of
        space.
    level: the level that is drawn by default.
    numbers: the same as parameters, as arguments: hk.expression("x^2 + y^2 = a", a=2.0).
    is_convex: your promise that the function is convex, as quadrics and norms are. Then steps
        towards the surface are longer. `harnack.testing.check_field` tests the promise at samples.

    A formula of more than some forty operations is interpreted, so that it may have thousands. One
    that uses arrays of Dr.Jit is compiled, with a warning if that takes more than about ten
    seconds.

    Raises:
        TypeError: function cannot be called with three coordinates, or uses operations without
            proved ranges; domain is not a volume.
        NotImplementedError: function uses other numbers with derivatives enabled.
        ValueError: level is not finite; a text is not a formula, or lacks a parameter.
    """
    if parameters is not None and not isinstance(cast("Any", parameters), Mapping):
        raise TypeError(f'parameters are numbers by name, such as {{"a": 2}}, not {parameters!r}')
    values = {**(parameters or {}), **numbers}
    for name, value in values.items():
        if isinstance(cast("Any", value), Volume):
            raise TypeError(
                f"{name} is a volume and no number of the formula: the volume in which it is drawn "
                f"is domain={type(value).__name__}(...), and the clip of a picture or trace is an "
                "argument of that"
            )
    if isinstance(function, str):
        function = TextFormula.parse(function, values)
    check_no_derivatives("expression", function, domain, level)
    field = Expression(function, domain, values, default_level=level, is_convex=is_convex)
    warn_if_slow_to_compile(field)
    return field


def _check_arguments(function: Callable[..., Any], numbers: Mapping[str, float]) -> None:
    """Raise TypeError if a function cannot be called with three coordinates and numbers by name. A
    function whose signature is not known is accepted."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # of what is not written in Python nothing may be known
        return
    try:
        signature.bind(0.0, 0.0, 0.0, **numbers)
    except TypeError:
        names = "".join(f", {name}" for name in numbers)
        raise TypeError(
            "function must take three coordinates, such as lambda x, y, z: x * y - z, and the "
            f"numbers by name, here (x, y, z{names}); this one takes {signature}"
        ) from None
