"""Noise and fractal noise as fields, and shapes that are displaced by them.

`NoiseConstants` has the proved bounds of noise from gradients at the points of a lattice.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast

import drjit as dr

from harnack.arithmetic import Interval, Jet
from harnack.backend import backend_of
from harnack.backend.elementary import fmax
from harnack.backend.validation import as_finite, as_integer_in_range, as_positive
from harnack.enclosures import Lipschitz, TaylorRemainder
from harnack.fields.formula import Formula, is_jet, with_device_numbers
from harnack.fields.solids.solid import FormulaSolid
from harnack.name_suggestions import is_one_of

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.enclosures import Promise
    from harnack.fields.field import Field
    from harnack.geometry import Volume

Fade: TypeAlias = Literal["quintic", "cubic"]

CORNERS = tuple(itertools.product((0, 1), repeat=3))


@dataclass(frozen=True)
class NoiseConstants:
    """Bounds of noise on a lattice of unit length, with any unit vectors at its points.

    max_abs: of |noise|.
    max_gradient: of |grad noise|.
    max_second_derivative: of all second derivatives.

    Proof. With weights w_c of the corners c of a cell and r_c = x - c, noise is sum w_c g_c.r_c.
    |noise| <= sum w_c |r_c| <= sqrt(sum w_c |r_c|^2), which is the root of three terms of at most
    1/4: s(t) lies below the line (1 + 2t)/4 up to its middle, for it is convex there. sqrt(3)/2 is
    attained in the middle.

    The derivative along v is sum g_c.(A_c v) with A_c = w_c I + r_c grad w_c^T, at most sum |A_c v|
    <= sqrt(v^T (sum A_c^T A_c / o_c) v) for weights o_c > 0 with the sum 1 (Cauchy and Schwarz).
    With the spectral norms of the A_c as weights the root of the largest eigenvalue is at most
    2.183 for the cubic and sqrt(499)/8 = 2.7923 for the quintic fade on a grid of the cell, and
    changes slowly between its points: 2.2 and 2.82 leave room for that. In the middle sqrt(19)/2 =
    2.1794 and sqrt(499)/8 are attained. Hart's 3 (1996, appendix F) is a bound, but his argument
    (3/2 of the fade times 2 of the vectors) does not prove it: values of a table have no Lipschitz
    constant.

    A second derivative d_ij is, in the same way along the other axes, at most a sum over the
    corners of one or two axes; the largest sum of a row of these bounds is one of the spectral norm
    of the Hessian: 17.64 and 24.35 on a grid.
    """

    max_abs: float
    max_gradient: float
    max_second_derivative: float


CONSTANTS: dict[Fade, NoiseConstants] = {
    "cubic": NoiseConstants(math.sqrt(0.75), 2.2, 18.0),
    "quintic": NoiseConstants(math.sqrt(0.75), 2.82, 25.0),
}


def fade(kind: Fade, t: Any) -> tuple[Any, Any, Any]:
    """The weight of the farther end, 0 to 1, and its first two derivatives."""
    if kind == "cubic":
        return t * t * (3 - 2 * t), 6 * t * (1 - t), 6 - 12 * t
    rest = 1 - t
    return (
        t * t * t * (10 + t * (6 * t - 15)),
        30 * (t * rest) * (t * rest),
        60 * t * rest * (1 - 2 * t),
    )


def cell_noise(kind: Fade, t: Any, vectors: Any) -> tuple[Any, list[Any], list[Any]]:
    """Noise in a cell: value, gradient (3,) and Hessian (6,), rows of the upper triangle.

    t: (3,) the position in the cell, 0 to 1. vectors: (8,) unit vectors (3,) at the corners, in the
    order of `CORNERS`.
    """
    weights: list[tuple[tuple[Any, Any], ...]] = []
    for one in t:
        s, ds, dds = fade(kind, one)
        weights.append(((1 - s, s), (-ds, ds), (-dds, dds)))
    value: Any = 0.0
    gradient: list[Any] = [0.0] * 3
    hessian: list[Any] = [0.0] * 6

    def weight(corner: tuple[int, ...], orders: list[int]) -> Any:
        return (
            weights[0][orders[0]][corner[0]]
            * weights[1][orders[1]][corner[1]]
            * weights[2][orders[2]][corner[2]]
        )

    for corner, g in zip(CORNERS, vectors, strict=True):
        inner = sum(g[k] * (t[k] - corner[k]) for k in range(3))
        w = weight(corner, [0, 0, 0])
        value = value + w * inner
        dw = [weight(corner, [int(i == k) for i in range(3)]) for k in range(3)]
        for k in range(3):
            gradient[k] = gradient[k] + (w * g[k] + dw[k] * inner)
        for m, (i, j) in enumerate(itertools.combinations_with_replacement(range(3), 2)):
            orders = [int(i == k) + int(j == k) for k in range(3)]
            hessian[m] = hessian[m] + (dw[i] * g[j] + dw[j] * g[i] + weight(corner, orders) * inner)
    return value, gradient, hessian


def lattice_vector(x: Any, y: Any, z: Any, seed: Any, like: Real) -> list[Any]:
    """A pseudo-random unit vector for integers (Dr.Jit, 32 bits, unsigned)."""
    h = x * 0x8DA6B343 + y * 0xD8163841 + z * 0xCB1AB31F + seed * 0x9E3779B1
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        h = (h ^ (h >> shift)) * factor
    h = h ^ (h >> 16)
    # Odd numbers below 1024 in size: exact, and none is 0.
    real = cast("Any", type(like))
    parts = [real((h >> (10 * k)) & 1023) * 2 - 1023 for k in range(3)]
    scale = 1 / dr.sqrt(parts[0] * parts[0] + parts[1] * parts[1] + parts[2] * parts[2])
    return [one * scale for one in parts]


@dataclass(frozen=True)
class FractalNoise(FormulaSolid):
    """The sum of a_i noise(2^i k p), a_i = amplitude 2^(-beta i), over a number of octaves.

    octaves: their number.
    beta: how fast amplitudes fall: 0 for white noise, 1 for 1/f noise, 2 for Brownian motion.
    frequency: k, points of the lattice in a unit of length.
    amplitude: that of the first octave.
    seed: an integer of 32 bits that chooses the noise.
    fade: "quintic", with a continuous second derivative, or "cubic", which is Hart's.

    Hart 1996, equations 52 to 55. Its Lipschitz constant is at most the sum of those of the
    octaves; amplitudes 2^(-beta i) have the Hurst exponent beta, so that the graph has the fractal
    dimension 3 - beta, where Hart's equation after 53 has 2 + (3 - beta)/2.
    """

    octaves: int = 6
    beta: float = 1.0
    frequency: float = 1.0
    amplitude: float = 1.0
    seed: int = 0
    fade: Fade = "quintic"

    def __post_init__(self) -> None:
        object.__setattr__(self, "octaves", as_integer_in_range(self.octaves, "octaves", 1, 24))
        object.__setattr__(self, "seed", as_integer_in_range(self.seed, "the seed", 0, 2**32 - 1))
        if not is_one_of(self.fade, CONSTANTS):
            raise ValueError(f'the fade must be "quintic" or "cubic", not {self.fade!r}')
        object.__setattr__(self, "beta", as_finite(self.beta, "beta of noise"))
        for name in ("frequency", "amplitude"):
            value = as_positive(getattr(self, name), f"the {name} of noise")
            object.__setattr__(self, name, value)

    def _sum(self, power: float) -> float:
        """The sum of a_i (2^i k)^power, rounded up."""
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
        """A bound of all second derivatives."""
        return self._sum(2.0) * CONSTANTS[self.fade].max_second_derivative

    def prepare(self, backend: Backend) -> Field:
        made = with_device_numbers(self, backend)
        constants = (self._sum(1.0) * CONSTANTS[self.fade].max_gradient, self.max_second_derivative)
        numbers = {
            "_constants": tuple(dr.opaque(backend.Float, one) for one in constants),
            "_falls": dr.opaque(backend.Float, 2.0**-self.beta),
            "_seed": dr.opaque(backend.UInt32, self.seed),
        }
        for name, value in numbers.items():
            object.__setattr__(made, name, value)
        return made

    def promises(self, p: Vec3) -> tuple[Promise, ...]:
        slope, bend = self._data(p.x)["_constants"]
        return Lipschitz(0 * p.x + slope), TaylorRemainder(0 * p.x + bend)

    def _data(self, like: Real) -> dict[str, Any]:
        made = self if hasattr(self, "_falls") else self.prepare(backend_of(like))
        return vars(made)

    @property
    def may_jump(self) -> bool:
        """Noise is continuous."""
        return False

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        del level, above
        return None

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        jets = [one for one in (x, y, z) if is_jet(one, type(self).__name__)]
        if jets:
            made = [one if isinstance(one, Jet) else jets[0].coerce(one) for one in (x, y, z)]
            return self._ranges(made)
        return self._octaves([x, y, z])[0][0]

    def _octaves(self, q: list[Real], *, each: bool = False) -> list[tuple[Any, Any, Any]]:
        """Value, gradient and Hessian of the sum, or of each octave."""
        data = self._data(q[0])
        scale, amplitude = data["frequency"], data["amplitude"]
        found: list[tuple[Any, list[Any], list[Any]]] = []
        for octave in range(self.octaves):
            place = [one * scale for one in q]
            whole = [dr.floor(dr.detach(one)) for one in place]
            t = [a - b for a, b in zip(place, whole, strict=True)]
            integer = dr.int32_array_t(cast("Any", type(q[0])))
            natural = dr.uint32_array_t(cast("Any", type(q[0])))
            base = [natural(integer(one)) for one in whole]
            seed = data["_seed"] + octave
            vectors: list[Any] = []
            for corner in CORNERS:
                i, j, k = (b + c for b, c in zip(base, corner, strict=True))
                vectors.append(lattice_vector(i, j, k, seed, q[0]))
            value, gradient, hessian = cell_noise(self.fade, t, vectors)
            slope = amplitude * scale
            found.append(
                (
                    amplitude * value,
                    [slope * one for one in gradient],
                    [slope * scale * one for one in hessian],
                )
            )
            amplitude, scale = amplitude * data["_falls"], 2 * scale
        if each:
            return found
        total = found[0]
        for one in found[1:]:
            total = (
                total[0] + one[0],
                [a + b for a, b in zip(total[1], one[1], strict=True)],
                [a + b for a, b in zip(total[2], one[2], strict=True)],
            )
        return [total]

    def _ranges(self, coordinates: list[Jet]) -> Jet:
        """The jet of the sum for jets of the coordinates: the sum of the octaves' jets."""
        like = coordinates[0].backend_number()
        like = like if coordinates[0].jet_at_start is None else coordinates[0].piece_length
        starts = [one if one.jet_at_start is None else one.jet_at_start for one in coordinates]
        at = [0 * like + one.value_on_backend(like).midpoint for one in starts]
        off = [0 * like + one.value_on_backend(like).radius for one in starts]
        data, constants = self._data(at[0]), CONSTANTS[self.fade]
        unit = 2 * float(dr.epsilon(cast("Any", type(at[0]))))
        scale, amplitude = data["frequency"], data["amplitude"]
        total: Jet | None = None
        for value, gradient, hessian in self._octaves(at, each=True):
            # Thirty operations for each corner. The position in the cell is off by a rounding of
            # the coordinate, and nothing is known where the lattice is finer than the numbers are.
            place = fmax(fmax(dr.abs(at[0]), dr.abs(at[1])), dr.abs(at[2])) * scale
            lost = dr.select(place < 2.0**30, unit * place, dr.inf)
            octave = _Octave(
                at=at,
                value=value,
                gradient=gradient,
                hessian=hessian,
                slope=amplitude * scale * constants.max_gradient * (1 + 1e-5),
                bend=amplitude * scale * scale * constants.max_second_derivative * (1 + 1e-5),
                error=amplitude * (32 * unit + constants.max_gradient * 2 * lost),
                slope_error=amplitude
                * scale
                * (64 * unit + constants.max_second_derivative * 2 * lost),
            )
            jet = octave.jet(coordinates, starts, _length(off))
            total = jet if total is None else total + jet
            amplitude, scale = amplitude * data["_falls"], 2 * scale
        return cast("Jet", total)


