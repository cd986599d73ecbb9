"""Random solids that are combined of many parts."""

from __future__ import annotations

from functools import reduce
from typing import Any

import numpy as np

import harnack as hk
from harnack.fields.solids.solid import Solid


def random_part(rng: np.random.Generator, size: float) -> Solid:
    """A random shape of about this size, moved and turned."""
    a, b, c = size * rng.uniform(0.3, 1.0, 3)
    kind = rng.integers(0, 6)
    shape: Any = (
        lambda: hk.Sphere(a),
        lambda: hk.Cuboid((2 * a, 2 * b, 2 * c)),
        lambda: hk.Cylinder(a, 2 * b),
        lambda: hk.Torus(a, 0.3 * a),
        lambda: hk.Ellipsoid((a, b, c)),
        lambda: hk.Capsule((0.0, 0.0, -a), (0.0, b, a), 0.4 * c),
    )[kind]()
    shape = shape.rotated(rng.uniform(0, 360), rng.normal(size=3))
    return shape.translated(rng.uniform(-1, 1, 3))


def random_model(rng: np.random.Generator, count: int, size: float = 0.4) -> Solid:
    """A random combination of `count` random shapes: unions, differences, intersections and blends,
    nested."""
    parts = [random_part(rng, size) for _ in range(count)]
    while len(parts) > 1:
        k = int(rng.integers(2, 5))
        group, parts = parts[:k], parts[k:]
        kind = rng.integers(0, 6)
        if kind <= 2 or len(parts) == 0:
            joined = reduce(lambda a, b: a | b, group)
        elif kind == 3:
            joined = group[0] - reduce(lambda a, b: a | b, group[1:])
        else:
            radius = 0.3 * size
            joined = reduce(lambda a, b: a.blended(b, radius), group)
        parts.append(joined)
    return parts[0]
