"""Lines of curvature: curves on a level set along which it bends most, or least."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend, to_numpy
from harnack.backend.arrays import finite_vectors, upload_vectors
from harnack.backend.extrema import fmax
from harnack.backend.loops import while_active
from harnack.backend.numbers import positive, refuses_derivatives
from harnack.distance.tangent import Eigen, TangentPlane
from harnack.names import did_you_mean

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Precision, Real, Vec3
    from harnack.fields.field import Field
    from harnack.geometry import Volume

__all__ = ["Family", "curvature_lines"]

Family = Literal["largest", "smallest"]

# Newton steps that bring a seed to the surface.
_TO_SURFACE = 8
# A line ends where the two principal curvatures differ by less than this part of their size: what
# direction is principal is not known there, and about an umbilic all are.
_UMBILIC = 1e-3
# It ends where it turns in one step by more than this angle (its cosine), and where a step is
# longer than this part of the least radius of curvature: what follows would be no line of the
# surface but the step's.
_TURN, _PART = math.cos(math.radians(40)), 0.5
_MOST_STEPS = 100_000


@refuses_derivatives
def curvature_lines(
    field: Field,
    seeds: Any,
    *,
    step: float,
    length: float,
    family: Family = "largest",
    level: float | None = None,
    clip: Volume | None = None,
    precision: Precision = "double",
) -> list[FloatArray]:
    """The lines of curvature of a level set through seeds (n, 3): n polylines (k, 3), with k >= 1.

    A line that comes back to its seed ends there, and its first point is its last.

    seeds: points near the surface, from which Newton's method leads to it.
    step: length of the steps, as a length of arc. length: how far to follow a line to either side.
    family: whether to follow the direction of the larger principal curvature or of the smaller; the
        sign of curvatures is that of `curvature`.
    level: of the surface; by default the field's own.
    clip: where lines end besides; a seed outside of it gives an empty line, (0, 3).

    With n = grad f/|grad f| and the Hessian A, the principal directions are the eigenvectors of A
    restricted to the tangent plane (`curvature` says why). They are lines without an arrow: each
    stage of a step (Runge and Kutta's of order four) takes the sign that agrees with the direction
    before it. One step of Newton's method along grad f brings the end of each step back to the
    surface, from which it is O(step^5) away.

    A line ends where the directions are not defined, as at umbilics, where both curvatures are the
    same; where the surface turns too fast for the step, as beside the curve of a solid angle; and
    after `length`. A seed whose first point is no point of a surface gives an empty line.

    Raises:
        NotImplementedError: the field has no second derivatives.
        TypeError, ValueError: seeds that are not an (n, 3) array of finite numbers; a step or
            length that is not positive; an unknown family.
    """
    if family not in get_args(Family):
        known = ", ".join(f'"{one}"' for one in get_args(Family))
        hint = did_you_mean(family, get_args(Family))
        raise ValueError(f"unknown family {family!r}; choose one of {known}{hint}")
    step, length = positive(step, "step"), positive(length, "length")
    count = math.ceil(length / step)
    if count > _MOST_STEPS:
        raise ValueError(f"length/step asks for {count:,} steps: at most {_MOST_STEPS:,}")
    start = finite_vectors(seeds, "seeds")
    if not len(start):
        return []
    level = field.default_level if level is None else float(level)
    backend = choose_backend(precision)
    # Data, so that another level, step or family compiles no other kernel.
    most = 1.0 if family == "largest" else 0.0
    at, h, share = (dr.opaque(backend.Float, one) for one in (level, step, most))
    guide = _Guide(backend, field.prepare(backend), at, h, share)
    with dr.suspend_grad():
        both = guide.follow(start, count)
    return [_joined(ahead, back, step, clip) for ahead, back in zip(*both, strict=True)]


@dataclass(frozen=True)
class _Step:
    """Where lines are, by which way they came, and which of them go on."""

    x: Vec3
    direction: Vec3
    index: Any
    active: Mask


@dataclass(frozen=True)
class _Guide:
    """Follows the lines of one family: largest is 1 for the larger curvature, 0 for the smaller."""

    backend: Backend
    field: Field
    level: Real
    step: Real
    largest: Real

    def follow(self, seeds: FloatArray, count: int) -> tuple[list[FloatArray], list[FloatArray]]:
        """The points of each line to both sides of its seed, each from the seed on."""
        integer, vector, n = self.backend.UInt32, self.backend.Array3f, len(seeds)
        x = upload_vectors(self.backend, np.concatenate([seeds, seeds]))
        x = self._on_surface(x, _TO_SURFACE)
        direction, is_known = self._direction(x, None)
        lane = dr.arange(integer, 2 * n)
        direction = dr.select(lane < n, direction, -direction)
        points = vector(*(dr.full(self.backend.Float, dr.nan, 2 * n * (count + 1)) for _ in "xyz"))
        dr.scatter(points, x, lane, is_known)
        dr.eval(points, x, direction, is_known)
        most = dr.opaque(integer, count)

        def body(state: _Step) -> _Step:
            x, direction, goes_on = self._advance(state)
            index = state.index + 1
            dr.scatter(points, x, index * (2 * n) + lane, state.active & goes_on)
            return _Step(x, direction, index, state.active & goes_on & (index < most))

        index = dr.zeros(integer, 2 * n)
        while_active(_Step(x, direction, index, is_known & True), body, "curvature lines")
        found = to_numpy(points).reshape(count + 1, 2 * n, 3).astype(np.float64)
        lines = [one[np.isfinite(one).all(axis=1)] for one in found.swapaxes(0, 1)]
        return lines[:n], lines[n:]

    def _advance(self, state: _Step) -> tuple[Vec3, Vec3, Mask]:
        """The next point, the direction there, and whether it is one of the line."""
        x, h = state.x, self.step
        first = state.direction
        second, _ = self._direction(x + 0.5 * h * first, first)
        third, _ = self._direction(x + 0.5 * h * second, second)
        fourth, _ = self._direction(x + h * third, third)
        end = x + h / 6 * (first + 2 * (second + third) + fourth)
        end = self._on_surface(end, 1)
        last, is_known = self._direction(end, fourth)
        return end, last, is_known & (dr.dot(first, last) > _TURN)

    def _direction(self, x: Vec3, before: Vec3 | None) -> tuple[Vec3, Mask]:
        """The principal direction that agrees with the one before, and whether there is one."""
        plane = TangentPlane.of(self.field.evaluate(x).gradient)
        eigen = Eigen.of(*plane.restricted(self.field.hessian(x)))
        u, v = eigen.combination(self.largest, 1 - self.largest)
        direction = u * plane.u + v * plane.v
        if before is not None:
            direction = dr.select(dr.dot(direction, before) < 0, -direction, direction)
        most = fmax(dr.abs(eigen.most), dr.abs(eigen.least))
        is_known = (eigen.most - eigen.least > _UMBILIC * most) & dr.isfinite(dr.norm(direction))
        return direction, is_known & (most * self.step < _PART * plane.gradient_norm)

    def _on_surface(self, x: Vec3, steps: int) -> Vec3:
        """The point to which so many steps of Newton's method along the gradient lead."""

        def step(x: Vec3) -> Vec3:
            sample = self.field.evaluate(x)
            gap = sample.value - self.level
            if self.field.period is not None:
                gap = gap - self.field.period * dr.round(gap / self.field.period)
            return x - gap / dr.squared_norm(sample.gradient) * sample.gradient

        return _repeated(step, x, steps, self.backend)


def _repeated(step: Callable[[Vec3], Vec3], x: Vec3, times: int, backend: Backend) -> Vec3:
    """The step so many times, recorded once."""
    if times == 1:
        return step(x)

    def body(k: Any, x: Vec3) -> tuple[Any, Vec3]:
        return k + 1, step(x)

    def more(k: Any, x: Vec3) -> Mask:
        del x
        return k < times

    start = (backend.UInt32(0), backend.Array3f(x))
    return dr.while_loop(start, more, body, label="to the surface")[1]


def _joined(ahead: FloatArray, back: FloatArray, step: float, clip: Volume | None) -> FloatArray:
    """One line of its two halves, each cut where it first leaves the volume; of one that comes
    back to its seed, one turn, which ends in the seed."""
    if clip is not None:
        ahead, back = (_inside(half, clip) for half in (ahead, back))
    if len(ahead) > 3:
        # Passed within half a step, by a step that leads from one side of the seed to the other.
        moves, to_seed = np.diff(ahead, axis=0), ahead[0] - ahead[:-1]
        share = (moves * to_seed).sum(axis=1) / np.maximum((moves * moves).sum(axis=1), 1e-300)
        passing = np.linalg.norm(to_seed - share[:, None] * moves, axis=1) < 0.25 * step
        agrees = moves @ moves[0] > 0
        closed = np.flatnonzero(passing & (share > 0) & (share <= 1) & agrees & _far(len(moves)))
        if closed.size:
            return np.concatenate([ahead[: closed[0] + 1], ahead[:1]])
    return np.concatenate([back[:0:-1], ahead])


def _far(count: int) -> BoolArray:
    """Not the first step, which starts in the seed."""
    return np.arange(count) > 1


def _inside(line: FloatArray, clip: Volume) -> FloatArray:
    outside = np.flatnonzero(~clip.contains_points(line)) if len(line) else np.zeros(0, int)
    return line[: outside[0]] if outside.size else line
