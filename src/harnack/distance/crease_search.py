"""Improves closest points on the surfaces of combined solids. The function f of a union,
intersection or difference is, at each point, that of one of the solids that are combined, its
operands. At a crease, the curve where the surfaces of two operands meet, f changes from one to the
other. There a descent along the surface may end at a point that is not closest, or on the surface
of the wrong operand.

Therefore further descents follow each operand alone, and the creases as curves on which two
operands have the level. A point that they find counts only if f itself has the level there, up to
rounding. So the results remain points of the surface, whose distances are upper bounds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, cast

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.backend.elementary import max_norm, safe_norm
from harnack.distance.cell_classification import ClipCurveDescent
from harnack.distance.tangent_plane import in_batches

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.enclosures import Levels
    from harnack.fields.evaluator import Evaluator
    from harnack.geometry import Volume

__all__ = ["MAX_OPERANDS", "CreaseSearch", "OperandDescent"]

# Combinations of more operands are not searched: the time grows with the square of their number.
MAX_OPERANDS = 12
# A point is on the level if f differs from it by at most this many machine epsilons of the
# coordinates, times the slope of f, and the error of f.
_LEVEL_ROUNDING = 256.0


class OperandDescent(Protocol):
    """Interface of the descents along the surface of one operand alone. (The two attributes and the
    method are those of the search for points of that operand.)"""

    @property
    def evaluator(self) -> Evaluator:
        """The evaluator of the operand's function."""
        ...

    def descend(
        self, points: FloatArray, start: FloatArray, limit: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Descend for the queries `points` (n, 3) from `start` (n, 3). Points farther than `limit`
        (n,) need not be found. Returns the closest points (n, 3), NaN for none, and radii (n,)."""
        ...


@dataclass(frozen=True)
class _OtherOperands:
    """The surfaces of all operands but one, with the interface of a volume that they bound: at a
    point the operand counts whose surface is nearest to first order.

    evaluators: the evaluators of these operands' functions.
    levels: the values of the functions on the surface.
    """

    backend: Backend
    evaluators: tuple[Evaluator, ...]
    levels: Levels

    def _nearest(self, p: Vec3) -> tuple[Real, Vec3]:
        """Return the first-order signed distance of p from the nearest of the surfaces, positive
        where the function is above the level; and the unit normal of that surface."""
        distance, normal = self.backend.Float(dr.inf), self.backend.Array3f(0)
        for evaluator in self.evaluators:
            sample = evaluator.evaluate(p)
            norm = safe_norm(sample.gradient)
            trial = -self.levels.offset_to_nearest(sample.value) / norm
            is_nearer = dr.abs(trial) < dr.abs(distance)
            distance = dr.select(is_nearer, trial, distance)
            normal = dr.select(is_nearer, self.backend.Array3f(sample.gradient / norm), normal)
        return distance, normal

    def signed_distance(self, p: Vec3) -> Real:
        """Return the first-order distance of p from the nearest surface."""
        return self._nearest(p)[0]

    def outward_normal(self, p: Vec3) -> Vec3:
        """Return the unit normal of the nearest surface."""
        return self._nearest(p)[1]


@dataclass(frozen=True)
class CreaseSearch:
    """Searches for nearer points of the surface of a combination of solids.

    evaluator: samples the function f of the combination.
    levels: the values of f on the surface.
    operands: the descents along the surface of each operand alone.
    """

    backend: Backend
    evaluator: Evaluator
    levels: Levels
    operands: tuple[OperandDescent, ...]

    def candidates(self, points: FloatArray, closest: FloatArray) -> FloatArray:
        """Return for each query the nearest surface point that the further descents find, or its
        point of `closest` if none is nearer.

        points, closest: (n, 3) the queries, and their closest points so far, NaN for none.

        On each operand the descent starts at the query. On the creases of each operand with the
        others it starts at the closest point so far, and at the end of the operand's own descent.
        """
        best, unlimited = closest.copy(), np.full(len(points), np.inf)
        # (The first result of `descend` is the closest points.)
        feet = [o.descend(points, points, unlimited)[0] for o in self.operands]
        for foot in feet:
            self._update(points, best, foot)
        evaluators = [operand.evaluator for operand in self.operands]
        for number, (evaluator, foot) in enumerate(zip(evaluators, feet, strict=True)):
            others = tuple(evaluators[:number] + evaluators[number + 1 :])
            # It has the two methods of a volume that the descent calls.
            boundary = cast("Volume", _OtherOperands(self.backend, others, self.levels))
            crease = ClipCurveDescent(self.backend, evaluator, self.levels, boundary)
            for start in (best.copy(), foot):
                self._update(points, best, self._on_crease(crease, points, start))
        return best

    def _on_crease(
        self, crease: ClipCurveDescent, points: FloatArray, start: FloatArray
    ) -> FloatArray:
        """Return the closest points (n, 3) of a crease to `points` (n, 3), found from `start` (n,
        3); NaN where none is found or there is no start."""
        closest = np.full_like(points, np.nan)
        rows: IntArray = np.flatnonzero(np.isfinite(start[:, 0]))

        def follow(p: Vec3, y: Vec3) -> tuple[Vec3]:
            # Without the curvature of the curve, the second result.
            return (crease.closest(p, y)[0],)

        if len(rows):
            (closest[rows],) = in_batches(self.backend, follow, points[rows], start[rows])
        return closest

    def _update(self, points: FloatArray, best: FloatArray, candidates: FloatArray) -> None:
        """Replace the best points of the queries by candidates, in place, where these are nearer
        and f has the level there."""
        old_distance = np.linalg.norm(points - best, axis=1)
        distance = np.linalg.norm(points - candidates, axis=1)
        is_nearer = distance < np.where(np.isnan(old_distance), np.inf, old_distance)
        rows = np.flatnonzero(is_nearer)
        rows = rows[self._is_on_level(candidates[rows])]
        best[rows] = candidates[rows]

    def _is_on_level(self, points: FloatArray) -> BoolArray:
        """Return the mask (n,) of points (n, 3) at which f has a level, up to rounding."""
        if not len(points):
            return np.zeros(0, np.bool_)
        yes, no = self.backend.Float(1), self.backend.Float(0)

        def compute(p: Vec3) -> tuple[Real]:
            """Return 1 where f has a level at p, else 0, as a tuple."""
            sample = self.evaluator.evaluate(p)
            rounding = _LEVEL_ROUNDING * self.backend.machine_epsilon * max_norm(p)
            allowed = dr.fma(rounding, safe_norm(sample.gradient), 2 * sample.value_error)
            is_on = dr.abs(self.levels.offset_to_nearest(sample.value)) <= allowed
            return (dr.select(is_on, yes, no),)

        return in_batches(self.backend, compute, points)[0] > 0
