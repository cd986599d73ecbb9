"""The class `Evaluator`: the function f of a field, ready to be sampled on a backend (a Dr.Jit
device and precision). A field describes f, by formulas and data; `Field.evaluator` uploads what is
needed, and what it returns computes. All functions of the library sample f by evaluators.

An evaluator is made before a kernel is recorded, because nothing can be uploaded during the
recording; its methods are called while one is being recorded.
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.arrays import as_kernel_parameters
from harnack.enclosures.samples import validate_samples

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Mask, Real, Vec3
    from harnack.enclosures.samples import Ray, RaySample, Sample
    from harnack.fields.capabilities import Jumps, ModuloOne, Patches, VariableAccuracy
    from harnack.tree.empty_space import OccupancyGrid

__all__ = ["EvaluateOnly", "Evaluator", "Plan"]


@dataclass(frozen=True)
class Plan:
    """What an evaluator will be used for. A field may prepare other data for it, such as cells for
    many rays. Whatever the plan, the function is the same, up to the error bounds of its samples.

    levels: the levels whose level sets are traced; () if f is only sampled at points.
    ray_count: the number of rays that are traced, or of points at which f is sampled; 0 if it is
        not known. For many, a longer preparation may save time.
    """

    levels: tuple[float, ...] = ()
    ray_count: int = 0


POINTS = Plan()
"""The plan of an evaluator that samples f at points."""


class Evaluator(abc.ABC):
    """A function f on R^3 that is sampled on a backend. A sample at a point holds value and
    gradient of f there, and promises: proved bounds of f near the point. Points p are Dr.Jit
    3-vectors of the backend, one point per lane. Data on the backend are attributes.

    Subclasses define `evaluate`. The class attributes say what else f can do; they are None for
    most fields.
    """

    jumps: Jumps | None = None
    """The facets across which f jumps."""

    modulo_one: ModuloOne | None = None
    """How f is sampled up to an unknown integer."""

    patches: Patches | None = None
    """The patches of a surface that is a union of many level sets, each of a function of its
    own."""

    variable_accuracy: VariableAccuracy | None = None
    """How f is sampled with different accuracy; None if it has a single one."""

    is_steep: bool = False
    """Whether f may change by any amount within the tolerance of a hit. This is so if |grad f| may
    be unbounded in a bounded box, or if its bound is so large that f may change by any amount
    within the rounding of coordinates. The tracer then also samples f behind the hit."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Wrap the `evaluate` of a new subclass, so that what it returns is checked."""
        super().__init_subclass__(**kwargs)
        if "evaluate" in vars(cls):
            checked: Any = validate_samples(cls.evaluate)
            cls.evaluate = checked

    @property
    def name(self) -> str:
        """The name of the field's class, for messages. The default takes it from the name of the
        evaluator's class: a `Tube` is evaluated by a `_TubeEvaluator`."""
        return type(self).__name__.strip("_").removesuffix("Evaluator")

    @abc.abstractmethod
    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p. It is called while a loop is being recorded. So use `drjit` functions
        of p, and no Python branches on its values."""

    def evaluate_where(self, p: Vec3, active: Mask) -> Sample:
        """The sample at p on active lanes, and anything on others. The default evaluates f on all
        lanes. An evaluator to which some points cost far more than others overrides this."""
        del active
        return self.evaluate(p)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the point of a ray with parameter t, and enclosures: intervals that are
        proved to hold the change of f along the ray, in front of that point and behind it.

        path: the ray.
        ahead, back: the lengths of ray in front of and behind the point up to which enclosures are
            useful. An enclosure may hold on a shorter length, if it is sharper there.

        The default evaluates f at that point. The enclosures follow from the promises of the
        sample (proved bounds of f near the point) and from the slope of f along the ray. An
        evaluator that knows more about f along a ray than in all directions overrides this.
        """
        del ahead, back
        return path.enclose(self.evaluate(path.point(t)))

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The rows of the symmetric matrix of second derivatives at p, in units of f per length
        squared. Curvatures and second-order distances use it; tracing does not.

        Raises:
            NotImplementedError: the class does not define it, as this default.
        """
        del p
        raise NotImplementedError(
            f"{self.name} gives no second derivatives: define its method hessian(p), or "
            'ask for what needs none, such as signed_distance(..., method="first_order")'
        )

    def differentiable_gradient(self, p: Vec3) -> Vec3 | None:
        """grad f at p as an expression that Dr.Jit can differentiate with respect to p and to the
        parameters of the field; None where that is not known, so that derivatives of gradients and
        normals are refused. The default knows p alone, by `hessian`: a class whose
        `differentiable_value` has derivatives by parameters overrides both."""
        with dr.suspend_grad():
            point = dr.detach(p)
            try:
                rows = self.hessian(point)
            except NotImplementedError:
                return None
            gradient = self.evaluate(point).gradient
        # `moved` is 0, and its derivative is that of p.
        moved = p - point
        return gradient + type(p)(*(dr.dot(row, moved) for row in rows))

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """Two error bounds at the point p of a sample: of the gradient, as a length, and of
        `hessian`, in the spectral norm. The default for the gradient is the sample's
        `gradient_error`. For the Hessian it is infinity, because its error is not known."""
        del p
        return sample.gradient_error, math.inf

    def gradient_change_bound(self, p: Vec3, radius: Real) -> Real:
        """A proved bound of |grad f(y) - grad f(p)| for all y with |y - p| <= radius. It is
        infinite, which is the default, if none is known. With it, meshing proves that a mesh has
        the topology of the surface."""
        return 0 * p.x + radius + dr.inf

    def occupied_cells(self) -> OccupancyGrid | None:
        """A grid of cells, in which some cells are marked as occupied. All other cells are proved
        to contain no point of the level sets of the levels of the plan. None if no such grid is
        known.

        The default is None. Searches for first hits skip the cells that are not occupied. This
        saves time for fields that are expensive to evaluate. If f jumps across facets, there is a
        second condition: in a cell that is not occupied, f continued smoothly across the facets
        takes no level either.
        """
        return None

    def differentiable_value(self, p: Vec3) -> Real:
        """f(p) as an expression that Dr.Jit can differentiate with respect to p and to the field's
        parameters.

        With respect to p it can be differentiated once: its derivative is the gradient of the
        sample. So no derivative by p passes through `evaluate`, which may run a recorded loop. This
        holds at ties of a formula, too (points where the two arguments of a maximum or minimum are
        equal). Derivatives by parameters pass through `evaluate`; an evaluator of a field with
        parameters overrides this method if that runs a loop.
        """
        at = dr.detach(p)
        sample = self.evaluate(at)
        # Dr.Jit would drop a gradient that is the literal 0, and with it the dependence on p. A
        # kernel parameter is no literal.
        gradient = as_kernel_parameters(dr.detach(sample.gradient))
        # The value of the first argument with the derivative of the second one. `at` is p without
        # derivatives, so p - at is 0 and has the derivative 1.
        return dr.replace_grad(sample.value, sample.value + dr.dot(gradient, p - at))


class EvaluateOnly(Evaluator):
    """An evaluator that consists of its method `evaluate` only. It is the simplest result of
    `VariableAccuracy.at`, of `Jumps.continuation` and of `Patches.patch`.

    evaluate: a function that takes a point p, a Dr.Jit 3-vector, and returns the `Sample` there.

    Raises TypeError if it is not a function.
    """

    def __init__(self, evaluate: Callable[[Vec3], Sample]) -> None:
        if not callable(evaluate):
            raise TypeError(
                "evaluate must be a function that takes a Dr.Jit 3-vector and returns a "
                f"harnack.fields.Sample, not {evaluate!r}"
            )
        self._evaluate = evaluate

    def evaluate(self, p: Vec3) -> Sample:
        return self._evaluate(p)
