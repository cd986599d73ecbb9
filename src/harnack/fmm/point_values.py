"""Values of a sum over sources at points, with its derivatives and bounds of their errors; and
gradients that are summed as accurately as an estimate of their error demands. Far clusters of
sources are approximated as one source, which causes a truncation error."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.arrays import as_kernel_parameters
from harnack.backend.elementary import fmax

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Real, Vec3

# A bound of the rounding of the sums of dipoles' moments, as a fraction of the total weight. The
# sums are made in double precision.
_MOMENT_ROUNDING = 32 * 2.0**-53


class LoopRecord:
    """A frozen dataclass of numbers that a recorded loop updates. The state of such a loop consists
    of tuples, so that records are converted to tuples and back."""

    def to_state(self) -> tuple[Any, ...]:
        """The attributes in the order of the constructor, as a tuple; an attribute that is such a
        record becomes a tuple, too. Sums that were not requested are None, and not arrays of zeros:
        Dr.Jit records a loop a second time if an array of its state never changes."""
        values = vars(self).values()
        return tuple(
            value.to_state() if isinstance(value, LoopRecord) else value for value in values
        )

    def with_state(self, state: tuple[Any, ...]) -> Self:
        """The record of the same structure as this one that `to_state` turned into `state`."""
        pairs = zip(vars(self).values(), state, strict=True)
        attributes = (
            old.with_state(new) if isinstance(old, LoopRecord) else new for old, new in pairs
        )
        return type(self)(*attributes)


@dataclass(frozen=True)
class SymmetricMatrix(LoopRecord):
    """A symmetric 3 x 3 matrix in each lane, as a record of its six entries xx, yy, zz, xy, xz, yz.
    Loops that add up such matrices (Hessians) keep it in their state."""

    xx: Real
    yy: Real
    zz: Real
    xy: Real
    xz: Real
    yz: Real

    @classmethod
    def zero(cls, real: Any) -> SymmetricMatrix:
        """The matrix of zeros.

        real: the type of its entries, such as a Dr.Jit Float.
        """
        return cls(*(real(0) for _ in range(6)))

    def add_outer_product(self, u: Vec3, v: Vec3) -> SymmetricMatrix:
        """This matrix plus the symmetric matrix (u v^T + v u^T)/2."""
        half = 0.5 * v
        return SymmetricMatrix(
            dr.fma(u.x, v.x, self.xx),
            dr.fma(u.y, v.y, self.yy),
            dr.fma(u.z, v.z, self.zz),
            self.xy + dr.fma(u.x, half.y, u.y * half.x),
            self.xz + dr.fma(u.x, half.z, u.z * half.x),
            self.yz + dr.fma(u.y, half.z, u.z * half.y),
        )

    def components(self) -> tuple[Real, ...]:
        """The six entries in the order of the constructor, as a tuple for the state of a loop."""
        return self.xx, self.yy, self.zz, self.xy, self.xz, self.yz

    def rows(self, vector: Any) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the matrix.

        vector: the type of a row, a Dr.Jit 3-vector.
        """
        return (
            vector(self.xx, self.xy, self.xz),
            vector(self.xy, self.yy, self.yz),
            vector(self.xz, self.yz, self.zz),
        )


