"""What a field proves along paths, beyond its promises, sampled."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harnack.backend import FloatArray, choose_backend, to_numpy, to_vector3
from harnack.enclosures import Choice, Gaps, choose_proofs, longest_step
from harnack.fields.look import Path
from harnack.testing.failures import require
from harnack.testing.walks import movements, random_directions

if TYPE_CHECKING:
    from harnack.backend import Precision
    from harnack.fields.field import Field

__all__ = ["check_looks", "free_lengths"]

# Places at which the movement along a step is looked at.
_SAMPLES = 33


def check_looks(
    field: Field,
    points: FloatArray,
    *,
    rng: np.random.Generator | int = 0,
    bound: Choice = None,
    precision: Precision = "double",
) -> None:
    """Test the enclosures that a field gives along random directions from points (n, 3).

    For lengths from a thousandth of the extent of the points to twice of it, and gaps from far
    below to far above what f moves by on the way, f must not pass a gap within the step proved for
    it, but by `Sample.error` and the rounding of value and position.

    Raises:
        BrokenPromiseError: naming the point, and where f is too large or too small.
    """
    generator = np.random.default_rng(rng)
    n = len(points)
    directions = random_directions(generator, n)
    size = float(np.ptp(points, axis=0).max()) or 1.0
    ahead = size * 2.0 ** generator.uniform(-10, 1, n)
    rough = movements(field, points, directions, ahead[:, None] * np.linspace(0, 1, 9))
    scale = np.abs(rough.moved).max(axis=1) + 1e-6
    for forwards in (True, False):
        gaps = scale[:, None] * 10.0 ** generator.uniform(-3, 0.5, (n, 2))
        without = generator.integers(0, 3, n)  # a level below, above, or on both sides
        gaps[without < 2, without[without < 2]] = np.inf
        steps = free_lengths(
            field, points, directions if forwards else -directions, ahead, gaps,
            bound=bound, precision=precision, forwards=forwards,
        )  # fmt: skip
        lengths = np.minimum(steps, 2 * ahead)[:, None] * np.linspace(0, 1, _SAMPLES)
        path = movements(field, points, directions, lengths)
        # What rounding leaves of the values compared, and of the points in this precision.
        unit = 2.0**-52 if precision == "double" else 2.0**-23
        position = unit * (np.abs(points).max(axis=1)[:, None] + lengths) * path.gradient_norm
        allowed = path.error + path.error[:, :1] + 8 * position + 1e-12 * scale[:, None]
        over = np.maximum(path.moved - gaps[:, 1:], -path.moved - gaps[:, :1]) - allowed
        worst = over.max(axis=1)
        where = points + np.take_along_axis(lengths, over.argmax(axis=1)[:, None], 1) * directions
        side = "ahead" if forwards else "back"
        require(worst <= 0, f"an enclosure looking {side} is left", points, worst, where)


def free_lengths(
    field: Field,
    points: FloatArray,
    directions: FloatArray,
    ahead: FloatArray,
    gaps: FloatArray,
    *,
    bound: Choice = None,
    precision: Precision = "double",
    forwards: bool = True,
) -> FloatArray:
    """The steps (n,) that a field's enclosures prove from points (n, 3) along unit directions.

    ahead: (n,) lengths that enclosures are asked for. gaps: (n, 2) in value, down and up. With
    forwards=False those that look back from points on paths along `directions`.
    """
    backend = choose_backend(precision)
    path = Path(to_vector3(backend, points), to_vector3(backend, directions), choose_proofs(bound))
    length = backend.Float(np.ascontiguousarray(ahead))
    down, up = (backend.Float(np.ascontiguousarray(gaps[:, k])) for k in (0, 1))
    look = field.prepare(backend).look(path, backend.Float(0), length, length)
    enclosures = look.ahead if forwards else look.back
    steps = to_numpy(longest_step(enclosures, Gaps(down, up)) + 0 * down)
    return np.broadcast_to(steps, len(points)).astype(np.float64)
