"""The class `Field`: a scalar function f on space whose level sets (surfaces f = level) are drawn.
It is the interface between functions and the rest of the library. One evaluation of a field at a
point p gives a sample: value and gradient of f at p, and promises, which are proved bounds of f
near p (`harnack.enclosures.promises`), such as a Lipschitz constant on a ball about p. Promises
must be *true*: every step of the tracer along a ray rests on them.

`harnack.testing.check_field` tests whether a field fulfills this interface.
"""

from __future__ import annotations

import abc
import copy
import copyreg
import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, cast, get_origin

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import backend_of
from harnack.backend.tensors import accepts_tensors
from harnack.backend.validation import (
    check_no_derivatives,
    format_short,
    has_derivatives,
    is_same_or_equal,
    make_read_only,
    no_derivatives,
)
from harnack.cluster.dask_arrays import accepts_dask_arrays
from harnack.enclosures import BoundedLaplacian, HarmonicBall, Lipschitz, TaylorRemainder
from harnack.enclosures.samples import (
    Ray,
    RaySample,
    Sample,
    describe_type,
    space_scaled,
    validate_samples,
)
from harnack.fields.attached_numbers import gradient_with_parameters, value_with_parameters
from harnack.fields.batch_evaluation import accepts_numpy_points, evaluate_points
from harnack.fields.evaluator import POINTS, EvaluateOnly, Evaluator, Plan
from harnack.fields.operators import FieldOperators
from harnack.fields.parameters import (
    ATTACHED,
    Parametrized,
    differentiable_parameters,
    record_call,
)
from harnack.geometry.volume import check_volume
from harnack.name_suggestions import with_article

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.fields.capabilities import Boundary, Jumps, ModuloOne, Patches, VariableAccuracy
    from harnack.geometry import Volume


__all__ = [
    "BoundedLaplacian",
    "EvaluateOnly",
    "Evaluator",
    "Field",
    "HarmonicBall",
    "Lipschitz",
    "Plan",
    "Ray",
    "RaySample",
    "Sample",
    "SampleEvaluator",
    "TaylorRemainder",
    "Traits",
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
        "repeated",
        "mirrored",
        "arranged",
        "around",
    )
)


@dataclass(frozen=True)
class Traits:
    """What the functions of the library have to know of a field before it is sampled.

    over_relaxation: the over-relaxation factor with which tracing needs the fewest evaluations, by
        experiment; at least 1. The tracer tries steps longer than the proved length by this factor,
        and proves the rest afterwards, looking back from the new point.
    min_wavelength: the shortest wavelength of f that matters; None if it is not known. Code that
        samples f in cells makes the cells smaller than this.
    is_cheap: whether a sample costs less than fetching the next ray from a queue
        (`tracer.surface_tracer.trace_queued`), by measurement.
    is_global: whether f and its promises hold in all of space. `Field.domain` then only limits what
        is drawn.
    has_creases: whether the gradient may jump, as it does where the surfaces of a union meet.
    has_jumps: whether f jumps across facets. Then `Evaluator.jumps` is an object.
    has_patches: whether the surface is a union of patches, each a level set of a function of its
        own. Then `Evaluator.patches` is an object.
    has_variable_accuracy: whether f is sampled with different accuracy whatever the number of rays.
        Then `Evaluator.variable_accuracy` is an object.
    is_larger_inside: whether f is larger inside of its surfaces than outside, as a winding number
        is. Then the inside is where f > level; else it is where f < level, as for signed distances.
    has_parameter_derivatives: whether f can be differentiated with respect to those of its
        parameters that are Dr.Jit arrays. If not, the constructor refuses arguments with
        derivatives enabled.
    differentiable_arguments: the names of arguments of the constructor by whose numbers f can be
        differentiated, because its formula uses them as they are (`fields.attached_numbers`), or
        it gives expressions of them (`fields.attached_arrays`): Dr.Jit numbers and arrays, or
        fields made of such. The constructor refuses other arguments with
        derivatives enabled.
    """

    over_relaxation: float = 1.4
    min_wavelength: float | None = None
    is_cheap: bool = False
    is_global: bool = False
    has_creases: bool = False
    has_jumps: bool = False
    has_patches: bool = False
    has_variable_accuracy: bool = False
    is_larger_inside: bool = False
    has_parameter_derivatives: bool = False
    differentiable_arguments: tuple[str, ...] = ()


