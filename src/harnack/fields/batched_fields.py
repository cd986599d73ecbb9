"""Fields that can be evaluated at large numbers of points at once, and caches that live as long as
a field. A field is a function f of space. `BatchedField` gives its values, derivatives and error
bounds at NumPy points, as NumPy arrays. The computation itself is a Dr.Jit kernel, with one point
per lane. Many such fields are sums over sources in a tree, where a far cluster of sources is
approximated as one source; this causes a truncation error. `FieldCache` and `cached_upload` cache
results that are computed or uploaded once per field."""

from __future__ import annotations

import abc
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar, cast
from weakref import finalize

import drjit as dr

from harnack.backend import FloatArray, backend_of
from harnack.backend.arrays import as_kernel_parameters
from harnack.backend.elementary import fmax
from harnack.backend.tensors import accepts_tensors
from harnack.cluster.dask_arrays import accepts_dask_arrays
from harnack.enclosures.samples import value_error_bound
from harnack.fields.batch_evaluation import evaluate_points
from harnack.fields.capabilities import VariableAccuracy
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, SampleEvaluator, Traits
from harnack.fields.parameters import differentiable_parameters
from harnack.fmm.point_values import PointValues, SymmetricMatrix
from harnack.name_suggestions import with_article

if TYPE_CHECKING:
    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.enclosures.samples import Sample


