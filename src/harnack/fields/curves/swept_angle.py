"""How the solid angle of a curve changes along a straight segment, without any branch to choose.

Biot and Savart's field, integrated along the segment from p to q, gives for each edge from a to b
of the curve minus the solid angle of the parallelogram (a - p) + s (b - a) - t (q - p) at the
origin: less than 2 pi in size, as it lies in a plane that misses the origin unless the segment
meets the edge. As two triangles it is twice two arctangents (van Oosterom and Strackee 1983).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3
    from harnack.fields.edges.edge_records import LoopEdges

__all__ = ["change_along_segments"]


def change_along_segments(edges: LoopEdges, p: Vec3, q: Vec3) -> Real:
    """The change of the lift of the solid angle from p to q, which differ."""
    real = edges.backend.Float

    def add(a: Vec3, b: Vec3, inverse: Real, state: tuple[Any, ...]) -> tuple[Any, ...]:
        del inverse
        ap, bp, bq, aq = a - p, b - p, b - q, a - q
        return (state[0] - _angle(ap, bp, bq) - _angle(ap, bq, aq),)

    return edges.for_each(add, (real(0),), "swept angle")[0]


def _angle(a: Vec3, b: Vec3, c: Vec3) -> Real:
    """The signed solid angle of a triangle at the origin."""
    la, lb, lc = dr.norm(a), dr.norm(b), dr.norm(c)
    volume = dr.dot(a, dr.cross(b, c))
    rest = dr.fma(dr.dot(a, b), lc, dr.fma(dr.dot(b, c), la, dr.dot(c, a) * lb))
    # A triangle that is seen from its own plane has no solid angle, whatever rounding says.
    return dr.select(volume == 0, 0, 2 * dr.atan2(volume, dr.fma(la * lb, lc, rest)))