class Field(FieldOperators, Parametrized, abc.ABC):
    """A scalar function f on R^3 whose level sets can be traced with a proof. A level is a number,
    and its level set is the surface f = level. A sample at a point holds value and gradient of f
    there, and promises: proved bounds of f near the point. Points p are Dr.Jit 3-vectors, one point
    per lane.

    A field describes f. What samples f on a backend (a Dr.Jit device and precision) is its
    `evaluator`. Subclasses define `evaluate`, or `evaluator` if they have data to upload, or can do
    more than be sampled; the other of the two methods follows. The class attributes are defaults,
    which an instance may override.
    """

    period: ClassVar[float | None] = None
    """None if f is real-valued. Otherwise f is angle-valued: its values are known up to multiples
    of this number, and f is continuous if values that differ by a multiple count as equal."""

    default_level: float = 0.0
    """The level that is drawn if the user names none."""

    domain: Volume | None = None
    """The convex volume in which the field may be evaluated and is drawn; None for all of space.
    Rays are clipped to it, and samples need only be right at points p in it. As it is convex, a
    ray from p stays in it up to where it is clipped. So `Lipschitz` and `TaylorRemainder` promises
    need not hold outside of it."""

    traits: Traits = Traits()
    """What the functions of the library have to know of f before it is sampled."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Make a field, which remembers this call (`parameters`).

        Raises:
            NotImplementedError: arguments with derivatives enabled, which would be lost because the
                traits of the class do not say `has_parameter_derivatives`.
            TypeError: the class defines neither `evaluate` nor `evaluator`; its traits are no
                `Traits`; or an argument `domain` that is neither a volume nor None.
        """
        traits: Any = cls.traits
        attached: dict[str, Any] = {}
        if not isinstance(traits, Traits):
            raise TypeError(
                f"the traits of {cls.__name__} are {describe_type(traits)}: write traits = "
                "harnack.fields.Traits(...), such as Traits(has_creases=True)"
            )
        # What was checked when it was made is not searched again.
        values = _values_without((*args, *kwargs.values()), is_checked)
        if traits.has_parameter_derivatives:
            # They know the derivatives of their own numbers; those of fields that they are made of,
            # only sums and products do.
            if not traits.differentiable_arguments:
                check_no_derivatives(cls.__name__, [v for v in values if is_attached(v)])
        elif has_derivatives(values):
            attached = _attached_arguments(cls, args, kwargs)
        if cls.evaluate is Field.evaluate:
            raise TypeError(
                f"{cls.__name__} does not say what its function is: define evaluate(p), which "
                "returns a harnack.fields.Sample"
            )
        field = super().__new__(cls)
        record_call(field, args, kwargs)
        if attached:
            vars(field)[ATTACHED] = True
            vars(field)["_constructor_call"].kept.update(attached)
        return field

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Replace methods of a new subclass. Its `evaluate` is wrapped so that the result is
        checked. Its `hessian` is wrapped so that it also takes NumPy arrays. Its public class
        methods are wrapped so that they refuse arguments with derivatives enabled, as the
        constructor does. Unless the subclass defines `__repr__`, it gets that of `Field`. If it
        defines only one of `evaluate` and `evaluator`, it gets the other one, which calls it: the
        one of a base class might not."""
        super().__init_subclass__(**kwargs)
        if "__repr__" not in vars(cls):  # a dataclass would write out all numbers
            cls.__repr__ = Field.__repr__
        # Public class methods are taken as further constructors.
        for name, attribute in list(vars(cls).items()):
            if isinstance(attribute, classmethod) and not name.startswith("_"):
                maker = cast("Any", attribute).__func__
                if not getattr(maker, "copies_numbers", False):
                    setattr(cls, name, classmethod(no_derivatives(maker)))
        defines_evaluator = "evaluator" in vars(cls)
        if defines_evaluator and not cls.__module__.startswith("harnack."):
            cls.evaluator = cast("Any", _with_checks(cls.evaluator))
        if "evaluate" in vars(cls):
            checked: Any = validate_samples(cls.evaluate)
            cls.evaluate = checked
            if "evaluator" not in vars(cls):  # a base's might not call this `evaluate`
                cls.evaluator = Field.evaluator
        elif defines_evaluator:
            evaluate_by: Any = _evaluate_by(cls.evaluator)
            cls.evaluate = evaluate_by
        if defines_evaluator:
            by_inherited: Any = _evaluate_by_inherited(cls, cls.evaluate)
            cls.evaluate = by_inherited
        if "hessian" in vars(cls):
            general: Any = accepts_numpy_points(cls.hessian)
            cls.hessian = general

    def __copy__(self) -> Self:
        other = object.__new__(type(self))
        for name, value in _attributes(self).items():
            object.__setattr__(other, name, value)  # also of frozen dataclasses, and in __slots__
        return other

    def __reduce_ex__(self, protocol: Any) -> Any:
        """What pickle and `copy.deepcopy` make a copy of. They copy arrays without derivatives, so
        a field that has some is refused with NotImplementedError."""
        if has_derivatives(vars(self)):
            raise NotImplementedError(
                f"a pickle or deep copy of this {type(self).__name__} would lose derivatives of "
                "its numbers: take copy.copy or replace, or detach the numbers (drjit.detach)"
            )
        return super().__reduce_ex__(protocol)

    def __setstate__(self, state: Any) -> None:
        """Restore a pickled field or a deep copy from its attributes `state`, and make its arrays
        read-only again, because NumPy does not pickle this. (They are read-only because results
        were computed from them already: writing to an array would not update these.) Of a class
        with `__slots__` the state is a pair: the attributes, and those in the slots."""
        attributes: dict[str, Any] = {}
        for record in cast("tuple[Any, ...]", state if isinstance(state, tuple) else (state,)):
            attributes |= record or {}
        for name, value in attributes.items():
            object.__setattr__(self, name, value)
        # Fields in it have been restored already, by this method.
        make_read_only(_values_without(attributes.values(), lambda value: isinstance(value, Field)))

    def __repr__(self) -> str:
        """The constructor call as text, with those arguments that the field still stores as
        attributes and that differ from their defaults. Arrays are written as their shapes."""
        parameters = inspect.signature(type(self).__init__).parameters
        values = {key.removeprefix("_"): value for key, value in vars(self).items()}
        arguments = [
            f"{key}={format_short(values[key])}"
            for key, parameter in parameters.items()
            if key in values and not is_same_or_equal(values[key], parameter.default)
        ]
        return f"{type(self).__name__}({', '.join(arguments)})"

    def __getattr__(self, name: str) -> Any:
        """Raise AttributeError: Python calls this method only for an attribute that does not exist.
        For the name of a method that only solids have, the message says how to make a solid of the
        field."""
        message = f"{type(self).__name__!r} object has no attribute {name!r}"
        if name in _SOLID_METHODS:
            message += ": make a solid of the field first, by harnack.solid(field, below=level)"
        raise AttributeError(message)

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p: value and gradient of f, and promises (proved bounds of f near p). p is
        a Dr.Jit 3-vector of any backend and precision.

        It is called while a loop is being recorded. So use `drjit` functions of p, and no Python
        branches on its values. A class that defines `evaluator` need not define it.
        """
        return self.evaluator(backend_of(p)).evaluate(p)

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        """The object that samples f on a backend (a Dr.Jit device and precision): `Evaluator`. It
        holds the data that are needed there. Each function of the library makes it once, before a
        kernel is recorded, because nothing can be uploaded during the recording.

        plan: what the evaluator will be used for (`Plan`).

        The default is for fields that define `evaluate`, which it calls (`SampleEvaluator`).
        """
        del plan
        return SampleEvaluator(self, backend)

    @property
    def boundary(self) -> Boundary | None:
        """The curves and points at which all level sets end; None, the default, if there are
        none."""
        return None

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A volume that is proved to contain every point of the level sets of these levels; None if
        no such volume is known.

        The default is `domain`. An extent may be smaller than `domain`. With an extent, a ray
        without an end can be a proved miss.
        """
        del levels
        return self.domain

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError if f is proved never to take one of the levels. The default accepts all
        levels."""
        del levels

    @accepts_dask_arrays("points")
    @accepts_tensors
    def value(self, points: Any, *, precision: Precision | None = None) -> Any:
        """The values (n,) of f at points (n, 3); a number for a single point (3,).

        A Dr.Jit 3-vector gives a Dr.Jit array, and a tensor (n, 3) gives a tensor (n,). Both have
        derivatives with respect to the points and the field's parameters where these have
        derivatives enabled. Values of an angle-valued field are determined up to a multiple of its
        period.

        precision: "single" or "double"; None for that of the input, double for arrays of float64,
            else single.

        Raises TypeError or ValueError for other shapes, NaN or infinity.
        """
        if dr.is_array_v(type(points)):
            refuse_hidden_parameters(self)
            if not dr.width(points):  # Dr.Jit adds no number to an empty array
                return dr.zeros(type(points[0]), 0)
            if any(dr.grad_enabled(array) for array in (points, *differentiable_parameters(self))):
                return value_with_parameters(self, self.evaluator(backend_of(points)), points)
            return self.evaluate(points).value
        return self._evaluate_points(points, precision, lambda sample: sample.value)

    @accepts_dask_arrays("points")
    @accepts_tensors
    def gradient(self, points: Any, *, precision: Precision | None = None) -> Any:
        """The gradients (n, 3) of f at points (n, 3); (3,) for a single point (3,).

        A Dr.Jit 3-vector gives a Dr.Jit 3-vector, and a tensor (n, 3) gives a tensor (n, 3). Both
        have derivatives with respect to the points if these have derivatives enabled and the field
        defines `hessian`; and with respect to the field's parameters that have derivatives enabled,
        if `Evaluator.differentiable_gradient` or the field's formula knows these. Raises the errors
        of `value`, and NotImplementedError if it does not.

        precision: as for `value`.
        """
        if not dr.is_array_v(type(points)):
            return self._evaluate_points(points, precision, lambda sample: sample.gradient)
        refuse_hidden_parameters(self)
        parameters = differentiable_parameters(self)
        if not dr.width(points):
            return dr.zeros(type(points), 0)
        if not any(map(dr.grad_enabled, (points, *parameters))):
            return self.evaluate(points).gradient
        evaluator = self.evaluator(backend_of(points))
        gradient = gradient_with_parameters(self, evaluator, points)
        if gradient is None:
            check_no_derivatives(f"the gradient of {type(self).__name__}", parameters)
            evaluator.hessian(dr.detach(points))  # says that it is not known
        return gradient

    def _evaluate_points(
        self, points: Any, precision: Precision | None, choose: Callable[[Sample], Any]
    ) -> npt.NDArray[Any]:
        """What `choose` takes from the samples at points (n, 3) or (3,), as a NumPy array in the
        order of the points.

        precision: "single", "double", or None for that of the points.
        choose: a function that takes the sample of a batch of points and returns the wanted number
            or vector.
        """

        def kernel(backend: Backend, x: Vec3) -> tuple[Any, ...]:
            """The number or vector that `choose` takes from the samples at the Dr.Jit points x, in
            a tuple of one entry."""
            return (choose(self.evaluator(backend).evaluate(x)),)

        return evaluate_points(points, kernel, precision)[0]

    @accepts_numpy_points
    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The rows of the symmetric matrix of second derivatives at p, in units of f per length
        squared.

        Curvatures and second-order distances use it; tracing does not. Subclasses define it for
        Dr.Jit 3-vectors. It can then also be called with points (n, 3) or (3,), and with
        `precision` as for `value`, and gives (n, 3, 3) or (3, 3).
        """
        return self.evaluator(backend_of(p)).hessian(p)

    def describe(self) -> dict[str, Any]:
        """The choices that the field made by itself, such as a method or an accuracy, as a
        dictionary from names to values that is shown to users.

        The default is empty.
        """
        return {}


def copies_numbers(maker: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator for a class method of a field that copies numbers without their derivatives, as its
    documentation says, so that it need not refuse those that have some."""
    cast("Any", maker).copies_numbers = True
    return maker


