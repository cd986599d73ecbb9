"""A frame of the tangent plane of a level set, and the second derivatives along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.basis import across
from harnack.backend.lengths import length

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3

__all__ = ["Eigen", "TangentPlane", "apply"]


@dataclass(frozen=True)
class TangentPlane:
    """Where grad f is not zero: its length, the unit normal n along it, two unit tangents u, v."""

    gradient_norm: Real
    n: Vec3
    u: Vec3
    v: Vec3

    @classmethod
    def of(cls, gradient: Vec3) -> TangentPlane:
        """The plane at right angles to a gradient; NaN where that is zero."""
        gradient_norm = length(gradient)
        n = gradient / gradient_norm
        u, v = across(n)
        return cls(gradient_norm, n, u, v)

    def restricted(self, rows: tuple[Vec3, Vec3, Vec3]) -> tuple[Real, Real, Real]:
        """u.Au, v.Av and u.Av of a symmetric matrix A given by its rows."""
        along_u, along_v = apply(rows, self.u), apply(rows, self.v)
        return dr.dot(self.u, along_u), dr.dot(self.v, along_v), dr.dot(self.u, along_v)


@dataclass(frozen=True)
class Eigen:
    """The eigenvalues of a symmetric 2x2 matrix and the angle of the larger one's eigenvector."""

    most: Real
    least: Real
    cosine: Real
    sine: Real

    @classmethod
    def of(cls, uu: Real, vv: Real, uv: Real) -> Eigen:
        """Of the matrix ((uu, uv), (uv, vv))."""
        middle, half = 0.5 * (uu + vv), 0.5 * (uu - vv)
        spread = dr.sqrt(dr.fma(half, half, uv * uv))
        s, c = dr.sincos(0.5 * dr.atan2(uv, half))
        return cls(middle + spread, middle - spread, c, s)

    def coordinates(self, u: Real, v: Real) -> tuple[Real, Real]:
        """Of the vector (u, v) along the two eigenvectors, the larger one's first."""
        return (
            dr.fma(self.cosine, u, self.sine * v),
            dr.fma(self.cosine, v, -self.sine * u),
        )

    def combination(self, most: Real, least: Real) -> tuple[Real, Real]:
        """The vector (u, v) with these coordinates."""
        return (
            dr.fma(self.cosine, most, -self.sine * least),
            dr.fma(self.sine, most, self.cosine * least),
        )


def apply(rows: tuple[Vec3, Vec3, Vec3], vector: Vec3) -> Vec3:
    """The matrix with these rows times a vector."""
    return type(vector)(*(dr.dot(row, vector) for row in rows))
