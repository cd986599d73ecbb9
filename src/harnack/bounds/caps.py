"""The spherical-cap bound: the sharpest enclosure for a harmonic function with two known ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import clamp, fmin

from harnack.bounds.bound import Bound
from harnack.bounds.solve import LARGEST_FRACTION, largest_covered
from harnack.bounds.start import safe_starts
from harnack.certify import BallCertificate, Certificate

if TYPE_CHECKING:
    from harnack.backend import Mask, Real


@dataclass(frozen=True)
class Caps(Bound):
    """Bounded on both sides in space: the extremal boundary values are two spherical caps.

    Proof. With values in [c, C], f = c + (C-c) g and g the Poisson integral of boundary values
    in [0, 1] with mean p = (f-c)/(C-c) and first moment mu = R f_v/(3 (C-c)) along v. For fixed
    q the kernel P(q, s) is convex in s, so among densities in [0, 1] with given mass and first
    moment, integral P g is largest for the indicator of {s <= s1} u {s >= s2} (bathtub principle:
    P minus the chord through s1, s2 is positive exactly there), two caps about v of heights
    b = p + mu/(1-p) ahead and a = p - mu/(1-p) behind, which depend on p and mu alone. The
    integral over caps is elementary; freed of its cancellation at small q it reads

        U - c = (C-c) [ b (1+q)/(s1 (s1+1-q)) + a (1-q)/(s2 (s2+1+q)) ],
        s1^2 = (1-q)^2 + 2qb,   s2^2 = (1+q)^2 - 2qa.

    The lower bound is the complement: C - (C-c)(...) with p -> 1-p, mu -> -mu. |mu| <= p (1-p)
    holds in exact arithmetic and is enforced.

    The first crossing is unique: (X-s)^(-3/2) with X = (1+q^2)/(2q) is a Laplace transform of
    exp(-tX) exp(ts), hence totally positive in (q, s) on (0, 1) x (-1, 1) (Karlin 1968), hence
    variation diminishing: U - level is the transform of values with signs (+, -, +), so it has
    at most those sign changes, in that order, and where it starts negative it turns once.
    """

    rounds: int = 4

    def accepts(self, certificate: Certificate) -> bool:
        return (
            isinstance(certificate, BallCertificate)
            and certificate.dimension == 3
            and certificate.room_below is not None
            and certificate.room_above is not None
        )

    def step(self, certificate: Certificate, slope: Real) -> Real:
        assert isinstance(certificate, BallCertificate)
        up, down = _movements(certificate, slope)
        from_up, from_down = safe_starts(certificate, slope)
        q = fmin(
            largest_covered(up, certificate.gap_up, from_up, self.rounds),
            largest_covered(down, certificate.gap_down, from_down, self.rounds),
        )
        return q * certificate.radius

    def covers(self, certificate: Certificate, slope: Real, length: Real) -> Mask:
        assert isinstance(certificate, BallCertificate)
        up, down = _movements(certificate, slope)
        q = length / certificate.radius
        inside = q <= LARGEST_FRACTION
        q = fmin(q, LARGEST_FRACTION)
        free = (q * up(q) <= certificate.gap_up) & (q * down(q) <= certificate.gap_down)
        return (length <= 0) | (inside & free)


def _movements(c: BallCertificate, slope: Real) -> tuple[_TwoCaps, _TwoCaps]:
    assert c.room_below is not None
    assert c.room_above is not None
    span = c.room_below + c.room_above
    p, rest = c.room_below / span, c.room_above / span
    mu = c.radius * slope / (3 * span)
    mu = clamp(mu, -p * rest, p * rest)
    return _two_caps(span, p, rest, mu), _two_caps(span, rest, p, -mu)


def _two_caps(span: Real, p: Real, rest: Real, mu: Real) -> _TwoCaps:
    shift = dr.select(rest > 0, mu / rest, 0)
    return _TwoCaps(span, clamp(p + shift, 0, 1), clamp(p - shift, 0, 1))


@dataclass(frozen=True)
class _TwoCaps:
    """U - f = q k(q) for cap heights `ahead` (b) and `behind` (a)."""

    span: Real
    ahead: Real
    behind: Real

    def __call__(self, q: Real) -> Real:
        return self.span * (_cap(self.ahead, q) - _cap(self.behind, -q))


def _cap(b: Real, q: Real) -> Real:
    """(b (1+q)/(s (s+1-q)) - b/2)/q with s^2 = (1-q)^2 + 2qb, without cancellation.

    The numerator 2(1+q) - s^2 - s(1-q), with s - 1 = q (q - 2 beta)/(s+1) and beta = 1 - b, is
    q [3 + 2 beta - q - (1-q)(q - 2 beta)/(s+1)].
    """
    beta = 1 - b
    back = 1 - q
    s = dr.sqrt(dr.fma(back, back, 2 * q * b))
    e = q - 2 * beta
    return 0.5 * b * (3 - q + 2 * beta - back * e / (s + 1)) / (s * (s + back))
