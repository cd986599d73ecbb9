"""The winding number w of oriented points with a screened kernel: the influence of a point falls
off exponentially beyond the screening length l. An oriented point, or *dipole*, has a position, a
unit normal and the area for which it stands. The kernel is the Yukawa potential K = exp(-kappa
r)/r, kappa = 1/l. The numbers Q_m bound its derivatives: the m-th derivative along lines is at most
m! Q_m/r^(m+1). In unit coordinates the points have a size of about one.

- `ScreenedWindingNumber`: the field.
- `YukawaKernel`: its kernel, with the proof of its bounds.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, backend_of
from harnack.backend.elementary import fmax, fmin
from harnack.backend.validation import as_positive, check_no_derivatives
from harnack.cluster.serialization import TransientCache
from harnack.enclosures import HarmonicBall, TaylorRemainder
from harnack.fields.attached_arrays import plain_array
from harnack.fields.batched_fields import SourceSum, cached_upload
from harnack.fields.clearance import tight_extent
from harnack.fields.field import Sample
from harnack.fields.solid_angles.oriented_points import OrientedPoints, check_estimates
from harnack.fmm.moving_dipoles import MovingDipoles
from harnack.fmm.point_values import PointValues
from harnack.fmm.radial_kernel import (
    BALL_FRACTION,
    KernelValues,
    RadialKernel,
    RadialSums,
)
from harnack.fmm.radial_tree import (
    ClusteredDipoles,
    DirectSum,
    RadialSum,
    RadialTreecode,
)
from harnack.fmm.source_sums import SECOND_ROUNDINGS, SLOPE_ROUNDINGS, SUM_MARGIN, SourceSums
from harnack.fmm.treecode import dipole_records
from harnack.fmm.unit_frame import UnitFrame, center_and_size, coordinate_rounding, frame_parameters
from harnack.geometry.clouds import estimate_areas, validate_cloud
from harnack.geometry.meshes import validate_mesh
from harnack.name_suggestions import did_you_mean

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.evaluator import Plan
    from harnack.geometry import Volume

MAX_LENGTHS = 80.0
"""At distances rho beyond this many screening lengths, exponentials are set to exp(-80) = 2e-35, as
single precision holds hardly any smaller numbers. Bounds are then too large, and values off by less
than 1e-33 area/(4 pi rho^2)."""

# The factor that makes the harmonic ball smaller where the kernel falls fast.
_BALL_SHRINKAGE = 0.1
# The moments of a cluster are never used nearer than this many radii.
_MIN_ACCEPTANCE = 1.5
# For the default level w is computed at several points. These bound the number of pairs of a point
# and a dipole, and the number of points, which has a largest and a smallest value.
_MAX_LEVEL_PAIRS, _MAX_LEVEL_POINTS, _MIN_LEVEL_POINTS = 8_000_000, 512, 24


class YukawaKernel(RadialKernel):
    """The kernel K = exp(-kappa rho)/rho on a backend, where rho is the distance from a dipole and
    kappa is one over the screening length. psi_0 = K, psi_(k+1) = -psi_k'/rho. The numbers Q_m
    bound its derivatives: the m-th derivative along lines is at most m! Q_m/rho^(m+1).

    Kernel. K(rho) = exp(-kappa rho)/rho is the Yukawa potential: Delta K = kappa^2 K away from 0.
    One has psi_k = theta_k(kappa rho) exp(-kappa rho)/rho^(2k+1), where theta_0 = 1, theta_1 = 1 +
    t, theta_k = (2k-1) theta_(k-1) + t^2 theta_(k-2) are the reverse Bessel polynomials: sums of
    positive terms, which lose no digits for any t. A dipole m at y = x + z gives

        -m.grad_y K = m.z psi_1 = (1 + kappa rho) exp(-kappa rho) m.z/rho^3.

    Bound. |d^m K[u_1, ..., u_m]| <= |K^(m)(rho)| for unit vectors: a derivative of K along a line
    is no larger than along the line to its pole. Proof: d^m K is a symmetric form, so equal vectors
    u are the worst (Banach 1938). Write s^m as sum_j b_mj P_j(s) in Legendre polynomials, b_mj >=
    0; then (u.grad)^m = sum_j b_mj |grad|^(m-j) Y_j(grad) with j = m, m-2, ... and solid harmonics
    Y_j about u. Applied to K, |grad|^2 is kappa^2, and Y_j(grad) K = (-1)^j psi_j Y_j(z) = (-1)^j
    rho^j psi_j P_j(cos) (Hobson 1892), with cos the cosine of the angle between u and z. Every
    coefficient has the sign (-1)^m, and |P_j| <= 1 = P_j(1).

        |K^(m)(rho)| = m! Q_m(kappa rho)/rho^(m+1),   Q_m(t) = exp(-t) sum_(j<=m) t^j/j!,

    decreases in rho, as K is completely monotone; Q_m decreases from 1 to 0 and grows with m, and
    Q_m(t - s) <= exp(s) Q_m(t).
    """

    def __init__(self, backend: Backend, kappa: float) -> None:
        """Upload the kernel. kappa: one over the screening length, in the unit of the distances."""
        self._number = kappa
        self.kappa = dr.opaque(backend.Float, kappa)

    def at(self, distance: Real, inverse: Real, last: int) -> KernelValues:
        """The values psi_0, ..., psi_last of the class docstring at the given distance rho. They
        are psi_k = exp(-kappa rho) theta_k(kappa rho)/rho^(2k+1), with polynomials theta_k.

        inverse: 1/distance.
        last: the largest index k.
        """
        # Farther away exponentials are not computed, as they would underflow.
        t = fmin(self.kappa * distance, MAX_LENGTHS)
        # First the factor that all psi_k have in common, beside the powers 1/rho^(2k).
        return KernelValues(dr.exp(-t) * inverse, thetas(t, last))

    def bounds(self, distance: Real, last: int) -> list[Real]:
        """The numbers Q_2(t), ..., Q_last(t) for t = kappa times `distance`, which bound
        derivatives of the kernel at this distance and beyond. Q_m(t) is exp(-t) times the sum of
        t^j/j! over j <= m. last: the largest index m."""
        t = fmin(self.kappa * distance, MAX_LENGTHS)
        decay = dr.exp(-t)
        sum2 = dr.fma(t, dr.fma(t, 0.5, 1), 1)
        sum3 = dr.fma(t * t * t, 1 / 6, sum2)
        factors = [decay * sum2, decay * sum3]
        power = decay * (t * t * t)
        for m in range(4, last + 1):
            power = power * t
            factors.append(dr.fma(power, 1 / math.factorial(m), factors[-1]))
        return factors

    def growth(self, r: Real) -> Real:
        """A factor that bounds how the numbers Q_m of `bounds` grow as the distance shrinks by r:
        at the distance rho - r they are at most this many times as large as at rho."""
        return dr.exp(self.kappa * r)

    def accepting_distance(self, radius: FloatArray, accuracy: float) -> FloatArray:
        """The distances (k,) beyond which k clusters of dipoles may be replaced by their moments.
        radius: (k,) the radii of the clusters. accuracy: the larger it is, the larger are the
        distances."""
        return accepting_distance(radius, self._number, accuracy)


def thetas(t: Real, last: int) -> list[Real]:
    """The values theta_0(t), ..., theta_last(t) of the reverse Bessel polynomials: theta_0 = 1,
    theta_1 = 1 + t, theta_k = (2k-1) theta_(k-1) + t^2 theta_(k-2). last: the largest index k."""
    square = t * t
    values: list[Real] = [1.0, 1 + t]
    for k in range(2, last + 1):
        values.append(dr.fma(square, values[k - 2], (2 * k - 1) * values[k - 1]))
    return values


def screened_promises(
    radial: RadialSums, f: Real, gradient: Vec3, kernel: YukawaKernel, size: Real
) -> tuple[tuple[TaylorRemainder, ...], HarmonicBall]:
    """Proved bounds of f, a sum over screened dipoles, near a point x. Returns a tuple of bounds of
    second derivatives, each on a ball around x; and one ball with a range of f, which proves
    shorter steps. `ScreenedWindingNumber` has the proofs.

    radial: the sums at x, in unit coordinates.
    f, gradient: value and gradient of f at x, in unit coordinates.
    kernel: the kernel of the sum.
    size: the length, in the user's unit, that is 1 in unit coordinates. The results are in the
        user's unit.

    kappa is one over the screening length. Radii r stay below 36 screening lengths. So the factor
    exp(kappa r), times sums in which exponentials are at least exp(-80), neither overflows nor
    grows.
    """
    sums, kappa = radial.sums, kernel.kappa
    max_radius = fmin(radial.least_distance, MAX_LENGTHS / kappa)
    promises = radial.curvatures(kernel.growth, max_radius, size)
    # The radius R of the ball with a range. S is the smaller of two bounds of the change of f.
    r = BALL_FRACTION * max_radius / dr.fma(_BALL_SHRINKAGE * kappa, max_radius, 1)
    growth = kernel.growth(r)
    slope = dr.norm(gradient) + sums.gradient_truncation
    change_by_taylor = (
        (1 + SUM_MARGIN) * r * dr.fma(r, radial.remainder(BALL_FRACTION, r, growth), slope)
    )
    max_change = fmin(radial.variation(r, growth), change_by_taylor)
    # The values on the ball in four dimensions are products of a number in [f - S, f + S] and a
    # cosine in [min_cosine, 1]: they lie between the products of the ends of these intervals.
    min_cosine = dr.cos(fmin(kappa * r, math.pi))
    ends = (f - max_change, f + max_change)
    products = [end * min_cosine for end in ends]
    lower, upper = fmin(ends[0], products[0]), fmax(ends[1], products[1])
    # A negative cosine exchanges the ends of the interval.
    lower, upper = fmin(lower, products[1]), fmax(upper, products[0])
    return promises, HarmonicBall(r * size, lower, upper, dimension=4)


def accepting_distance(radius: FloatArray, kappa: float, accuracy: float) -> FloatArray:
    """The distances (k,) beyond which k clusters of screened dipoles may be replaced by their
    moments: for a cluster of radius R, the smallest r with accuracy R Q_4(kappa (r-R))^(1/5) <= r.
    Here Q_4 bounds fourth derivatives (`YukawaKernel`).

    radius: (k,) the radii R.
    kappa: one over the screening length.
    accuracy: the larger it is, the larger are the distances.

    Why this distance: for each unit of area, clusters of radius R on a surface cost 1/R^2 and have
    an error of R^3/r^5 Q_4. The sum of errors is smallest at a fixed cost if R is proportional to r
    Q_4^(-1/5). r is computed by bisection, and is never too small.
    """
    low, high = _MIN_ACCEPTANCE * radius, accuracy * radius
    for _ in range(40):
        r = 0.5 * (low + high)
        t = kappa * (r - radius)
        q4 = np.exp(-t) * (1 + t * (1 + t / 2 * (1 + t / 3 * (1 + t / 4))))
        is_accepted = accuracy * radius * q4**0.2 <= r
        low, high = np.where(is_accepted, low, r), np.where(is_accepted, r, high)
    return high + 1e-5  # not 0 for a cluster of radius 0


def mean_at_dipoles(rows: FloatArray, kappa: float) -> float:
    """The mean, weighted by area, of the screened winding number w at the positions of the dipoles,
    or of some of them if there are many. The value at a position leaves out the dipoles at the
    position itself.

    rows: (n, 8) the records of the dipoles: position, moment, area, 0.
    kappa: one over the screening length.
    """
    n = len(rows)
    count = min(n, max(_MIN_LEVEL_POINTS, min(_MAX_LEVEL_POINTS, _MAX_LEVEL_PAIRS // n)))
    # The dipoles at whose positions w is computed, evenly spaced in the order of the records.
    probes = np.unique(np.linspace(0, n - 1, count).astype(np.int64))
    x, y, z, *moment = np.ascontiguousarray(rows[:, :6].T)
    values: list[float] = []
    for i in probes:
        d = (x - x[i], y - y[i], z - z[i])
        square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        # Dipoles at the position itself, too, get weight 0.
        is_apart = square > 0
        rho = np.sqrt(np.where(is_apart, square, 1))
        weight = np.where(is_apart, (1 + kappa * rho) * np.exp(-kappa * rho) / rho**3, 0)
        product = moment[0] * d[0] + moment[1] * d[1] + moment[2] * d[2]
        values.append(float(product @ weight))
    return float(np.average(values, weights=rows[probes, 6]))


MethodName = Literal["auto", "sum", "tree"]

# The largest number of dipoles for which the direct sum is faster than a tree.
_MAX_SUMMED = 2000
# The largest number of cells that are tested in one round for an extent.
_MAX_CELLS = 4096
# Levels smaller than this in magnitude are not told from 0.
_SMALLEST_LEVEL = 1e-20
# A point nearer to a dipole than `_ON_DIPOLE` roundings counts as on it. There w may be any number
# up to `_ANY_LEVEL`.
_ON_DIPOLE, _ANY_LEVEL = 32, 1e5


class ScreenedWindingNumber(OrientedPoints, SourceSum):
    """The screened winding number w of oriented points y_i, as a field: w(x) = (1/4 pi) sum_i a_i
    n_i.(y_i - x) (1 + rho_i/l) exp(-rho_i/l)/rho_i^3, rho_i = |y_i - x|. Points y_i with unit
    normals n_i, also called dipoles, stand for areas a_i of a surface, and l is the screening
    length.

    A term is minus the derivative of the Yukawa kernel exp(-rho/l)/rho along n_i at y_i. As l
    grows, w becomes the winding number of the points (Barill et al. 2018). The kernel is sometimes
    written without the factor 1 + rho/l; then w would solve no screened equation. Away from the
    points

        Laplacian w = w/l^2:   w is not harmonic.

    Meaning. For dense samples of a closed surface with outward normals, w is 1 - u inside and -u
    outside. Here u, between 0 and 1, is the blurred indicator of the inside: u - l^2 Laplacian u is
    1 inside and 0 outside (Green's second identity). So w falls from 1 - u to -u at the surface and
    decays like exp(-distance/l) on both sides. Far points have no effect, holes wider than a few l
    stay open, and deep inside w is near 0 again. The level that lies on the surface is the mean of
    1 - u and -u there: 1/2 for l much larger than the surface, 0 for l much smaller.
    `default_level` is the mean of w, weighted by area, over all points or some of them, where the
    value at a point leaves out its own term; Kazhdan et al. 2006 choose their level in this way. l
    should be longer than the distance between neighboring points: else the level sets are those of
    single dipoles.

    Derivatives. Points, normals and areas may be Dr.Jit arrays (3-vectors of n lanes, arrays of n
    entries) or tensors. Hits, values and gradients can then be differentiated by them
    (`fmm.moving_dipoles`). The default level is held fixed.

    points, normals: (n, 3), normals of any length, to the outside.
    areas: (n,) the areas that the points stand for; None estimates them.
    length: l, in the points' unit.
    method: "sum" (all dipoles), "tree" (clusters of far dipoles), "auto".
    accuracy: for the tree, the moments of a cluster of radius R are used where its screened error
        is as small as that of an unscreened cluster at distance accuracy * R. The error is bounded
        and part of every proved bound. Tracing uses a higher accuracy where the tolerance needs it.

    Promises, proved bounds of w near a point x (`screened_promises` has the formulas). Let d_i be
    the distances of the points from x, and d the smallest of them.

    - `TaylorRemainder` bounds second derivatives. On the ball B(x, r) with r < d, each term's
      second derivatives at distance s from x are at most |K'''|(d_i - s) = 6 Q_3(kappa
      (d_i-s))/(d_i-s)^4, with `YukawaKernel` K and kappa = 1/l. By Taylor the integral of (t-s)
      times that bounds w(y) - w(x) - grad w.(y-x), t = |y-x|. With Q_3(kappa (d_i-s)) <= exp(kappa
      r) Q_3(kappa d_i) and q = t/d_i it is at most exp(kappa r) Q_3(kappa d_i) (3-2q)/(1-q)^2
      t^2/d_i^4. The function (3-2q)/(1-q)^2 is convex, and so at most its chord on [0, r/d].
    - `HarmonicBall` of dimension 4. w(y) cos(s/l) is harmonic in (y, s). For |y-x|^2 + s^2 < R^2 <
      d^2 it is the product of a number in [w(x)-S, w(x)+S] and a number in [cos(min(R/l, pi)), 1].
      So it lies between the smallest and the largest product of the ends of these intervals. S
      bounds the change of w on B(x, R), by the integral of |K''|(d_i-s) = 2 Q_2/(d_i-s)^3, where
      1/(1-q)^2 - 1 = 2q + ... is bounded by its chord, too.

    By default only the first promise is used: it took 14 to 30 evaluations per ray, and the second
    took 20 to 65 (spheres and tori of 270 to 2000 points, l from 0.03 to 100).

    Raises CloudError (a ValueError) as `validate_cloud`; ValueError for an invalid length, method
    or accuracy; NotImplementedError for derivatives that would be lost.
    """

    traits = dataclasses.replace(
        SourceSum.traits, is_larger_inside=True, has_parameter_derivatives=True
    )

    def __init__(
        self,
        points: Any,
        normals: Any,
        areas: Any = None,
        *,
        length: float,
        method: MethodName = "auto",
        accuracy: float = 6.0,
    ) -> None:
        """Validate the points, choose the method, scale the points to unit coordinates, and compute
        the default level.

        points, normals: (n, 3), normals of any length.
        areas: (n,) the areas that the points stand for; None estimates them.
        length: the screening length.
        method: "sum" (all dipoles), "tree" (clusters of far dipoles), or "auto".
        accuracy: for the tree; larger is more accurate.
        """
        super().__init__()
        check_no_derivatives(type(self).__name__, length, method, accuracy)
        length = as_positive(length, "length")
        if method not in ("auto", "sum", "tree"):
            hint = did_you_mean(method, ("auto", "sum", "tree"))
            raise ValueError(f'method is "auto", "sum" or "tree", not {method!r}{hint}')
        if not 2 <= accuracy <= 100:
            raise ValueError(f"accuracy must lie between 2 and 100, not {accuracy!r}")
        name = type(self).__name__
        self.is_estimated = [False, areas is None]  # normals, areas
        arrays = {"points": points, "normals": normals}
        check_estimates(name, arrays, has_normals=True, has_areas=areas is not None)
        points, normals, areas = map(plain_array, (points, normals, areas))
        if areas is None:
            areas = estimate_areas(points, normals)
        self._set_points(*validate_cloud(points, normals, areas))
        self.length, self.accuracy = float(length), float(accuracy)
        is_small = len(self.points) <= _MAX_SUMMED
        self.method: Literal["sum", "tree"] = (
            ("sum" if is_small else "tree") if method == "auto" else method
        )
        has_variable_accuracy = self.method == "tree"
        self.traits = dataclasses.replace(self.traits, has_variable_accuracy=has_variable_accuracy)
        # The size is larger for few points that stand for large areas.
        self._center, self._size = center_and_size(
            self.points.min(axis=0), self.points.max(axis=0), math.sqrt(float(self.areas.max()))
        )
        scale = self.areas[:, None] / (4 * math.pi * self._size**2)
        self._rows = dipole_records((self.points - self._center) / self._size, scale * self.normals)
        self._kappa = self._size / self.length
        self.default_level = mean_at_dipoles(self._rows, self._kappa)
        self._extents: TransientCache[tuple[float, ...], Volume | None] = TransientCache()

    @classmethod
    def of_mesh(
        cls,
        vertices: Any,
        faces: Any,
        *,
        length: float,
        subdivide: int = 0,
        method: MethodName = "auto",
        accuracy: float = 6.0,
    ) -> ScreenedWindingNumber:
        """The field of dipoles at the centroids of the triangles of a mesh, each with the
        triangle's normal and area.

        vertices, faces: (n, 3) and (m, 3), the mesh.
        subdivide: how many times each triangle is cut into 4 triangles first.
        length: the screening length l, in the mesh's unit.
        method: "sum" (all dipoles), "tree" (clusters of far dipoles), or "auto".
        accuracy: for the tree, the larger it is, the farther away clusters must be to count as one
            source (see `ScreenedWindingNumber`).

        This is quadrature by the midpoint rule, not the integral over the triangles. Let R be the
        distance from the centroid to the farthest corner of a triangle of area a and edges of
        lengths e1, e2, e3. At a distance r > R the triangle contributes an error of at most a
        (e1^2+e2^2+e3^2)/36 (3-2q)/((1-q)^2 r^4)/(4 pi) with q = R/r. (The first moment about the
        centroid vanishes; the proof is that of `radial_tree`, with one order less.) Nearer than
        about an edge's length the result is not that of the mesh at all: w is smooth where a
        triangle would make it jump, and infinite at the centroids. Each subdivision divides that
        distance by 2, and the error beyond it by 4.

        Raises MeshError (a ValueError) as `validate_mesh`.
        """
        x, triangles = validate_mesh(vertices, faces)
        if not 0 <= subdivide <= 8:
            raise ValueError(f"subdivide must lie between 0 and 8, not {subdivide!r}")
        corners = x[triangles]
        for _ in range(subdivide):
            a, b, c = np.moveaxis(corners, 1, 0)
            # The midpoints of the sides.
            u, v, w = 0.5 * (b + c), 0.5 * (c + a), 0.5 * (a + b)
            parts = ((a, w, v), (w, b, u), (v, u, c), (u, v, w))
            corners = np.concatenate([np.stack(part, axis=1) for part in parts])
        a, b, c = np.moveaxis(corners, 1, 0)
        normals = 0.5 * np.cross(b - a, c - a)
        areas = np.linalg.norm(normals, axis=1)
        return cls(
            corners.mean(axis=1), normals, areas, length=length, method=method, accuracy=accuracy
        )

    def values_at(self, x: Vec3, derivatives: int, closer: Real = 1.0) -> PointValues:
        """w and its derivatives at points x (3, n) in user coordinates, with error bounds
        (`BatchedField.values_at`).

        derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.
        closer: the accuracy scale; larger is more accurate.
        """
        data = self._upload(backend_of(x))
        x = data.to_unit(x)
        radial = data.dipoles.sums(x, closer, derivatives)
        values = radial.values(x)
        cutoff, slope, second = data.cutoff_errors(radial.sums, coordinate_rounding(x))
        values = dataclasses.replace(
            values,
            error=values.error + cutoff,
            gradient_error=values.gradient_error + slope,
            hessian_error=values.hessian_error + second,
        )
        # The sum of the dipoles' weights in unit coordinates.
        weight = float(self.areas.sum()) / (4 * math.pi * self._size**2)
        # Far away a tree sums fewer than 64 nodes; the direct sum always has all terms.
        terms = 64 if self.method == "tree" else len(self.points)
        return values.with_far_field_errors(x, max(terms, 64), weight).rescaled(data.size)

    def moving_sum(self, backend: Backend) -> MovingDipoles | None:
        """w as a sum over all dipoles, with derivatives by the points, normals and areas
        (`BatchedField.moving_sum`)."""
        frame = UnitFrame(*frame_parameters(backend, self._center, self._size))
        kernel = YukawaKernel(backend, self._kappa)
        return self._moving_dipoles(frame, kernel, 1 / (4 * math.pi))

    def _ray_data(self, backend: Backend, plan: Plan) -> _ScreenedBuffers:
        del plan
        return self._upload(backend)

    @cached_upload
    def _upload(self, backend: Backend) -> _ScreenedBuffers:
        """Copy the kernel and the dipoles to a backend. They are the same for tracing and for
        values at points."""
        kernel = YukawaKernel(backend, self._kappa)
        if self.method == "sum":
            dipoles = DirectSum(backend, self._rows, kernel)
        else:
            dipoles = RadialTreecode(
                backend, ClusteredDipoles.of(self._rows), kernel, self.accuracy
            )
        return _ScreenedBuffers(
            *frame_parameters(backend, self._center, self._size),
            kernel,
            dipoles,
            dr.opaque(backend.Float, float(self._rows[:, 6].sum())),
        )

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for a level that is too small to be told from 0 by its rounding. All
        other levels are valid, as they occur next to every dipole."""
        for level in levels:
            if 0 < abs(level) < _SMALLEST_LEVEL:
                raise ValueError(f"level {level:g} is too small to be told from 0")

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A box proved to contain the level sets; None for level 0, whose surface may be unbounded.

        At distance D from the points |w| <= sum_i w_i Q_1(D/l)/D^2, with w_i = a_i/(4 pi). This
        falls with D, so there is no level beyond the D at which it is the smallest |level|. Cells
        of that box that are proved empty are removed (`tight_extent`).
        """
        return self._extents.get_or_make(levels, lambda: self._extent(levels))

    def _extent(self, levels: tuple[float, ...]) -> Volume | None:
        """Compute the volume that `extent` returns and caches; None for level 0. The distance D of
        the proof is found by bisection, in unit coordinates."""
        min_level = min(abs(level) for level in levels)
        if min_level < _SMALLEST_LEVEL:
            return None
        total = float(self._rows[:, 6].sum())
        # At `high` there is no level, as screening only makes |w| smaller.
        low, high = 0.0, math.sqrt(total / min_level) * 1.001 + 1e-6
        for _ in range(60):
            distance = 0.5 * (low + high)
            t = self._kappa * distance
            may_have_level = total * (1 + t) * math.exp(-t) > min_level * distance * distance
            low, high = (distance, high) if may_have_level else (low, distance)
        distance = 1.001 * high * self._size  # a little larger, for rounding
        lower, upper = self.points.min(axis=0) - distance, self.points.max(axis=0) + distance
        return tight_extent(self, levels, lower, upper, _MAX_CELLS)

    def describe(self) -> dict[str, Any]:
        """Facts about the field for users, as a dictionary of names and values: the number of
        points, the screening length, the default level and the method."""
        return {
            "points": len(self.points),
            "length": self.length,
            "default level": self.default_level,
            "method": self.method,
        }


@dataclass(frozen=True)
class _ScreenedBuffers(UnitFrame):
    """The data of a screened winding number on a backend.

    kernel: the Yukawa kernel, with kappa in unit coordinates.
    dipoles: the sum over the dipoles.
    weight: the sum of the lengths of all moments.
    """

    kernel: YukawaKernel
    dipoles: RadialSum
    weight: Real

    @property
    def coarsest_accuracy(self) -> float:
        """The accuracy scale of the coarsest samples."""
        return 1.0

    def cutoff_errors(self, sums: SourceSums, unit: Real) -> tuple[Real, Real, Real]:
        """Return bounds of three errors, of the value, of the gradient and of second derivatives,
        which screening causes in addition to the errors of plain dipoles. All is in unit
        coordinates.

        sums: the sums at the points.
        unit: the rounding of a coordinate.

        Exponentials are replaced by exp(-80) = 2e-35 where they are smaller (`MAX_LENGTHS`). They
        are multiplied by at most Q_3(80) exp(80) = 9e4. Fourth derivatives of the kernel have
        Q_4(t) <= (1 + t/4) Q_3(t), and a coordinate is off by `unit`: this adds to the error of
        second derivatives.
        """
        # The error of the value is proportional to 1/rho^2; its derivatives to 2/rho^3 and 6/rho^4.
        inverse = dr.rcp(sums.singularity_distance)
        value_error = 2e-30 * self.weight * inverse * inverse
        fourth = 0.25 * self.kernel.kappa * sums.s4
        hessian_error = dr.fma(SECOND_ROUNDINGS * unit, fourth, 6 * value_error * inverse * inverse)
        return value_error, 2 * value_error * inverse, hessian_error

    def sample(self, p: Vec3, detail: Real) -> Sample:
        """A sample of w at points p in user coordinates: value, gradient, errors and proved bounds
        of w near p. At a dipole itself the value is 0 and the gradient is so steep that p counts as
        close to any level.

        detail: the accuracy scale; larger is more accurate.
        """
        x = self.to_unit(p)
        # 1: with gradients.
        screened, epsilon = self.dipoles.sums(x, detail, 1), self.backend.machine_epsilon
        sums, unit = screened.sums, coordinate_rounding(x)
        cutoff, slope, _ = self.cutoff_errors(sums, unit)
        error = sums.truncation + sums.rounding + cutoff
        slope_error = sums.gradient_truncation + dr.fma(SLOPE_ROUNDINGS * unit, sums.s4, slope)
        # At a dipole, up to rounding, f has all values: the sample has a gradient so steep that
        # every level is close, and an error as large as the distance to such a level.
        is_off_dipole = (sums.singularity_distance > _ON_DIPOLE * epsilon) & dr.isfinite(sums.value)
        steep_gradient = self.backend.Array3f(0, 0, _ANY_LEVEL / (_ON_DIPOLE * epsilon))
        value = dr.select(is_off_dipole, sums.value, 0)
        gradient = dr.select(is_off_dipole, sums.gradient, steep_gradient)
        promises, ball = screened_promises(screened, value, gradient, self.kernel, self.size)
        return Sample(
            value,
            gradient / self.size,
            promises,
            dr.select(is_off_dipole, error, _ANY_LEVEL),
            dr.select(is_off_dipole, slope_error / self.size, 0),
            truncation_error=dr.select(is_off_dipole, sums.truncation, 0),
            alternative_promises=(ball,),
        )