class BatchedField(Field):
    """A field whose values, derivatives and error bounds can be evaluated at large numbers of
    points at once. Points are either Dr.Jit 3-vectors, one point per lane, or NumPy arrays (n, 3),
    for which results are NumPy arrays. Many such fields are sums over sources in a tree, in which a
    far cluster of sources is approximated as one source; this causes a truncation error. Subclasses
    define `values_at`."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Let `evaluator` of a new subclass that defines `evaluate` and not `evaluator` return an
        object with the derivatives of `values_at`. If the subclass defines `evaluate` and not
        `values_at`, it gets one that calls `evaluate`: that of a base class is of another
        function."""
        defines_evaluate = "evaluate" in vars(cls)
        defines_evaluator = "evaluator" in vars(cls)
        super().__init_subclass__(**kwargs)
        if not defines_evaluate:
            return
        if not defines_evaluator:
            cls.evaluator = _evaluator_of_users_class
        if "values_at" not in vars(cls):
            cls.values_at = _values_of_samples
            if "sharp_values_at" not in vars(cls):
                cls.sharp_values_at = BatchedField.sharp_values_at

    @abc.abstractmethod
    def values_at(self, x: Vec3, derivatives: int, closer: Real = 1.0) -> PointValues:
        """Values of f at points x, with error bounds and, if requested, derivatives. x is a Dr.Jit
        3-vector of any backend and precision.

        derivatives: 0 for values only, 1 for gradients too, 2 for Hessians too.
        closer: the accuracy scale, at least 1; larger is more accurate. It multiplies the distance
            from which on a cluster of sources is approximated. With infinity nothing is
            approximated.

        It is not called while a loop is being recorded, unless `derivatives` is 2.
        """

    def sharp_values_at(self, x: Vec3) -> PointValues:
        """Values and gradients at points x, as accurate as `gradient` returns them to users. The
        default is `values_at`; subclasses may compute the gradient more accurately (`sharpened`).
        It is not called while a loop is being recorded."""
        return self.values_at(x, 1)

    @accepts_dask_arrays("points")
    @accepts_tensors
    def value(self, points: Any, *, precision: Precision | None = None) -> Any:
        if dr.is_array_v(type(points)):
            if has_moving_numbers(self, points):
                return super().value(points)
            return self.values_at(points, 0).value
        return self._choose_at_points(points, precision, 0, lambda at: (at.value,))[0]

    @accepts_dask_arrays("points")
    @accepts_tensors
    def gradient(self, points: Any, *, precision: Precision | None = None) -> Any:
        if dr.is_array_v(type(points)):
            if has_moving_numbers(self, points):
                return super().gradient(points)
            return self.sharp_values_at(points).gradient
        return self._choose_at_points(points, precision, 1, lambda at: (at.gradient,))[0]

    def moving_sum(self, backend: Backend) -> MovingSum | None:
        """f on a backend, as an expression that Dr.Jit differentiates by points and by the
        parameters of the field; None, as by default, if no parameter has derivatives enabled.

        Raises:
            NotImplementedError: derivatives by some of them are not known.
        """
        del backend
        return None

    def value_and_gradient(
        self, points: Any, *, precision: Precision | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the values (n,) and the gradients (n, 3) of f at points (n, 3), as NumPy arrays.
        Together they take hardly more time than gradients alone.

        precision: "single" or "double"; None for that of the points.
        """
        value, gradient = self._choose_at_points(
            points, precision, 1, lambda at: (at.value, at.gradient)
        )
        return value, gradient

    def rough_value_and_gradient(
        self, points: Any, *, precision: Precision | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the values (n,) and the gradients (n, 3) at points (n, 3), by a single pass over
        the tree of sources. The gradients may have large errors, so they are for estimates only, or
        for points where f is so steep that the errors do not matter.

        precision: "single" or "double"; None for that of the points.
        """

        def kernel(backend: Backend, x: Vec3) -> tuple[Any, ...]:
            """The values, then the gradients, at the Dr.Jit points x."""
            del backend
            at = self.values_at(x, 1)
            return at.value, at.gradient

        value, gradient = evaluate_points(points, kernel, precision)
        return value, gradient

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return _required_hessian(self.values_at(p, 2)).rows(backend_of(p).Array3f)

    @accepts_dask_arrays("points")
    def error_bound(self, points: Any, *, precision: Precision | None = None) -> FloatArray:
        """Bounds (n,) of the error of `value` at points (n, 3). They include the proved truncation
        error and the rounding error of f. They do not include the change of f by rounding the
        points to single precision.

        precision: "single" or "double"; None for that of the points.
        """
        return self._choose_at_points(points, precision, 0, lambda at: (at.error,))[0]

    @accepts_dask_arrays("points")
    def gradient_error_bound(
        self, points: Any, *, precision: Precision | None = None
    ) -> FloatArray:
        """Bounds (n,) of the error of `gradient`, as a length, at points (n, 3). They include the
        proved truncation error and the rounding error. They do not include the change of the
        gradient by rounding the points.

        For a sum over a tree the bound is about a hundred times the error itself: the sum is made
        only as accurate as an estimate of the error demands (`sharpened`), and the proved bound is
        far larger than the estimate.

        precision: "single" or "double"; None for that of the points.
        """
        return self._choose_at_points(points, precision, 1, lambda at: (at.gradient_error,))[0]

    @accepts_dask_arrays("points")
    def hessian_error_bound(self, points: Any, *, precision: Precision | None = None) -> FloatArray:
        """Bounds (n,) of the error of `hessian`, in the spectral norm, at points (n, 3). They
        include the proved truncation error and the rounding error. They do not include the change
        of the Hessian by rounding the points.

        precision: "single" or "double"; None for that of the points.
        """
        return self._choose_at_points(points, precision, 2, lambda at: (at.hessian_error,))[0]

    def _choose_at_points(
        self,
        points: Any,
        precision: Precision | None,
        derivatives: int,
        choose: Callable[[PointValues], tuple[Any, ...]],
    ) -> tuple[FloatArray, ...]:
        """Evaluate the field at points (n, 3) or (3,), and return the results that `choose`
        selects, as a tuple of NumPy arrays in the order of the points.

        precision: "single", "double", or None for that of the points.
        derivatives: the order up to which derivatives are computed, 0 to 2.
        choose: a function that takes the `PointValues` of a batch of points and returns the wanted
            Dr.Jit arrays.
        """

        def kernel(backend: Backend, x: Vec3) -> tuple[Any, ...]:
            """The tuple that `choose` selects from the values at the Dr.Jit points x. If gradients
            but no Hessians are asked for, the gradients are computed more accurately, by
            `sharp_values_at`."""
            del backend
            is_sharp = derivatives == 1
            return choose(self.sharp_values_at(x) if is_sharp else self.values_at(x, derivatives))

        return evaluate_points(points, kernel, precision)


class BatchedEvaluator(Evaluator):
    """The evaluator of a `BatchedField`. Its second derivatives, and the gradient of the value that
    can be differentiated, are those of the field at points.

    field: the field.
    """

    field: BatchedField

    def values_at(self, p: Vec3, derivatives: int, closer: Real = 1.0) -> PointValues:
        """Values of f at points p (`BatchedField.values_at`)."""
        return self.field.values_at(p, derivatives, closer)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return _required_hessian(self.values_at(p, 2)).rows(backend_of(p).Array3f)

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        return sample.gradient_error, self.values_at(p, 2).hessian_error

    def differentiable_value(self, p: Vec3) -> Real:
        """f at p as an expression that Dr.Jit can differentiate once, in reverse and in forward
        mode, with respect to p and to parameters of the field. By p alone, its derivative is the
        gradient of `BatchedField.sharp_values_at`."""
        moving = self.field.moving_sum(backend_of(p))
        return _differentiable_value(self.field, p) if moving is None else moving.value(p)

    def differentiable_gradient(self, p: Vec3) -> Vec3 | None:
        moving = self.field.moving_sum(backend_of(p))
        return super().differentiable_gradient(p) if moving is None else moving.gradient(p)


class _EvaluatorOfUsersClass(BatchedEvaluator, SampleEvaluator):
    """The evaluator of a `BatchedField` whose class defines `evaluate`."""

    field: Any

    def differentiable_value(self, p: Vec3) -> Real:
        """f at p, with derivatives by those parameters on which the user's `evaluate` depends. The
        `moving_sum` of a base class is of another function.

        Raises:
            NotImplementedError: parameters have derivatives enabled, and `evaluate` has none by
                them, for example because it calls that of the base class.
        """
        if any(map(dr.grad_enabled, differentiable_parameters(self.field))):
            return SampleEvaluator.differentiable_value(self, p)
        return _differentiable_value(self.field, p)

    def differentiable_gradient(self, p: Vec3) -> Vec3 | None:
        if any(map(dr.grad_enabled, differentiable_parameters(self.field))):
            return None
        return Evaluator.differentiable_gradient(self, p)


def _evaluator_of_users_class(
    self: BatchedField, backend: Backend, plan: Plan = POINTS
) -> Evaluator:
    """The method `evaluator` of a `BatchedField` whose class defines `evaluate`."""
    del plan
    return _EvaluatorOfUsersClass(self, backend)


def _values_of_samples(
    self: BatchedField, x: Vec3, derivatives: int, closer: Real = 1.0
) -> PointValues:
    """The method `values_at` of a `BatchedField` whose class defines `evaluate` and not
    `values_at`. Second derivatives are those of the class's `hessian`, with an unknown error.

    Raises:
        NotImplementedError: the class does not define `hessian`.
    """
    del closer
    evaluator = self.evaluator(backend_of(x))
    sample, hessian = evaluator.evaluate(x), None
    if derivatives == 2:
        # The `hessian` of the base class would ask for these values again.
        is_defined = type(self).hessian is not BatchedField.hessian
        first, second, third = self.hessian(x) if is_defined else Evaluator.hessian(evaluator, x)
        hessian = SymmetricMatrix(first.x, second.y, third.z, first.y, first.z, second.z)
    error = value_error_bound(sample, 0 * x.x, 0 * x.x)  # without the rounding of x
    return PointValues(
        sample.value, error, sample.gradient, hessian, sample.gradient_error, math.inf
    )


class MovingSum(Protocol):
    """A function f that Dr.Jit differentiates by points and by what f is made of, in forward and
    reverse mode."""

    def value(self, p: Vec3) -> Real:
        """f at points p (3, n) of space."""
        ...

    def gradient(self, p: Vec3) -> Vec3:
        """The gradient of f at points p (3, n) of space."""
        ...


class SumData(Protocol):
    """A sum over sources on a backend, which is sampled at any accuracy. The accuracy scale says
    how accurately: larger is more accurate (`VariableAccuracy`)."""

    @property
    def backend(self) -> Backend: ...

    @property
    def coarsest_accuracy(self) -> float:
        """The accuracy scale of the coarsest samples."""
        ...

    def sample(self, p: Vec3, detail: Real) -> Sample:
        """The sample of the sum at p.

        detail: the accuracy scale: 0 gives the coarsest samples, 1 those of `Field.evaluate`, a
            larger number more accurate ones.
        """
        ...


class SourceSum(BatchedField):
    """A field that is a sum over sources, such as dipoles. The sum is on a backend, and is sampled
    at any accuracy (`SumData`). There may be two sums, one for tracing rays, and one for values at
    large numbers of points (`values_at`). Subclasses define `_ray_data`."""

    traits = Traits(has_variable_accuracy=True)

    @abc.abstractmethod
    def _ray_data(self, backend: Backend, plan: Plan) -> SumData:
        """The sum for tracing rays on a backend, which is uploaded once (`cached_upload`)."""

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> SumEvaluator:
        return SumEvaluator(self, self._ray_data(backend, plan))


class SumEvaluator(BatchedEvaluator):
    """The evaluator of a `SourceSum`.

    field: the field.
    data: the sum for tracing rays.
    """

    def __init__(self, field: SourceSum, data: SumData) -> None:
        self.field, self.data = field, data
        if field.traits.has_variable_accuracy:
            at = functools.partial(_SumAtAccuracy, field, data)
            self.variable_accuracy = VariableAccuracy(at, data.coarsest_accuracy)

    def evaluate(self, p: Vec3) -> Sample:
        return self.data.sample(p, self.data.backend.Float(1))


@dataclass(frozen=True, eq=False)
class _SumAtAccuracy(Evaluator):
    """A sum over sources, sampled at one accuracy scale, with second derivatives.

    field: the field.
    data: the sum for tracing rays.
    detail: the accuracy scale; larger is more accurate.
    """

    field: BatchedField
    data: SumData
    detail: Real

    def evaluate(self, p: Vec3) -> Sample:
        return self.data.sample(p, self.detail)

    def differentiable_value(self, p: Vec3) -> Real:
        moving = self.field.moving_sum(self.data.backend)
        return super().differentiable_value(p) if moving is None else moving.value(p)

    def differentiable_gradient(self, p: Vec3) -> Vec3 | None:
        moving = self.field.moving_sum(self.data.backend)
        return super().differentiable_gradient(p) if moving is None else moving.gradient(p)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return _required_hessian(self._values(p)).rows(backend_of(p).Array3f)

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        return sample.gradient_error, self._values(p).hessian_error

    def _values(self, p: Vec3) -> PointValues:
        """Values of f at points p, with the Hessian."""
        real = self.data.backend.Float
        # The accuracy scale of `values_at` must be at least 1.
        return self.field.values_at(p, 2, fmax(real(self.detail), real(1)))


def has_moving_numbers(field: Field, points: Any) -> bool:
    """Whether Dr.Jit points, or parameters of a field, have derivatives enabled."""
    return any(map(dr.grad_enabled, (points, *differentiable_parameters(field))))


def _differentiable_value(field: BatchedField, p: Vec3) -> Real:
    """The values of a field at points p, as an expression that Dr.Jit can differentiate once with
    respect to p. Its derivative is the gradient of `sharp_values_at`."""
    with dr.suspend_grad():
        at = field.sharp_values_at(dr.detach(p))
    # Dr.Jit would drop a gradient that is the literal 0, such as that of a closed mesh, and with it
    # the dependence on p. A kernel parameter is no literal.
    return dr.replace_grad(at.value, dr.dot(as_kernel_parameters(at.gradient), p - dr.detach(p)))


def _required_hessian(values: PointValues) -> SymmetricMatrix:
    """The Hessian in `values`, which must have been computed with second derivatives.

    Raises:
        RuntimeError: they were computed without second derivatives.
    """
    if values.hessian is None:
        raise RuntimeError("values_at(x, 2) gave no Hessian")
    return values.hessian


Upload = TypeVar("Upload", bound=Callable[..., Any])
Value = TypeVar("Value")

# The largest number of uploads of a field, for other backends or arguments, that `cached_upload`
# keeps.
_MAX_UPLOADS = 16
_NOT_UPLOADED = object()


class FieldCache(Generic[Value]):
    """A cache that keeps one value for each field, together with the key for which the value was
    made. If the value is requested for another key, it is made again and replaced. It is dropped
    when the field is deleted.

    A value must not refer to its field, or neither of them would ever be deleted.
    """

    def __init__(self) -> None:
        # For each field, by its identity (`id`): the key, the field's attributes when the value was
        # made, and the value. (A user's field may have no hash, or equal another one.)
        self._kept: dict[int, tuple[Any, dict[str, Any], Value]] = {}

    def get(self, field: Field, key: Any, make: Callable[[], Value]) -> Value:
        """The value of a field for this key. It is the cached value if that was made for the same
        key, and no attribute of the field was set since then. Otherwise it is the result of make(),
        which is then cached. (A value that is the field itself is not cached, as it would keep the
        field alive.) Attributes that are cached properties do not count, because they follow from
        the others."""
        if id(field) in self._kept:
            kept_key, attributes, value = self._kept[id(field)]
            now = _set_attributes(field)
            same = attributes.keys() == now.keys()
            # Attributes are compared by identity: it is fast, and arrays have no single truth value
            # of ==.
            if same and kept_key == key and all(attributes[name] is now[name] for name in now):
                return value
        value = make()
        if value is not field:
            if id(field) not in self._kept:
                # Drop the value when the field is deleted, if it is still there (None: no error if
                # not), but not at the end of the program.
                finalize(field, self._kept.pop, id(field), None).atexit = False
            self._kept[id(field)] = key, _set_attributes(field), value
        return value


def _set_attributes(field: Field) -> dict[str, Any]:
    """The attributes of a field without those that are cached properties of its class."""
    kind = type(field)
    return {
        name: value
        for name, value in vars(field).items()
        if not isinstance(getattr(kind, name, None), functools.cached_property)
    }


def cached_upload(upload: Upload) -> Upload:
    """Decorator of a field's method that uploads data to a backend, such as `_upload(self, backend,
    *, traced)`. The decorated method uploads only once for each field, backend and arguments, as
    long as no attribute of the field is set. Of uploads with many different arguments the last
    ones are kept.

    The arguments are hashable. The data must not refer to the field, or neither of them would ever
    be deleted.

    A field with parameters is uploaded at each call: a parameter may change in place, and its
    derivatives belong to a single trace. But not if its class says `copies_parameters`: the data
    are of copies without derivatives, which the constructor made.

    The decorated method raises a RuntimeError if it would have to upload while a loop is recorded,
    when Dr.Jit might end the process.
    """
    # For each field the data by backend and arguments, in the order of their last use.
    cache: FieldCache[dict[Any, Any]] = FieldCache()

    @functools.wraps(upload)
    def cached(self: Field, backend: Backend, *arguments: Any, **settings: Any) -> Any:
        """The data: the cached ones, unless the field has parameters."""
        if not getattr(self, "copies_parameters", False) and differentiable_parameters(self):
            _refuse_while_recording(self)
            return upload(self, backend, *arguments, **settings)
        uploads = cache.get(self, None, dict)
        key = backend, arguments, tuple(sorted(settings.items()))
        data = uploads.pop(key, _NOT_UPLOADED)
        if data is _NOT_UPLOADED:
            _refuse_while_recording(self)
            data = upload(self, backend, *arguments, **settings)
        uploads[key] = data
        while len(uploads) > _MAX_UPLOADS:
            del uploads[next(iter(uploads))]
        return data

    cast("Any", cached).is_cached_upload = True  # `keeps_uploads` asks for it
    return cast("Upload", cached)


def _refuse_while_recording(field: Field) -> None:
    """Raise RuntimeError if Dr.Jit records a loop, because then nothing can be uploaded."""
    if dr.flag(dr.JitFlag.SymbolicScope):
        name = type(field).__name__
        raise RuntimeError(
            f"the data of {with_article(name)} cannot be uploaded while a kernel is recorded: let "
            "the field that uses it hold it as an attribute, or in an attribute that is a list, "
            "tuple, dictionary or dataclass, and call evaluate(p) of it; or, in a loop of your "
            "own, call that of evaluator = field.evaluator(backend), made before the loop"
        )


def keeps_uploads(field: Field) -> bool:
    """Whether the data of a field on a backend are cached (`cached_upload`). Then they, and the
    function, do not change unless an attribute of the field is set."""
    upload = getattr(type(field), "_upload", None)
    return hasattr(upload, "is_cached_upload") and not differentiable_parameters(field)