class Noise(FractalNoise):
    """One octave: lattice noise of random unit vectors (Perlin 1985; Hart 1996, equation 52)."""

    def __init__(
        self,
        frequency: float = 1.0,
        amplitude: float = 1.0,
        *,
        seed: int = 0,
        fade: Fade = "quintic",
    ) -> None:
        super().__init__(1, 0.0, frequency, amplitude, seed, fade)


@dataclass(frozen=True)
class DisplacedSolid(FormulaSolid):
    """A shape with noise added to its function (Hart 1996, appendix F): f + noise <= 0.

    Its Lipschitz constant is the sum of both; its surface is where f is within `max_abs` of 0.
    """

    solid: Formula
    noise: FractalNoise

    def __post_init__(self) -> None:
        if not isinstance(cast("Any", self.solid), Formula):
            raise TypeError(
                f"only shapes with a formula are displaced, not {type(self.solid).__name__}"
            )
        if not isinstance(cast("Any", self.noise), FractalNoise):
            raise TypeError(f"noise must be Noise or FractalNoise, not {self.noise!r}")

    @property
    def lipschitz(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        one, two = self.solid.lipschitz, self.noise.lipschitz
        return None if one is None else one + two

    @property
    def may_jump(self) -> bool:
        """Whether the shape's function may: noise is continuous."""
        return self.solid.may_jump

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        if not isinstance(self.solid, FormulaSolid):
            return None
        moved = level - self.noise.max_abs if above else level + self.noise.max_abs
        return self.solid.sublevel_extent(moved, above=above)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return self.solid.formula(x, y, z) + self.noise.formula(x, y, z)


@dataclass(frozen=True)
class _Octave:
    """One octave around a point.

    at: the point.
    value, gradient, hessian: there.
    slope, bend: bounds of the first and second derivatives everywhere.
    error, slope_error: bounds of the errors of value and gradient.
    """

    at: list[Real]
    value: Real
    gradient: list[Real]
    hessian: list[Real]
    slope: Real
    bend: Real
    error: Real
    slope_error: Real

    def jet(self, coordinates: list[Jet], starts: list[Jet], off: Real) -> Jet:
        """The octave's jet, from jets of the coordinates and from their starts, which are within
        `off` of the point.

        Proof. Within m of the point the gradient differs from that at the point by at most bend m
        (mean value theorem), and derivatives along a path follow by the chain rule. The value is
        that at the start plus the integral of the slope.
        """
        wide = self.error + self.slope * off * (1 + 1e-5)
        value = Interval(self.value - wide, self.value + wide)
        if coordinates[0].jet_at_start is None:
            # At points of space, not on pieces of length 0: the Hessian is known.
            is_point = len(coordinates[0].first_derivatives) > 1
            return self._derivatives(coordinates, off, value, is_point=is_point)
        start = self._derivatives(starts, off, value, is_point=False)
        far = [
            fmax(dr.abs(one.value.upper - q), dr.abs(one.value.lower - q))
            for one, q in zip(coordinates, self.at, strict=True)
        ]
        distance = _length(far) * (1 + 1e-5)
        wide = wide + self.slope * distance
        wider = Interval(self.value - wide, self.value + wide)
        piece = self._derivatives(coordinates, distance, wider, is_point=False)
        return piece.narrowed_from_start(start, coordinates[0].piece_length)

    def _derivatives(self, jets: list[Jet], reach: Real, value: Interval, *, is_point: bool) -> Jet:
        change = self.bend * reach + self.slope_error
        parts = [
            Interval(fmax(g - change, -self.slope), -fmax(-g - change, -self.slope))
            for g in self.gradient
        ]
        first: list[Interval] = []
        speeds: list[Real] = []
        for i in range(len(jets[0].first_derivatives)):
            rates = [one.first_derivatives[i] for one in jets]
            speed = _length([0 * self.value + r.max_abs for r in rates]) * (1 + 1e-5)
            along = _sum([g * r for g, r in zip(parts, rates, strict=True)])
            most = self.slope * speed
            first.append(Interval(fmax(along.lower, -most), -fmax(-along.upper, -most)))
            speeds.append(speed)
        rounded = 64 * 2 * float(dr.epsilon(cast("Any", type(self.value)))) * self.bend
        second: list[Interval] = []
        for k, (i, j) in enumerate(jets[0].hessian_indices()):
            bent = self.bend * speeds[i] * speeds[j]
            own = Interval(-bent, bent)
            if is_point:
                own = _quadratic(
                    [Interval(h - rounded, h + rounded) for h in self.hessian], jets, i, j
                )
            along = [g * one.second_derivatives[k] for g, one in zip(parts, jets, strict=True)]
            second.append(_sum([own, *along]))
        return Jet(value, tuple(first), tuple(second))


def _sum(parts: list[Interval]) -> Interval:
    total = parts[0]
    for one in parts[1:]:
        total = total + one
    return total


def _quadratic(hessian: list[Interval], jets: list[Jet], i: int, j: int) -> Interval:
    """x_i^T H x_j."""
    terms: list[Interval] = []
    for m, (a, b) in enumerate(itertools.combinations_with_replacement(range(3), 2)):
        across = jets[a].first_derivatives[i] * jets[b].first_derivatives[j]
        if a != b:
            across = across + jets[b].first_derivatives[i] * jets[a].first_derivatives[j]
        terms.append(hessian[m] * across)
    return _sum(terms)


def _length(parts: list[Real]) -> Real:
    return dr.sqrt(parts[0] * parts[0] + parts[1] * parts[1] + parts[2] * parts[2])