@dataclass(frozen=True)
class PointValues:
    """The value of a field's function f at points and, if requested, its gradient and Hessian, with
    bounds of their truncation and rounding errors. All are Dr.Jit arrays, with one point per lane.

    error: a bound of the error of `value`.
    gradient, hessian: None if they were not requested.
    gradient_error: a bound of the error of `gradient`, as a length.
    hessian_error: a bound of the error of the second derivative along any line, which is the
        spectral norm of the Hessian's error.
    """

    value: Real
    error: Real
    gradient: Vec3 | None = None
    hessian: SymmetricMatrix | None = None
    gradient_error: Real = 0.0
    hessian_error: Real = 0.0

    def with_far_field_errors(self, x: Vec3, terms: int, weight: float) -> PointValues:
        """The same values, with error bounds that also hold at points far away from the field's
        data. These values are a sum over dipoles.

        x: the points, in coordinates in which the field's data have a size of about 1.
        terms: the number of terms that were summed.
        weight: the sum of the absolute weights of all dipoles (the factors of their values).

        Two errors matter only far away. First, a term of a derivative is the product of a factor
        that falls like |x|^-5 and one that grows like |x|^2, and the first may underflow. Second,
        where dipoles nearly cancel, the rounding of their summed moments is proportional to the
        weight of all dipoles, not to the small sum.
        """
        smallest = float(dr.smallest(type(x.x)))
        underflow = 4 * smallest * terms * (1 + dr.squared_norm(x))
        # Nearer than 4 the second error does not matter, so |x| counts as at least 4.
        inverse = dr.rcp(fmax(dr.norm(x), type(x.x)(4)))
        moment_error = _MOMENT_ROUNDING * weight * dr.square(inverse)
        # `inverse` is 1/r with r = |x|. Derivatives of 1/r^2 are 2/r^3 and 6/r^4; the factors 4 and
        # 24 are larger, to spare.
        return dataclasses.replace(
            self,
            error=self.error + underflow + moment_error,
            gradient_error=self.gradient_error + underflow + 4 * moment_error * inverse,
            hessian_error=self.hessian_error + underflow + 24 * moment_error * dr.square(inverse),
        )

    def rescaled(self, size: Real) -> PointValues:
        """The values of the scaled function g(x) = f(x / size) at the points `size` times x, from
        these values of f at x. Where a number has overflowed, its error is infinite."""
        gradient, hessian, inverse = self.gradient, self.hessian, 1 / size
        gradient_error, hessian_error = self.gradient_error, self.hessian_error
        if gradient is not None:
            gradient = gradient * inverse
            is_finite = dr.isfinite(gradient.x) & dr.isfinite(gradient.y) & dr.isfinite(gradient.z)
            # By the chain rule derivatives of order k are divided by size^k.
            gradient_error = dr.select(is_finite, gradient_error * inverse, dr.inf)
        if hessian is not None:
            hessian = type(hessian)(*(inverse * inverse * entry for entry in hessian.components()))
            is_finite = dr.isfinite(sum(hessian.components()))
            hessian_error = dr.select(is_finite, hessian_error * (inverse * inverse), dr.inf)
        error = dr.select(dr.isfinite(self.value), self.error, dr.inf)
        return PointValues(self.value, error, gradient, hessian, gradient_error, hessian_error)


# Accuracy scales at which the gradient of a sum over a tree is computed again: multiples of the
# distance from which on a cluster is taken as one source. The next scale is used if the last one
# changed the gradient by more than the fraction `_MAX_CHANGE` of its length. (Measured: twice the
# distance leaves a sixteenth of the error or less. So the remaining error is below 1 % of the
# length, with a reserve of a factor of four.)
_DISTANCE_MULTIPLES, _MAX_CHANGE = (2.0, 4.0, 8.0), 0.04
# A gradient is not refined if its error is proved to be at most this fraction of its length.
_ACCEPTED_ERROR = 0.01


def sharpened(at: Callable[[Vec3, Real], PointValues], x: Vec3) -> PointValues:
    """Values and gradients of a sum over a tree at points x, where gradients are summed so
    accurately that their errors are about 1 % of their lengths.

    at: a function that takes points and an accuracy scale, and returns values and gradients there.
        The scale multiplies the distance from which on a cluster of sources counts as one source.
        The values are those for the scale 1; for the gradients the scale is raised where needed.

    Far terms may nearly cancel, as the triangles of a mesh with small holes do. Then the gradient
    is far smaller than the truncation errors of its clusters. Proved bounds of these errors add up
    absolute values, and would demand that all terms are summed nearly everywhere. So the observed
    change of the gradient from one scale to the next decides whether to refine it further. The
    error bounds that are returned stay proved.
    """
    real = cast("Any", type(x.x))
    dr.eval(x)
    # The scale is a kernel parameter, so that all scales use the same compiled kernel.
    values = at(x, dr.opaque(real, 1.0))
    gradient, error = as_kernel_parameters(values.gradient), real(values.gradient_error)
    # Adding zeros gives arrays of full width, one number per lane, which can be scattered into.
    gradient, error = gradient + dr.zeros(type(x), dr.width(x)), error + dr.zeros(real, dr.width(x))
    dr.eval(values.value, values.error, gradient, error)
    # The indices of the points whose gradient is to be refined.
    # (Written with ~, so that NaN counts as not accurate.)
    rows = dr.compress(~(error <= _ACCEPTED_ERROR * dr.norm(gradient)))
    # closer: a larger and larger accuracy scale.
    for closer in _DISTANCE_MULTIPLES:
        if not len(rows):
            break
        points = dr.gather(type(x), x, rows)
        dr.eval(points)
        refined = at(points, dr.opaque(real, closer))
        change = dr.norm(refined.gradient - dr.gather(type(x), gradient, rows))
        length = dr.norm(as_kernel_parameters(refined.gradient))
        # Accurate enough by the observed change, or by the proved bound.
        is_accurate = (change <= _MAX_CHANGE * length) | (
            refined.gradient_error <= _ACCEPTED_ERROR * length
        )
        dr.scatter(gradient, refined.gradient, rows)
        dr.scatter(error, refined.gradient_error, rows)
        dr.eval(gradient, error, is_accurate)
        rows = dr.gather(type(rows), rows, dr.compress(~is_accurate))
        dr.eval(rows)
    return dataclasses.replace(values, gradient=gradient, gradient_error=error)
