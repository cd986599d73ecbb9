"""Symmetric matrices, as loops sum them up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3


@dataclass(frozen=True)
class SymmetricSum:
    """A symmetric matrix a lane, as it is summed up."""

    xx: Real
    yy: Real
    zz: Real
    xy: Real
    xz: Real
    yz: Real

    @classmethod
    def zero(cls, real: Any) -> SymmetricSum:
        """The matrix of zeros; real: the type of its entries."""
        return cls(*(real(0) for _ in range(6)))

    def plus(self, u: Vec3, v: Vec3) -> SymmetricSum:
        """The sum with (u v^T + v u^T)/2."""
        half = 0.5 * v
        return SymmetricSum(
            dr.fma(u.x, v.x, self.xx),
            dr.fma(u.y, v.y, self.yy),
            dr.fma(u.z, v.z, self.zz),
            self.xy + dr.fma(u.x, half.y, u.y * half.x),
            self.xz + dr.fma(u.x, half.z, u.z * half.x),
            self.yz + dr.fma(u.y, half.z, u.z * half.y),
        )

    def parts(self) -> tuple[Real, ...]:
        """The entries in the order of the constructor, as loops want them."""
        return self.xx, self.yy, self.zz, self.xy, self.xz, self.yz

    def rows(self, vector: Any) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows; vector: the type of a row."""
        return (
            vector(self.xx, self.xy, self.xz),
            vector(self.xy, self.yy, self.yz),
            vector(self.xz, self.yz, self.zz),
        )
