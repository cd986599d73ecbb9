"""Gradient noise and fractal noise as fields, and solids that are displaced by noise. Gradient
noise is a random smooth function: space is cut into the cubic cells of a lattice; each lattice
point has a pseudo-random unit vector; and in a cell the noise interpolates eight linear functions
(ramps), one for each corner, whose gradients are these vectors. The interpolation weights come from
a fade function. Fractal noise is a sum of such noises, the octaves. The lattice of each octave has
half the spacing of the octave before. `NoiseConstants` holds the proved bounds of gradient
noise."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast

import drjit as dr

from harnack.arithmetic import Interval, Jet
from harnack.arithmetic.jet import Dual
from harnack.backend import backend_of
from harnack.backend.elementary import fmax
from harnack.backend.validation import as_finite, as_integer_in_range, as_positive
from harnack.enclosures import Lipschitz, TaylorRemainder
from harnack.fields.attached_numbers import attached, own_formula, with_attached_arguments
from harnack.fields.evaluator import POINTS, Plan
from harnack.fields.formula import Formula, with_device_numbers
from harnack.fields.formula_evaluator import FormulaEvaluator, FormulaFunction, is_jet
from harnack.fields.solids.solid import FormulaSolid, by_numbers
from harnack.name_suggestions import is_one_of

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.enclosures import Promise
    from harnack.fields.number_table import NumberReader
    from harnack.geometry import Volume

Fade: TypeAlias = Literal["quintic", "cubic"]

# The corners of a cell of the lattice: 0 or 1 along each axis. The last axis changes fastest.
CORNERS = tuple(itertools.product((0, 1), repeat=3))


@dataclass(frozen=True)
class NoiseConstants:
    """Bounds of gradient noise and of its derivatives on a lattice of spacing 1, for any unit
    vectors at the lattice points.

    max_abs: a bound of |noise|.
    max_gradient: a bound of |grad noise|.
    max_second_derivative: a bound of the second derivative along any line.

    Proof. Let c run over the corners of a cell. Let w_c be the interpolation weight of the corner
    at x, g_c its unit vector, and r_c = x - c. Then noise is the sum of w_c g_c . r_c. So |noise|
    <= sum w_c |r_c| <= sqrt(sum w_c |r_c|^2). The last sum has one term for each axis: with s(t)
    the fade function, it is (1 - s) t^2 + s (1 - t)^2. Each of them is at most 1/4: s(t) lies below
    the line (1 + 2t)/4 on the first half of the edge, where it is convex. The bound sqrt(3)/2 is
    attained at the cell's center.

    The derivative along v is the sum of g_c . (A_c v) with A_c = w_c I + r_c grad w_c^T. It is at
    most sum |A_c v| <= sqrt(v^T (sum A_c^T A_c / o_c) v) for any weights o_c > 0 whose sum is 1
    (Cauchy and Schwarz). The weights used are proportional to the spectral norms of the A_c. Then,
    on a grid of points of the cell, the root of the largest eigenvalue is at most 2.183 for the
    cubic fade and sqrt(499)/8 = 2.7923 for the quintic fade. Between the points it changes slowly;
    2.2 and 2.82 leave room for that. At the center sqrt(19)/2 = 2.1794 and sqrt(499)/8 are
    attained. Hart's 3 (1996, appendix F) is a bound, but his argument (3/2 of the fade times 2 of
    the vectors) does not prove it: the values of a table have no Lipschitz constant.

    The entry d_ij of the Hessian is bounded in the same way, by a sum over the corners. The largest
    row sum of these bounds is a bound of the spectral norm of the Hessian: 17.64 (cubic) and 24.35
    (quintic) on a grid.
    """

    max_abs: float
    max_gradient: float
    max_second_derivative: float


CONSTANTS: dict[Fade, NoiseConstants] = {
    "cubic": NoiseConstants(math.sqrt(0.75), 2.2, 18.0),
    "quintic": NoiseConstants(math.sqrt(0.75), 2.82, 25.0),
}


def fade(kind: Fade, t: Any) -> tuple[Any, Any, Any]:
    """Return the fade function and its first two derivatives at t, 0 <= t <= 1. The fade function
    is the interpolation weight of the far end of an edge, at the position t from the near end. It
    rises from 0 to 1, with slope 0 at both ends.

    kind: which fade function: "quintic" or "cubic".
    """
    if kind == "cubic":
        # 3 t^2 - 2 t^3
        return t * t * (3 - 2 * t), 6 * t * (1 - t), 6 - 12 * t
    # 6 t^5 - 15 t^4 + 10 t^3 (Perlin 2002)
    rest = 1 - t
    return (
        t * t * t * (10 + t * (6 * t - 15)),
        30 * (t * rest) * (t * rest),
        60 * t * rest * (1 - 2 * t),
    )


def cell_noise(kind: Fade, t: Any, vectors: Any) -> tuple[Any, list[Any], list[Any]]:
    """Gradient noise in a cell: its value, its gradient (3,), and its Hessian (6,), the upper
    triangle row by row.

    kind: the fade function that gives the interpolation weights.
    t: (3,) the position in the cell, each coordinate from 0 to 1.
    vectors: (8,) unit vectors (3,) at the corners, in the order of `CORNERS`.
    """
    weights: list[tuple[tuple[Any, Any], ...]] = []
    # For each axis the weights of the near and of the far end, and their first two derivatives.
    for fraction in t:
        far, far_slope, far_second = fade(kind, fraction)
        weights.append(((1 - far, far), (-far_slope, far_slope), (-far_second, far_second)))
    value: Any = 0.0
    gradient: list[Any] = [0.0] * 3
    hessian: list[Any] = [0.0] * 6

    def weight(corner: tuple[int, ...], orders: list[int]) -> Any:
        """The interpolation weight of a corner, a product of three factors, one for each axis; or a
        derivative of that product.

        corner: 0 or 1 for each axis.
        orders: the order of the derivative along each axis, 0 to 2.
        """
        return (
            weights[0][orders[0]][corner[0]]
            * weights[1][orders[1]][corner[1]]
            * weights[2][orders[2]][corner[2]]
        )

    # The ramp of a corner is the linear function vector . (t - corner).
    for corner, vector in zip(CORNERS, vectors, strict=True):
        # The noise is the sum of weight times ramp; derivatives follow by the product rule.
        ramp = sum(vector[k] * (t[k] - corner[k]) for k in range(3))
        corner_weight = weight(corner, [0, 0, 0])
        value = value + corner_weight * ramp
        weight_slopes = [weight(corner, [int(i == k) for i in range(3)]) for k in range(3)]
        for k in range(3):
            gradient[k] = gradient[k] + (corner_weight * vector[k] + weight_slopes[k] * ramp)
        for m, (i, j) in enumerate(itertools.combinations_with_replacement(range(3), 2)):
            orders = [int(i == k) + int(j == k) for k in range(3)]
            hessian[m] = hessian[m] + (
                weight_slopes[i] * vector[j]
                + weight_slopes[j] * vector[i]
                + weight(corner, orders) * ramp
            )
    return value, gradient, hessian


def lattice_vector(x: Any, y: Any, z: Any, seed: Any, like: Real) -> list[Any]:
    """A pseudo-random unit vector (3,) for a lattice point, the same whenever coordinates and seed
    are the same.

    x, y, z: the integer coordinates of the lattice point, Dr.Jit UInt32.
    seed: a Dr.Jit UInt32; another seed gives other vectors.
    like: a number of the type that the components shall have.
    """
    # A hash function: multiplications and shifts mix the bits.
    h = x * 0x8DA6B343 + y * 0xD8163841 + z * 0xCB1AB31F + seed * 0x9E3779B1
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        h = (h ^ (h >> shift)) * factor
    h = h ^ (h >> 16)
    # Three groups of ten bits become odd numbers of absolute value below 1024: floats represent
    # them exactly, and they are never 0.
    real = cast("Any", type(like))
    parts = [real((h >> (10 * k)) & 1023) * 2 - 1023 for k in range(3)]
    scale = 1 / dr.sqrt(parts[0] * parts[0] + parts[1] * parts[1] + parts[2] * parts[2])
    return [part * scale for part in parts]


@dataclass(frozen=True)
class FractalNoise(FormulaSolid):
    """Fractal noise as a solid: f(p) is the sum of a_i noise(2^i k p) over the octaves i = 0, 1,
    ..., where noise is gradient noise on a lattice of spacing 1, and a_i = amplitude 2^(-beta i).

    octaves: the number of octaves.
    beta: how fast amplitudes fall: 0 for white noise, 1 for 1/f noise, 2 for Brownian motion.
    frequency: k, the number of lattice points per unit of length in the first octave.
    amplitude: of the first octave.
    seed: an integer of 32 bits that chooses the noise.
    fade: "quintic", with a continuous second derivative, or "cubic", which is Hart's.

    This is Hart 1996, equations 52 to 55. The Lipschitz constant of f is at most the sum of the
    octaves' constants. The amplitudes 2^(-beta i) give the Hurst exponent beta, so that the graph
    has the fractal dimension 3 - beta. (Hart's equation after 53 has 2 + (3 - beta)/2.)
    """

    traits = by_numbers("beta", "frequency", "amplitude")

    octaves: int = 6
    beta: float = 1.0
    frequency: float = 1.0
    amplitude: float = 1.0
    seed: int = 0
    fade: Fade = "quintic"

    def __post_init__(self) -> None:
        """Check the arguments, and turn them into numbers of the right type.

        Raises:
            ValueError, TypeError: an argument out of range or of another kind.
        """
        object.__setattr__(self, "octaves", as_integer_in_range(self.octaves, "octaves", 1, 24))
        object.__setattr__(self, "seed", as_integer_in_range(self.seed, "the seed", 0, 2**32 - 1))
        if not is_one_of(self.fade, CONSTANTS):
            raise ValueError(f'the fade must be "quintic" or "cubic", not {self.fade!r}')
        object.__setattr__(self, "beta", as_finite(self.beta, "beta of noise"))
        for name in ("frequency", "amplitude"):
            value = as_positive(getattr(self, name), f"the {name} of noise")
            object.__setattr__(self, name, value)

    def with_read_numbers(self, numbers: NumberReader) -> _AttachedNoise:
        """The same function of the numbers with their derivatives."""
        own = with_attached_arguments(self, ("beta", "frequency", "amplitude"), numbers)
        return _AttachedNoise(own)

    def _sum(self, power: float) -> float:
        """The sum of a_i (2^i k)^power over the octaves i, rounded up; a_i is the amplitude of
        octave i, and 2^i k its number of lattice points per unit of length. A bound of the
        derivatives of order `power` of gradient noise, multiplied by this sum, bounds the
        derivatives of f of that order."""
        terms = (2.0 ** (i * (power - self.beta)) for i in range(self.octaves))
        return self.amplitude * self.frequency**power * sum(terms) * (1.0 + 1e-5)

    @property
    def max_abs(self) -> float:
        """A bound of |f|."""
        return self._sum(0.0) * CONSTANTS[self.fade].max_abs

    @property
    def lipschitz(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self._sum(1.0) * CONSTANTS[self.fade].max_gradient

    @property
    def max_second_derivative(self) -> float:
        """A bound of the second derivative of f along any line."""
        return self._sum(2.0) * CONSTANTS[self.fade].max_second_derivative

    @property
    def may_jump(self) -> bool:
        """Whether f may jump: False, as noise is continuous."""
        return False

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        del level, above
        return None

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> FormulaEvaluator:
        del plan
        numbers = with_device_numbers(self, backend)
        bounds = tuple(
            dr.opaque(backend.Float, bound)
            # `_sum(1.0)` adds up what the octaves multiply a first derivative of the noise by.
            for bound in (
                self._sum(1.0) * CONSTANTS[self.fade].max_gradient,
                self.max_second_derivative,
            )
        )
        formula = _NoiseFormula(
            numbers.frequency,
            numbers.amplitude,
            dr.opaque(backend.Float, 2.0**-self.beta),
            dr.opaque(backend.UInt32, self.seed),
            self.octaves,
            self.fade,
            type(self).__name__,
        )
        return _NoiseEvaluator(self, formula, numbers.lipschitz, bounds)

    def formula_on(self, backend: Backend) -> FormulaFunction:
        return self.evaluator(backend).formula

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        numbers = (
            axis.backend_number() if is_jet(axis, type(self).__name__) else axis
            for axis in (x, y, z)
        )
        like = next((number for number in numbers if dr.is_array_v(type(number))), x)
        return self.formula_on(backend_of(like))(x, y, z)


@dataclass(frozen=True, eq=False)
class _NoiseFormula:
    """The function of `FractalNoise`, with its numbers as kernel parameters of a backend.

    frequency, amplitude: of the first octave.
    fall: the ratio of an octave's amplitude to the one before.
    seed: a Dr.Jit UInt32.
    octaves, fade: as of `FractalNoise`.
    name: the name of the field's class, for messages.
    """

    frequency: Real
    amplitude: Real
    fall: Real
    seed: Any
    octaves: int
    fade: Fade
    name: str

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates that are Dr.Jit numbers, or jets (ranges of numbers and of their
        derivatives). Coordinates of a jet that are plain numbers are turned into constant jets."""
        jets = [axis for axis in (x, y, z) if is_jet(axis, self.name)]
        if jets:
            coordinates = [
                axis if isinstance(axis, Jet) else jets[0].coerce(axis) for axis in (x, y, z)
            ]
            return self._ranges(coordinates)
        # The value of the sum of all octaves, the only entry of the list.
        return self._octaves([x, y, z])[0][0]

    def _octaves(self, q: list[Real], *, each: bool = False) -> list[tuple[Any, Any, Any]]:
        """The octaves of the noise at points q, each as a tuple (value, gradient (3,), Hessian
        (6,)); the Hessian is its upper triangle, row by row.

        q: the coordinates x, y and z of the points.
        each: if True, the list has one tuple for each octave; else a single tuple, the sum of all
            octaves.
        """
        scale, amplitude = self.frequency, self.amplitude
        octaves: list[tuple[Any, list[Any], list[Any]]] = []
        for octave in range(self.octaves):
            position = [entry * scale for entry in q]
            # The cell of the point is constant under derivatives; the position in it is not.
            floors = [dr.floor(dr.detach(entry)) for entry in position]
            cell_position = [a - b for a, b in zip(position, floors, strict=True)]
            integer = dr.int32_array_t(cast("Any", type(q[0])))
            unsigned = dr.uint32_array_t(cast("Any", type(q[0])))
            # Negative indices become large unsigned ones, for which the hash function is as good.
            cell_index = [unsigned(integer(entry)) for entry in floors]
            seed = self.seed + octave
            vectors: list[Any] = []
            for corner in CORNERS:
                i, j, k = (b + c for b, c in zip(cell_index, corner, strict=True))
                vectors.append(lattice_vector(i, j, k, seed, q[0]))
            value, gradient, hessian = cell_noise(self.fade, cell_position, vectors)
            # The position is multiplied by the scale, so derivatives are too.
            slope = amplitude * scale
            octaves.append(
                (
                    amplitude * value,
                    [slope * entry for entry in gradient],
                    [slope * scale * entry for entry in hessian],
                )
            )
            amplitude, scale = amplitude * self.fall, 2 * scale
        if each:
            return octaves
        total = octaves[0]
        for entry in octaves[1:]:
            total = (
                total[0] + entry[0],
                [a + b for a, b in zip(total[1], entry[1], strict=True)],
                [a + b for a, b in zip(total[2], entry[2], strict=True)],
            )
        return [total]

    def _ranges(self, coordinates: list[Jet]) -> Jet:
        """The jet of f (proved ranges of its value and derivatives) from the jets of the
        coordinates. It is the sum of the jets of all octaves.

        coordinates: the three jets, at a point or on a piece of a line.
        """
        # Any number of the backend, for the type and width of Dr.Jit arrays.
        like = coordinates[0].backend_number()
        like = like if coordinates[0].jet_at_start is None else coordinates[0].piece_length
        # The jets at the start of the piece; at a point, the jets themselves. All octaves are
        # sampled at the middle of their ranges.
        starts = [
            start if start.jet_at_start is None else start.jet_at_start for start in coordinates
        ]
        center = [0 * like + start.value_on_backend(like).midpoint for start in starts]
        radii = [0 * like + start.value_on_backend(like).radius for start in starts]
        constants = CONSTANTS[self.fade]
        epsilon = 2 * float(dr.epsilon(cast("Any", type(center[0]))))  # the machine epsilon
        scale, amplitude = self.frequency, self.amplitude
        total: Jet | None = None
        for value, gradient, hessian in self._octaves(center, each=True):
            # The rounding errors of the octave. There are about thirty operations for each corner.
            # And the position in the cell has the rounding error of the whole coordinate: where
            # coordinates, in units of the lattice, are 2^30 or more, the position has no meaning,
            # and there is no bound.
            size = fmax(fmax(dr.abs(center[0]), dr.abs(center[1])), dr.abs(center[2])) * scale
            position_error = dr.select(size < 2.0**30, epsilon * size, dr.inf)
            # (1e-5 covers the rounding of the products.)
            octave = _Octave(
                center=center,
                value=value,
                gradient=gradient,
                hessian=hessian,
                slope=amplitude * scale * constants.max_gradient * (1 + 1e-5),
                bend=amplitude * scale * scale * constants.max_second_derivative * (1 + 1e-5),
                error=amplitude * (32 * epsilon + constants.max_gradient * 2 * position_error),
                slope_error=amplitude
                * scale
                * (64 * epsilon + constants.max_second_derivative * 2 * position_error),
            )
            jet = octave.jet(coordinates, starts, _norm3(radii))
            total = jet if total is None else total + jet
            amplitude, scale = amplitude * self.fall, 2 * scale
        return cast("Jet", total)


@dataclass(frozen=True, eq=False)
class _AttachedNoise:
    """Noise whose numbers may have derivatives. noise: the noise with these numbers."""

    noise: Any

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates that are Dr.Jit or dual numbers."""
        noise, point = self.noise, [v.value if isinstance(v, Dual) else v for v in (x, y, z)]
        like = next(v for v in point if dr.is_array_v(type(v)))
        beta: Any = noise.beta
        fall = dr.exp2(-beta) if dr.is_array_v(type(beta)) else 2.0**-beta
        seed = dr.uint32_array_t(type(like))(noise.seed)
        formula = _NoiseFormula(
            noise.frequency, noise.amplitude, fall, seed, noise.octaves, noise.fade, "noise"
        )
        value, gradient, _ = formula._octaves([v + 0 * like for v in point])[0]  # pyright: ignore[reportPrivateUsage]
        dual = next((v for v in (x, y, z) if isinstance(v, Dual)), None)
        if dual is None:
            return value
        a, b, c = (dual.coerce(v).first_derivatives for v in (x, y, z))
        slopes = [gradient[0] * a[k] + gradient[1] * b[k] + gradient[2] * c[k] for k in range(3)]
        return Dual(value, (slopes[0], slopes[1], slopes[2]))


@dataclass(frozen=True, eq=False)
class _NoiseEvaluator(FormulaEvaluator):
    """The evaluator of `FractalNoise`.

    bounds: bounds of first and second derivatives of f, kernel parameters.
    """

    bounds: tuple[Real, ...]

    def promises(self, p: Vec3) -> tuple[Promise, ...]:
        first, second = self.bounds
        return Lipschitz(0 * p.x + first), TaylorRemainder(0 * p.x + second)


class Noise(FractalNoise):
    """Gradient noise of a single octave: a smooth function that is 0 at the points of a lattice and
    has random unit vectors as its gradients there (Perlin 1985; Hart 1996, equation 52).

    frequency: the number of lattice points per unit of length.
    amplitude: the factor of the noise.
    seed: an integer of 32 bits that chooses the noise.
    fade: "quintic", with a continuous second derivative, or "cubic".
    """

    def __init__(
        self,
        frequency: float = 1.0,
        amplitude: float = 1.0,
        *,
        seed: int = 0,
        fade: Fade = "quintic",
    ) -> None:
        """Make fractal noise with one octave; the class docstring describes the arguments. The
        exponent beta says how amplitudes fall from octave to octave. With one octave it has no
        effect, and is set to 0."""
        # In this order: octaves, beta, frequency, amplitude, seed, fade.
        super().__init__(1, 0.0, frequency, amplitude, seed, fade)


@dataclass(frozen=True)
class DisplacedSolid(FormulaSolid):
    """A displaced solid: the points where f + noise <= 0, where f is the function of another solid
    (Hart 1996, appendix F).

    solid: the other solid. It must be a `Formula`, whose f is computed from the coordinates by
        arithmetic.
    noise: the noise that is added to f.

    The Lipschitz constant of f + noise is the sum of the constants of f and of the noise. The
    displaced surface lies where |f| is at most `max_abs` of the noise.
    """

    traits = by_numbers("solid", "noise")

    solid: Formula
    noise: FractalNoise

    def with_read_numbers(self, numbers: NumberReader) -> DisplacedSolid:
        """The copy of which both functions have their numbers attached."""
        other = copy.copy(self)
        object.__setattr__(other, "solid", attached(self.solid, numbers))
        object.__setattr__(other, "noise", self.noise.with_read_numbers(numbers))
        return other

    def __post_init__(self) -> None:
        """Raise TypeError unless the solid has a formula and the noise is `FractalNoise`."""
        if not isinstance(cast("Any", self.solid), Formula):
            raise TypeError(
                f"only shapes with a formula are displaced, not {type(self.solid).__name__}"
            )
        if not isinstance(cast("Any", self.noise), FractalNoise):
            raise TypeError(f"noise must be Noise or FractalNoise, not {self.noise!r}")
        for part in (self.solid, self.noise):
            own_formula(part)  # raises TypeError for a user's class without a formula of its own

    @property
    def lipschitz(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        constant, noise_constant = self.solid.lipschitz, self.noise.lipschitz
        return None if constant is None else constant + noise_constant

    @property
    def may_jump(self) -> bool:
        """Whether the solid's function may jump; the noise is continuous."""
        return self.solid.may_jump

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        if not isinstance(self.solid, FormulaSolid):
            return None
        moved = level - self.noise.max_abs if above else level + self.noise.max_abs
        return self.solid.sublevel_extent(moved, above=above)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return own_formula(self.solid)(x, y, z) + own_formula(self.noise)(x, y, z)

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> FormulaEvaluator:
        del plan
        solid, noise = self.solid.evaluator(backend), self.noise.evaluator(backend)
        # The sum of the constants, as numbers of the backend.
        first, second = solid.lipschitz, noise.lipschitz
        lipschitz = None if first is None or second is None else first + second
        return FormulaEvaluator(self, _SumOfFormulas(solid.formula, noise.formula), lipschitz)

    def formula_on(self, backend: Backend) -> FormulaFunction:
        return _SumOfFormulas(self.solid.formula_on(backend), self.noise.formula_on(backend))


@dataclass(frozen=True, eq=False)
class _SumOfFormulas:
    """The sum of two functions of the coordinates."""

    first: FormulaFunction
    second: FormulaFunction

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        return self.first(x, y, z) + self.second(x, y, z)


@dataclass(frozen=True)
class _Octave:
    """An octave of fractal noise at a point q, with bounds that hold around the point: the octave's
    value, gradient and Hessian at q, and bounds of its derivatives everywhere. From these follow
    its jets: proved ranges of value and derivatives for ranges of the coordinates.

    center: the coordinates of q.
    value, gradient, hessian: at q; the Hessian (6,) is its upper triangle, row by row.
    slope: a bound of the length of the gradient, everywhere.
    bend: a bound of all second derivatives along lines, everywhere.
    error, slope_error: bounds of the rounding errors of value and gradient.
    """

    center: list[Real]
    value: Real
    gradient: list[Real]
    hessian: list[Real]
    slope: Real
    bend: Real
    error: Real
    slope_error: Real

    def jet(self, coordinates: list[Jet], starts: list[Jet], start_error: Real) -> Jet:
        """The octave's jet (proved ranges of value and derivatives), from the jets of the
        coordinates.

        coordinates: the jets, at a point or on a piece of a line.
        starts: the jets where the piece starts; for a point, `coordinates` themselves. Their values
            lie within `start_error` of the octave's point q.

        Proof. Let `bend` bound all second derivatives of the octave along lines. Within the
        distance m of q, the gradient differs from the gradient at q by at most bend m (mean value
        theorem). Derivatives along a line follow by the chain rule. The value is the value at the
        start plus the integral of the slope.
        """
        error = self.error + self.slope * start_error * (1 + 1e-5)
        value = Interval(self.value - error, self.value + error)
        if coordinates[0].jet_at_start is None:
            # A jet at a point of space has three variables, a jet along a line only one. Only for
            # points of space the Hessian is used.
            is_point = len(coordinates[0].first_derivatives) > 1
            return self._derivatives(coordinates, start_error, value, is_point=is_point)
        start = self._derivatives(starts, start_error, value, is_point=False)
        # The distance m of q from the farthest point of the piece.
        offsets = [
            fmax(dr.abs(coordinate.value.upper - q), dr.abs(coordinate.value.lower - q))
            for coordinate, q in zip(coordinates, self.center, strict=True)
        ]
        # (1e-5 covers the rounding of the distance.)
        distance = _norm3(offsets) * (1 + 1e-5)
        error = error + self.slope * distance
        piece_value = Interval(self.value - error, self.value + error)
        piece = self._derivatives(coordinates, distance, piece_value, is_point=False)
        return piece.narrowed_from_start(start, coordinates[0].piece_length)

    def _derivatives(
        self, jets: list[Jet], distance: Real, value: Interval, *, is_point: bool
    ) -> Jet:
        """The octave's jet, with the given range of its value, and with ranges of its derivatives
        by the chain rule.

        jets: the jets of the coordinates, whose values lie within `distance` of the octave's point.
        value: the range of the value.
        is_point: whether second derivatives are computed from the Hessian; else they are bounded by
            `bend`, which bounds all second derivatives of the octave along lines.
        """
        change = self.bend * distance + self.slope_error
        # The gradient within `distance` of the point, and never longer than `slope`. (-max(-a, -b)
        # is min(a, b).)
        slopes = [
            Interval(fmax(g - change, -self.slope), -fmax(-g - change, -self.slope))
            for g in self.gradient
        ]
        first: list[Interval] = []
        speeds: list[Real] = []
        for i in range(len(jets[0].first_derivatives)):
            rates = [jet.first_derivatives[i] for jet in jets]
            # A bound of the length of the derivative of (x, y, z) by variable i.
            speed = _norm3([0 * self.value + r.max_abs for r in rates]) * (1 + 1e-5)
            rate = _interval_sum([g * r for g, r in zip(slopes, rates, strict=True)])
            # The Lipschitz constant of the octave bounds the rate as well.
            limit = self.slope * speed
            first.append(Interval(fmax(rate.lower, -limit), -fmax(-rate.upper, -limit)))
            speeds.append(speed)
        # 64 machine epsilons, relative to the bound of the Hessian.
        rounding = 64 * 2 * float(dr.epsilon(cast("Any", type(self.value)))) * self.bend
        second: list[Interval] = []
        for k, (i, j) in enumerate(jets[0].hessian_indices()):
            bound = self.bend * speeds[i] * speeds[j]
            # The part of a second derivative that comes from the octave's own second derivatives.
            quadratic = Interval(-bound, bound)
            if is_point:
                quadratic = _hessian_form(
                    [Interval(h - rounding, h + rounding) for h in self.hessian], jets, i, j
                )
            rate = [g * jet.second_derivatives[k] for g, jet in zip(slopes, jets, strict=True)]
            second.append(_interval_sum([quadratic, *rate]))
        return Jet(value, tuple(first), tuple(second))


def _interval_sum(parts: list[Interval]) -> Interval:
    """The sum of intervals, at least one."""
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def _hessian_form(hessian: list[Interval], jets: list[Jet], i: int, j: int) -> Interval:
    """The number x_i^T H x_j as an interval, where x_i is the derivative of the coordinates (x, y,
    z) by the variable i of their jets.

    hessian: the upper triangle (6,) of the matrix H, row by row, as intervals.
    jets: the jets of the three coordinates, which hold these derivatives.
    """
    terms: list[Interval] = []
    for m, (a, b) in enumerate(itertools.combinations_with_replacement(range(3), 2)):
        across = jets[a].first_derivatives[i] * jets[b].first_derivatives[j]
        # Off the diagonal, the entries H_ab and H_ba are the same.
        if a != b:
            across = across + jets[b].first_derivatives[i] * jets[a].first_derivatives[j]
        terms.append(hessian[m] * across)
    return _interval_sum(terms)


def _norm3(parts: list[Real]) -> Real:
    """The length of a vector with three components."""
    return dr.sqrt(parts[0] * parts[0] + parts[1] * parts[1] + parts[2] * parts[2])
