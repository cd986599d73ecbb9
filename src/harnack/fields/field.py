"""What a field is: the interface between functions and the rest of the library.

A field gives, in one evaluation, its value, its gradient and what it promises near the point
(`harnack.enclosures.promises`). Promises must be *true*: every step that the tracer takes rests on
them. `harnack.testing.check_field` tests whether a field fulfills this interface.
"""

from __future__ import annotations

import abc
import inspect
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend.arrays import as_kernel_parameters
from harnack.backend.tensors import accepts_tensors
from harnack.backend.validation import (
    check_no_derivatives,
    format_short,
    is_same_or_equal,
    make_read_only,
    no_derivatives,
)
from harnack.cluster.dask_arrays import accepts_dask_arrays
from harnack.enclosures import BoundedLaplacian, HarmonicBall, Lipschitz, TaylorRemainder
from harnack.fields.batch_evaluation import accepts_numpy_points, evaluate_points
from harnack.fields.capabilities import CommonBoundary, JumpSurface, PatchUnion, VariableAccuracy
from harnack.fields.samples import Ray, RaySample, Sample, space_scaled, validate_samples
from harnack.geometry.volume import check_volume

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.geometry import Volume
    from harnack.tree.empty_space import OccupancyGrid


__all__ = [
    "BoundedLaplacian",
    "EvaluateOnly",
    "Field",
    "HarmonicBall",
    "Lipschitz",
    "Ray",
    "RaySample",
    "Sample",
    "TaylorRemainder",
    "space_scaled",
]

# Methods that only solids have.
_SOLID_METHODS = frozenset(
    (
        "translated",
        "rotated",
        "scaled",
        "transformed",
        "twisted",
        "tapered",
        "offset",
        "shell",
        "blended",
    )
)