def is_checked(value: Any) -> bool:
    """Whether a value is a field of the library that refused derivatives when it was made, so that
    it need not be searched for them again."""
    return (
        type(value) is not float  # the most frequent type
        and isinstance(value, Field)
        and not value.traits.has_parameter_derivatives
        and ATTACHED not in vars(value)
        and type(value).__module__.startswith("harnack.")
    )


def is_attached(value: Any) -> bool:
    """Whether a value is a field that was made of numbers with derivatives."""
    return ATTACHED in getattr(value, "__dict__", {})


def _attached_arguments(
    kind: type[Field], args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> dict[str, Any]:
    """The arguments of a constructor with derivatives by which f can be differentiated: those of
    `Traits.differentiable_arguments` that are Dr.Jit numbers, tuples, lists or mappings of such, or
    fields that are made of such.

    Raises:
        NotImplementedError: other arguments have derivatives enabled.
    """
    try:
        bound = inspect.signature(cast("Any", kind).__init__).bind(None, *args, **kwargs)
    except TypeError:
        check_no_derivatives(kind.__name__, args, kwargs)
        return {}
    known = {
        name: value
        for name, value in bound.arguments.items()
        if name in kind.traits.differentiable_arguments and _is_attachable(value)
    }
    others = [value for name, value in bound.arguments.items() if name not in known]
    check_no_derivatives(kind.__name__, *others)
    return known


def _is_attachable(value: Any) -> bool:
    """Whether all derivatives of a value are those of Dr.Jit numbers, or of fields and maps."""
    if isinstance(value, Mapping):
        return all(map(_is_attachable, cast("Any", value).values()))
    if isinstance(value, tuple | list):
        return all(map(_is_attachable, cast("Any", value)))
    is_known = dr.is_array_v(type(value)) or isinstance(value, Parametrized)
    is_known = is_known or getattr(value, "keeps_derivatives", False)  # as terms of sums do
    return is_known or not has_derivatives(value)


def _values_without(values: Iterable[Any], is_left_out: Callable[[Any], bool]) -> list[Any]:
    """The values, and in place of tuples and lists what is in them, without those that are left
    out."""
    kept: list[Any] = []
    for value in values:
        entries = cast("tuple[Any, ...]", value if type(value) in (tuple, list) else (value,))
        kept += [entry for entry in entries if not is_left_out(entry)]
    return kept


def _attributes(field: Field) -> dict[str, Any]:
    """The attributes of a field by name, with those in `__slots__` of its class."""
    slots: list[str] = cast("Any", copyreg)._slotnames(type(field))  # pickle takes these
    return vars(field) | {name: getattr(field, name) for name in slots if hasattr(field, name)}


def _with_checks(
    evaluator: Callable[[Any, Backend, Plan], Evaluator],
) -> Callable[[Any, Backend, Plan], Evaluator]:
    """The method `evaluator` of a user's class, which raises a TypeError if it does not take a
    backend and a plan, or returns no evaluator. The plan may be left out of calls. Numbers that are
    attributes of the evaluator are computed."""

    @functools.wraps(evaluator)
    def checked(self: Any, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        """The evaluator, after the checks."""
        name = type(self).__name__
        try:
            inspect.signature(evaluator).bind(self, backend, plan)
        except TypeError as error:
            raise TypeError(
                f"{name}.evaluator: {error}: write def evaluator(self, backend, plan=None)"
            ) from None
        result: Any = evaluator(self, backend, plan)
        if not isinstance(result, Evaluator):
            raise TypeError(
                f"{name}.evaluator returned {describe_type(result)}: return a "
                "harnack.fields.Evaluator; one that calls the evaluate(p) of the field is "
                "harnack.fields.SampleEvaluator(self, backend)"
            )
        # Numbers that are still to be computed would be computed by the lanes of the next kernel.
        numbers = getattr(result, "__dict__", {}).values()
        dr.eval(*(value for value in numbers if dr.is_array_v(type(value))))
        return result

    return checked


def _evaluate_by(evaluator: Callable[[Any, Backend], Evaluator]) -> Callable[[Any, Vec3], Sample]:
    """The method `evaluate` of a class of fields that defines `evaluator`."""

    def evaluate(self: Any, p: Vec3) -> Sample:
        """The sample at p, by the evaluator of the class that was wrapped."""
        return evaluator(self, backend_of(p)).evaluate(p)

    cast("Any", evaluate).is_derived = True  # `_stating_class` passes it over
    return evaluate


def _evaluate_by_inherited(
    kind: type[Field], evaluate: Callable[[Any, Vec3], Sample]
) -> Callable[[Any, Vec3], Sample]:
    """The method `evaluate` of a class `kind` that defines `evaluator`, for the call of
    super().evaluate(p) by the `evaluate` of a subclass. That may be while a kernel is recorded,
    when no evaluator can be made. So the evaluator is an attribute that was set before
    (`_with_inherited_evaluator`). Without it the result is that of `evaluate`."""

    @functools.wraps(evaluate)
    def evaluate_by_inherited(self: Any, p: Vec3) -> Sample:
        """The sample at p."""
        inherited = cast("dict[str, Any]", vars(self)).get("_inherited_evaluator")
        if inherited is None or inherited[0] is not kind:
            return evaluate(self, p)
        return inherited[1].evaluate(p)

    return evaluate_by_inherited


def _with_inherited_evaluator(field: Field, origin: Field, backend: Backend) -> Field:
    """The field, or a copy that is ready for the call of super().evaluate(p) by the `evaluate` of
    its class. The copy is made if that calls a class of this library that defines `evaluator`.

    origin: the field as the user made it, of which `field` may be a copy.
    """
    kinds = type(field).__mro__
    for kind in kinds[kinds.index(_stating_class(type(field))) + 1 :]:
        evaluator = vars(kind).get("evaluator", Field.evaluator)
        if kind.__module__.startswith("harnack.") and evaluator is not Field.evaluator:
            other = copy.copy(field)
            inherited = kind, evaluator(origin, backend)
            object.__setattr__(other, "_inherited_evaluator", inherited)
            return other
    return field


def _stating_class(kind: type[Field]) -> type[Field]:
    """The class of fields that states the `evaluate` of a class: the class itself, or the base from
    which it inherits the method. Methods that were made of `evaluator` do not count."""
    bases = [base for base in kind.__mro__ if "evaluate" in vars(base)]
    return next(base for base in bases if not getattr(vars(base)["evaluate"], "is_derived", False))


class SampleEvaluator(Evaluator):
    """The evaluator of a field whose class defines `evaluate`. Fields that are attributes of the
    field, or are in attributes that are lists, tuples, dictionaries or dataclasses, are made ready
    for the backend, too: within `evaluate`, self.inner.evaluate(p) uses data on the backend.

    field: the field. The attribute `field` is a copy of it if fields are among its attributes.
    backend: the backend.
    jumps, modulo_one, patches, variable_accuracy, is_steep: what else f can do, as of `Evaluator`.

    Fields with second derivatives define `hessian` beside `evaluate`. Fields with enclosures of
    their own along rays define a subclass of this class with `sample_ray`, and return it from
    `Field.evaluator`.
    """

    def __init__(
        self,
        field: Field,
        backend: Backend,
        *,
        jumps: Jumps | None = None,
        modulo_one: ModuloOne | None = None,
        patches: Patches | None = None,
        variable_accuracy: VariableAccuracy | None = None,
        is_steep: bool = False,
    ) -> None:
        if _stating_class(type(field)) is Field:
            raise TypeError(
                f"a SampleEvaluator calls the evaluate(p) of the field, and {type(field).__name__} "
                "does not define it"
            )
        ready = _with_ready_fields(field, backend)
        self.field = _with_inherited_evaluator(ready, field, backend)
        self._evaluate = vars(_stating_class(type(field)))["evaluate"]
        self.jumps, self.modulo_one, self.patches = jumps, modulo_one, patches
        self.variable_accuracy, self.is_steep = variable_accuracy, is_steep

    @property
    def name(self) -> str:
        """The name of the field's class, for messages."""
        return type(self.field).__name__

    def evaluate(self, p: Vec3) -> Sample:
        return self._evaluate(self.field, p)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        if type(self.field).hessian is Field.hessian:  # it would ask this evaluator again
            return super().hessian(p)
        return self.field.hessian(p)

    def differentiable_value(self, p: Vec3) -> Real:
        parameters = differentiable_parameters(self.field)
        if any(map(dr.grad_enabled, parameters)):
            # The `evaluate` of a base class has no derivatives by its parameters.
            if _has_parameters_of_base(type(self.field)):
                value = self.evaluate(dr.detach(p)).value
                if not dr.grad_enabled(value):
                    check_no_derivatives(f"the evaluate of {self.name}", parameters)
            return self.evaluate(p).value
        refuse_hidden_parameters(self.field)
        return super().differentiable_value(p)


def _has_parameters_of_base(kind: type[Field]) -> bool:
    """Whether a user's class is derived from a class of this library that has derivatives by
    parameters."""
    bases = (base for base in kind.__mro__ if base.__module__.startswith("harnack."))
    return any(
        getattr(vars(base).get("traits"), "has_parameter_derivatives", False) for base in bases
    )


def refuse_hidden_parameters(field: Field) -> None:
    """Raise NotImplementedError if a field holds numbers with derivatives enabled, for example in
    its formula, and these derivatives would be lost. They would be lost if its traits do not say
    `has_parameter_derivatives`; or, for a user's class, if none of the field's `parameters` has
    derivatives enabled."""
    kind = type(field)
    # The `evaluate` of a user's class may refer to such numbers, too.
    is_users = not kind.__module__.startswith("harnack.")
    if field.traits.has_parameter_derivatives and (
        not is_users or any(map(dr.grad_enabled, differentiable_parameters(field)))
    ):
        return
    if ATTACHED in vars(field) and not is_users:
        known = {"_constructor_call", *field.traits.differentiable_arguments}
        values = {name: value for name, value in vars(field).items() if name not in known}
        check_no_derivatives(kind.__name__, values)
        return
    check_no_derivatives(kind.__name__, vars(field), kind.evaluate if is_users else None)


def _with_ready_fields(field: Field, backend: Backend) -> Field:
    """The field, or a copy of it in which each field among its attributes is `_ready`."""
    attributes = _attributes(field)
    attributes.pop("_constructor_call", None)  # `evaluate` does not use it
    ready = {name: _ready_in(value, backend) for name, value in attributes.items()}
    if all(value is attributes[name] for name, value in ready.items()):
        return field
    other = copy.copy(field)
    for name, value in ready.items():
        object.__setattr__(other, name, value)  # also of frozen dataclasses
    return other


def _ready_in(value: Any, backend: Backend, outer: tuple[Any, ...] = ()) -> Any:
    """The value of a field's attribute, where each field in it is `_ready`. Fields are found if
    they are the value itself, or are in a list, tuple, dictionary or dataclass, or in such objects
    inside of each other. If there are none, the same object is returned.

    outer: the objects in which the value is. It may be one of them.
    """
    if isinstance(value, Field):
        return _ready(value, backend)
    parts = _parts(value)
    if not parts or any(value is other for other in outer):
        return value
    ready = {name: _ready_in(part, backend, (*outer, value)) for name, part in parts.items()}
    if all(part is parts[name] for name, part in ready.items()):
        return value
    if _is_tuple(value):
        return getattr(value, "_make", tuple)(ready.values())  # a method of named tuples
    other = copy.copy(value)
    has_entries = issubclass(type(value), list | dict)
    for name, part in ready.items():
        if has_entries:
            other[name] = part
        else:
            object.__setattr__(other, name, part)  # also of frozen dataclasses
    return other


def _is_tuple(value: Any) -> bool:
    """Whether a value is a tuple or a named tuple."""
    return type(value) is tuple or (issubclass(type(value), tuple) and hasattr(value, "_make"))


def _parts(value: Any) -> dict[Any, Any]:
    """The entries of a list, tuple or dictionary by index or key, and the attributes of a dataclass
    by name; none for all else."""
    if isinstance(value, dict):
        return cast("Any", value)
    if isinstance(value, list) or _is_tuple(value):
        entries: list[Any] = [*cast("Any", value)]
        is_numbers = all(type(entry) in (float, int) for entry in entries)  # saves time
        return {} if is_numbers else dict(enumerate(entries))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [entry.name for entry in dataclasses.fields(value)]
        return {name: getattr(value, name) for name in names if hasattr(value, name)}
    return {}


def _ready(field: Field, backend: Backend) -> Field:
    """A copy of a field whose method `evaluate` is that of its evaluator on a backend."""
    other, evaluator = copy.copy(field), field.evaluator(backend)
    evaluate = evaluator.evaluate
    parameters = differentiable_parameters(field)

    def differentiable(p: Vec3) -> Sample:
        """The sample at p, whose value has derivatives by the field's parameters."""
        sample = evaluator.evaluate(p)
        if not any(map(dr.grad_enabled, parameters)):  # as during a trace
            return sample
        return dataclasses.replace(sample, value=evaluator.differentiable_value(p))

    has_derivatives = any(map(dr.grad_enabled, parameters))
    object.__setattr__(other, "evaluate", differentiable if has_derivatives else evaluate)
    # The WebGPU recorder finds arrays through attributes, and a method has none.
    object.__setattr__(other, "_evaluator", evaluator)
    return other


def validate_levels_in_range(
    levels: tuple[float, ...], value_range: tuple[float, float], name: str = "the function"
) -> None:
    """Raise ValueError if a level lies outside the range that is proved to contain all values of f.

    levels: the levels.
    value_range: the ends (lower, upper) of the range.
    name: the name of the function, for the message.
    """
    lower, upper = value_range
    for level in levels:
        if not lower <= level <= upper:
            raise ValueError(
                f"no surface has level {level:g}: {name} stays within [{lower:.6g}, {upper:.6g}]"
            )


def check_is_field(value: Any) -> None:
    """Raise TypeError unless `value` is a field whose domain is a volume or None."""
    if not isinstance(value, Field):
        raise TypeError(
            f"a harnack field is needed, such as harnack.Gyroid(1.0), not {suggest_field(value)}"
        )
    check_volume(value.domain, f"the domain of {with_article(type(value).__name__)}")


def checked_evaluator(field: Field, backend: Backend, plan: Plan = POINTS) -> Evaluator:
    """The evaluator of a field. Raises TypeError if it has jumps or patches and the traits of the
    field say that it has none, or the other way round."""
    evaluator = field.evaluator(backend, plan)
    for name, is_stated, capability in (
        ("jumps", field.traits.has_jumps, evaluator.jumps),
        ("patches", field.traits.has_patches, evaluator.patches),
    ):
        if is_stated != (capability is not None):
            raise TypeError(
                f"the traits of {type(field).__name__} say has_{name}={is_stated}, and its "
                f"evaluator has {'no ' if is_stated else ''}{name}"
            )
    return evaluator


def suggest_field(value: Any) -> str:
    """The end of an error message about an object, `value`, that is given in place of a field: what
    kind of object it is, and how to make a field of it."""
    kind, name = type(value).__name__, getattr(value, "__name__", "")
    object_of_kind = with_article(kind)
    # An object that holds a field, a list of fields, a class, a mesh, a text, points, or a
    # function.
    if isinstance(getattr(value, "field", None), Field):
        return (
            f"{object_of_kind}: take its .field, and what else this takes of it, such as its level"
        )
    parts: list[Any] = [*value] if type(value) in (list, tuple) else []
    if any(isinstance(part, Field) for part in parts):
        return f"{object_of_kind} of fields: give one at a time, or to harnack.render one flat list"
    # Python 3.10 takes list[int] for a class.
    if inspect.isclass(value) and get_origin(value) is None and issubclass(value, Field):
        return f"the class {name} itself: make one of it, {name}(...)"
    if hasattr(value, "vertices") and hasattr(value, "faces"):
        return f"{object_of_kind}: of a mesh, take harnack.WindingNumber(mesh.vertices, mesh.faces)"
    if isinstance(value, str):
        return f"{value[:80]!r}: of a formula, take harnack.expression(text)"
    if isinstance(value, np.ndarray | list | tuple):
        return (
            f"of type {kind}: of points (n, 3) of a closed curve, take harnack.SolidAngle(points)"
        )
    if callable(value):
        return "a function: of a formula, take harnack.expression(function)"
    return f"of type {kind}"
