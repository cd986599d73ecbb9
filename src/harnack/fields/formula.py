"""Fields that are defined by a formula f(x, y, z), a Python function of the coordinates. Value,
gradient, error bounds and proofs follow from the formula, because it is evaluated with jets in
place of numbers. A jet holds the ranges (intervals) of a number and of its derivatives. Jets of the
coordinates at a point give the value and gradient of f, with bounds of their rounding. Jets of the
coordinates along a piece of a ray give the ranges of the derivatives of f there, from which steps
along the ray are proved.

The operations of a formula are counted before its kernel is compiled. LLVM's time grows faster than
the number of operations, so a formula that would take minutes first gives a warning, with a remedy.
"""

from __future__ import annotations

import abc
import copy
import dataclasses
import warnings
from typing import TYPE_CHECKING, Any, ClassVar, cast

import drjit as dr

from harnack.arithmetic import Jet
from harnack.arithmetic.operators import Tally, tally_of
from harnack.backend import choose_backend
from harnack.enclosures.samples import Sample
from harnack.fields.evaluator import POINTS, Plan
from harnack.fields.field import Field, Traits
from harnack.fields.formula_evaluator import FormulaEvaluator, FormulaFunction
from harnack.fields.tape_evaluator import recorded_tape, tape_evaluator

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3


# A warning announces a compilation that is expected to take longer than this many seconds.
_SLOW_COMPILE_SECONDS = 10.0


class Formula(Field):
    """A field that is defined by a formula of the coordinates, its method `formula`. The formula is
    evaluated with jets: ranges of a number and of its derivatives, in interval arithmetic. So one
    evaluation gives value, gradient and rounding errors at a point; or, along a ray, proved ranges
    of the derivatives, from which enclosures (bounds of the change of f along the ray) follow
    (`FormulaEvaluator`).

    lipschitz: a proved bound of |grad f| everywhere, for sphere tracing (enclosures="lipschitz");
        None if none is known.
    is_convex: whether f is a convex function, which lies above its tangents.
    literals: the names of attributes whose numbers are literals of kernels, so that other numbers
        compile another kernel. All other numbers are kernel parameters.
    """

    is_convex: bool = False
    # It may use abs, maximum and minimum. Proved steps are long already; trying longer ones takes
    # more samples.
    traits = Traits(is_cheap=True, has_creases=True, over_relaxation=1.0)
    lipschitz: Real | None = None
    literals: ClassVar[tuple[str, ...]] = ()

    @abc.abstractmethod
    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f as a function of the coordinates, which may be jets or Dr.Jit numbers.

        It is written with + - * / ** and the functions of `harnack.arithmetic`. In a product or sum
        with a Dr.Jit number, the coordinate comes first, as in x * radius. In the other order
        Dr.Jit's own operators would refuse jets.
        """

    def formula_on(self, backend: Backend) -> FormulaFunction:
        """The formula with its numbers as kernel parameters of a backend, so that a formula with
        other numbers uses the same compiled kernel."""
        return with_device_numbers(self, backend).formula

    @property
    def tally(self) -> Tally:
        """A summary of the formula's operations: their number, and whether f may jump or is
        steep."""
        return tally_of(self.formula)

    @property
    def may_jump(self) -> bool:
        """Whether the formula uses functions that are not continuous everywhere. Also True if
        nothing is known, because the formula refuses the special numbers with which its operations
        are counted (`Tally`)."""
        return self.tally.may_jump

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> FormulaEvaluator:
        """The evaluator of the formula, with its numbers as kernel parameters of the backend; for a
        long formula, one that interprets it."""
        by_tape = tape_evaluator(self, backend, plan)
        if by_tape is not None:
            return by_tape
        numbers = with_device_numbers(self, backend)
        return FormulaEvaluator(self, numbers.formula, numbers.lipschitz)

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p, by the formula with its Python numbers, which become literals of the
        kernel."""
        return FormulaEvaluator(self, self.formula, self.lipschitz).evaluate(p)


def probe_jets() -> tuple[Jet, Jet, Jet]:
    """Jets of the coordinates of an arbitrary point, with which a new formula is tested."""
    return Jet.at_point(choose_backend("double").Array3f(0.1, 0.2, 0.3))


def warn_if_slow_to_compile(field: Formula) -> None:
    """Warn if the kernel of a formula will take more than about ten seconds to compile. (One that
    can be recorded is interpreted if it is long.)

    On an idle core LLVM took 0.9 s for 11,000 operations, 2.7 s for 32,000, 7.4 s for 53,000 and 30
    s for 100,000. So the time grows about as the number of operations to the power 2.2.
    """
    if recorded_tape(field) is not None:
        return
    operations = tally_of(field.formula).operations
    seconds = 30 * (operations / 1e5) ** 2.2
    if seconds > _SLOW_COMPILE_SECONDS:
        warnings.warn(
            f"the ranges of this formula take about {operations:,} operations, which take about "
            f"{seconds:.0f} s to compile on an idle core, once for each precision: a Field of your "
            "own with a Lipschitz constant compiles in less than a second "
            "(docs/implicit.md, Long formulas)",
            stacklevel=4,  # the warning names the line that makes the field
        )


def with_device_numbers(field: Any, backend: Backend) -> Any:
    """A copy of a field that is a dataclass, for a backend. Attributes that are numbers become
    kernel parameters, which can change without compiling the kernel again; attributes that are
    fields get their formula on the backend (`Formula.formula_on`). Attributes that are named in
    `Formula.literals` are left as they are."""
    other = copy.copy(field)
    literals: tuple[str, ...] = getattr(field, "literals", ())
    for entry in dataclasses.fields(cast("Any", field)) if dataclasses.is_dataclass(field) else ():
        value = getattr(field, entry.name)
        ready = value if entry.name in literals else on_backend(value, backend)
        if ready is not value:
            # The dataclass may be frozen.
            object.__setattr__(other, entry.name, ready)
    return other


def on_backend(value: Any, backend: Backend) -> Any:
    """The value of a field's attribute, ready for the backend. A float, or each float in a tuple,
    becomes a kernel parameter. A field becomes a copy whose formula is that on the backend. All
    else, integers included, is returned unchanged."""
    if isinstance(value, float):
        return dr.opaque(backend.Float, value)
    if isinstance(value, tuple):
        entries = cast("tuple[Any, ...]", value)
        return tuple(on_backend(entry, backend) for entry in entries)
    if isinstance(value, Formula) and type(value).formula_on is Formula.formula_on:
        return with_device_numbers(value, backend)
    if isinstance(value, Field) and hasattr(value, "formula_on"):
        other = copy.copy(value)
        object.__setattr__(other, "formula", cast("Any", value).formula_on(backend))
        return other
    return value