class Field(JumpSurface, PatchUnion, VariableAccuracy, CommonBoundary, abc.ABC):
    """A scalar function on R^3 whose level sets can be traced with a proof.

    Subclasses define `evaluate`; the class attributes are defaults that an instance may override.
    The base classes have what only some fields can do (jumps across sheets, parts, detail, curves
    at which level sets end); their defaults are those of a field that cannot.
    """

    period: ClassVar[float | None] = None
    """None for a real-valued function, else f is continuous modulo this number (angle-valued)."""

    default_level: float = 0.0
    """The level drawn when none is asked for."""

    over_relaxation: float = 1.4
    """The over-stepping factor (`Surface.overstep`) that needs the fewest evaluations, by
    experiment; at least 1."""

    domain: Volume | None = None
    """Where the field may be evaluated and is drawn; None for all of space. Rays are clipped to
    it, and what a sample promises need only hold for p in it. As it is convex, a ray from p stays
    in it up to where it is clipped; `Lipschitz` and `TaylorRemainder` need not hold beyond."""

    is_global: bool = False
    """Whether f and its promises are right in all of space, so that `domain` is only where it is
    drawn."""

    min_wavelength: float | None = None
    """The shortest wavelength of f that matters, where it is known: code that samples f in cells
    makes them smaller than this."""

    is_cheap: bool = False
    """Whether a sample takes so little time that a lane needs longer to fetch another ray from a
    queue (`tracer.prepared.trace_queued`), by experiment."""

    has_creases: bool = False
    """Whether the gradient jumps somewhere, as it does where the surfaces of a union meet."""

    def __new__(cls, *given: Any, **named: Any) -> Self:
        """Refuse arguments with derivatives enabled, unless the class defines `parameters`."""
        if cls.has_no_parameters():
            check_no_derivatives(cls.__name__, given, named)
        return super().__new__(cls)

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Wrap methods of the subclass: the result of `evaluate` is checked, `hessian` takes NumPy
        arrays too, and class methods that make a field refuse derivatives as the constructor
        does."""
        super().__init_subclass__(**kwargs)
        if "__repr__" not in vars(cls):  # a dataclass would write out all numbers
            cls.__repr__ = Field.__repr__
        for name, own in list(vars(cls).items()):
            if isinstance(own, classmethod) and not name.startswith("_"):
                checked_maker = no_derivatives(cast("Any", own).__func__)
                setattr(cls, name, classmethod(checked_maker))
        if "evaluate" in vars(cls):
            checked: Any = validate_samples(cls.evaluate)
            cls.evaluate = checked
            if "sample_ray" not in vars(cls):  # a base's might not call this `evaluate`
                cls.sample_ray = Field.sample_ray
        if "hessian" in vars(cls):
            general: Any = accepts_numpy_points(cls.hessian)
            cls.hessian = general

    def __copy__(self) -> Self:
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        return other

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Of a deep copy, or of a field that was pickled. NumPy forgets that arrays are not to be
        written to, which would change nothing of what was computed from them."""
        vars(self).update(state)
        make_read_only(state)

    def __repr__(self) -> str:
        """The call that makes the field, of arguments it still has, with arrays by their shapes."""
        given = inspect.signature(type(self).__init__).parameters
        own = {key.removeprefix("_"): value for key, value in vars(self).items()}
        said = [
            f"{key}={format_short(own[key])}"
            for key, one in given.items()
            if key in own and not is_same_or_equal(own[key], one.default)
        ]
        return f"{type(self).__name__}({', '.join(said)})"

    def __getattr__(self, name: str) -> Any:
        """For methods that only solids have, the error says how to make a solid of the field."""
        own = f"{type(self).__name__!r} object has no attribute {name!r}"
        if name in _SOLID_METHODS:
            own += ": make a solid of the field first, by harnack.solid(field, below=level)"
        raise AttributeError(own)

    def _is_no_number(self, *others: Any) -> Any:
        """Arithmetic and comparisons are refused. `Solid` defines -, and all fields keep ==."""
        raise TypeError(
            f"a {type(self).__name__} is a function of space, which is not computed with as "
            "numbers are: the level c of 2 f is the level c/2 of f, sums and products are written "
            "as one formula, harnack.expression(lambda x, y, z: ...), and solids, which "
            "harnack.solid makes of fields, are combined by |, & and -"
        )

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = _is_no_number
    __truediv__ = __rtruediv__ = __pow__ = __rpow__ = __neg__ = __abs__ = _is_no_number
    __lt__ = __le__ = __gt__ = __ge__ = _is_no_number

    @abc.abstractmethod
    def evaluate(self, p: Vec3) -> Sample:
        """Value, gradient and promises at p, a Dr.Jit 3-vector of any backend and precision.

        Called while a loop is being recorded: use `drjit` functions of p, and no Python branches on
        its values.
        """

    def prepare(self, backend: Backend) -> Field:
        """A field equal to this one whose data lie on the backend. Each call of the library asks
        for it once.

        The default suits fields that hold only Python numbers.
        """
        del backend
        return self

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A volume proved to hold every point of the level sets; None where none is known.

        It may be smaller than `domain`. With it a ray without an end can be a proved miss.
        """
        del levels
        return self.domain

    def occupied_cells(self, levels: tuple[float, ...]) -> OccupancyGrid | None:
        """A grid of cells outside of which there are proved to be no points of the level sets; None
        where none is known. First hits jump across empty cells: for fields that are expensive to
        evaluate.

        For a field with sheets, no lift has a level in the empty cells, whatever its jumps.
        """
        del levels
        return None

    def for_ray_count(self, count: int) -> Field:
        """This field, to be traced by so many rays: a field may take longer to prepare where that
        pays for them. The same object for the same count, so that nothing is prepared twice. The
        default is the field itself."""
        del count
        return self

    @property
    def is_steep(self) -> bool:
        """Whether |grad f| may have no bound in a bounded box, or none that says how much f changes
        within the rounding of coordinates, so that f may bend by any amount within the tolerance of
        a hit. The tracer then looks at f beyond the hit."""
        return False

    def gradient_change_bound(self, p: Vec3, radius: Real) -> Real:
        """A proved bound of |grad f(y) - grad f(p)| for all y with |y - p| <= radius; infinite, the
        default, where none is known. Proofs that a mesh has the surface's topology use it."""
        return 0 * p.x + radius + dr.inf

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError if a level is one that no surface can have. The default accepts all."""
        del levels

    def parameters(self) -> tuple[Any, ...]:
        """Dr.Jit arrays that the value depends on and that may carry derivatives.

        A class that does not define this method has none: its constructor refuses them.
        """
        return ()

    @classmethod
    def has_no_parameters(cls) -> bool:
        """Whether the class names no `parameters`, so that derivatives by any would be dropped."""
        return cls.parameters is Field.parameters

    def refuse_hidden_parameters(self) -> None:
        """Raise NotImplementedError if numbers that the field does not name in `parameters`, such
        as
        those that its formula refers to, have derivatives enabled: they would be dropped."""
        if self.has_no_parameters():
            kind = type(self)
            is_own = not kind.__module__.startswith("harnack.")
            check_no_derivatives(kind.__name__, vars(self), kind.evaluate if is_own else None)

    def differentiable_value(self, p: Vec3) -> Real:
        """f(p) as an expression that Dr.Jit can differentiate in p and in the field's parameters.

        In p it is of first order: the value, with the stated gradient as its derivative. So no
        derivative passes through `evaluate`, which may run a recorded loop, and at ties of f's
        formula the derivative is the stated gradient. A field with parameters overrides it if
        `evaluate` cannot be differentiated in both modes.
        """
        if any(dr.grad_enabled(one) for one in self.parameters()):
            return self.evaluate(p).value
        self.refuse_hidden_parameters()
        at = dr.detach(p)
        with dr.suspend_grad():
            sample = self.evaluate(at)
        gradient = as_kernel_parameters(
            sample.gradient
        )  # a literal 0 would have no derivative in Dr.Jit
        return dr.replace_grad(sample.value, dr.dot(gradient, p - at))

    @accepts_dask_arrays("points")
    @accepts_tensors
    def value(self, points: Any, *, precision: Precision = "single") -> Any:
        """f at points (n, 3): (n,); at a single point (3,): a number.

        A Dr.Jit 3-vector gives a Dr.Jit array, and a tensor (n, 3) one of shape (n,), with
        derivatives with respect to whatever has them enabled: the points and the field's
        parameters. Values of an angle-valued field are up to a multiple of its period.

        Raises TypeError or ValueError for other shapes, NaN or infinity.
        """
        if dr.is_array_v(type(points)):
            self.refuse_hidden_parameters()
            if any(dr.grad_enabled(one) for one in (points, *self.parameters())):
                return self.differentiable_value(points)
            return self.evaluate(points).value
        return self._evaluate_points(points, precision, lambda sample: sample.value)

    @accepts_dask_arrays("points")
    @accepts_tensors
    def gradient(self, points: Any, *, precision: Precision = "single") -> Any:
        """The gradients of f at points (n, 3): (n, 3); at a single point (3,): (3,).

        A Dr.Jit 3-vector gives a Dr.Jit 3-vector, and a tensor (n, 3) one of this shape, with
        derivatives with respect to the points if they have them enabled and the field defines
        `hessian`. Raises as `value`, and NotImplementedError if parameters of the field have
        derivatives enabled.
        """
        if not dr.is_array_v(type(points)):
            return self._evaluate_points(points, precision, lambda sample: sample.gradient)
        self.refuse_hidden_parameters()
        check_no_derivatives(f"the gradient of {type(self).__name__}", self.parameters())
        if not dr.grad_enabled(points):
            return self.evaluate(points).gradient
        with dr.suspend_grad():
            p = dr.detach(points)
            gradient, rows = self.evaluate(p).gradient, self.hessian(p)
        moved = points - p
        return gradient + type(points)(*(dr.dot(row, moved) for row in rows))

    def _evaluate_points(
        self, points: Any, precision: Precision, wanted: Callable[[Sample], Any]
    ) -> npt.NDArray[Any]:
        def kernel(backend: Backend, x: Vec3) -> tuple[Any, ...]:
            return (wanted(self.prepare(backend).evaluate(x)),)

        return evaluate_points(points, kernel, precision)[0]

    @accepts_numpy_points
    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """Rows of the symmetric matrix of second derivatives at p, in f per length squared.

        Curvatures and second-order distances use it; tracing does not. Fields define it for Dr.Jit
        3-vectors; called with points (n, 3) or (3,), and `precision`, as for `value`, it then gives
        (n, 3, 3) or (3, 3).
        """
        del p
        raise NotImplementedError(
            f"{type(self).__name__} gives no second derivatives: define its method hessian(p), or "
            'ask for what needs none, such as signed_distance(..., method="first_order")'
        )

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """Bounds of the errors of the gradient, as a length, and of `hessian`, in the spectral
        norm, at the point p of a sample. The default: what the sample states, and infinite for the
        Hessian, of which nothing is known."""
        del p
        return sample.gradient_error, math.inf

    def describe(self) -> dict[str, Any]:
        """Names and values of what a user may want to know about choices that the field made."""
        return {}

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """What is proved about f along a path from its point at t, in both directions.

        The default evaluates the field there and applies its promises to the slope along the path.
        A field that knows more about one direction than about all overrides this.

        ahead, back: the lengths up to which an enclosure can be of use; one that is sharper on a
            shorter length need reach no farther.
        """
        del ahead, back
        return path.enclose(self.evaluate(path.point(t)))


class EvaluateOnly(Field):
    """A field as evaluated at one detail: what `Field.at_detail` returns."""

    def __init__(self, evaluate: Callable[[Vec3], Sample]) -> None:
        self._evaluate = evaluate

    def evaluate(self, p: Vec3) -> Sample:
        return self._evaluate(p)


def validate_levels_in_range(
    levels: tuple[float, ...], value_range: tuple[float, float], what: str = "the function"
) -> None:
    """Raise ValueError for a level outside the range in which values are proved to lie.

    what: the name of the function, for the message.
    """
    low, high = value_range
    for level in levels:
        if not low <= level <= high:
            raise ValueError(
                f"no surface has level {level:g}: {what} stays within [{low:.6g}, {high:.6g}]"
            )


def check_is_field(given: Any) -> None:
    """Raise TypeError for what is no field, or one whose domain is no volume."""
    if not isinstance(given, Field):
        raise TypeError(
            f"a harnack field is needed, such as harnack.Gyroid(1.0), not {suggest_field(given)}"
        )
    check_volume(given.domain, f"the domain of a {type(given).__name__}")


def suggest_field(given: Any) -> str:
    """For a message: what a thing is that is no field, and how to make a field of it."""
    kind, name = type(given).__name__, getattr(given, "__name__", "")
    if isinstance(getattr(given, "field", None), Field):
        return f"a {kind}: take its .field, and what else this takes of it, such as its level"
    parts: list[Any] = [*given] if type(given) in (list, tuple) else []
    if any(isinstance(one, Field) for one in parts):
        return f"a {kind} of fields: give one at a time, or to harnack.render one flat list"
    if inspect.isclass(given) and issubclass(given, Field):
        return f"the class {name} itself: make one of it, {name}(...)"
    if hasattr(given, "vertices") and hasattr(given, "faces"):
        return f"a {kind}: of a mesh, take harnack.WindingNumber(mesh.vertices, mesh.faces)"
    if isinstance(given, str):
        return f"{given[:80]!r}: of a formula, take harnack.expression(text)"
    if isinstance(given, np.ndarray | list | tuple):
        return (
            f"of type {kind}: of points (n, 3) of a closed curve, take harnack.SolidAngle(points)"
        )
    if callable(given):
        return "a function: of a formula, take harnack.expression(function)"
    return f"of type {kind}"
