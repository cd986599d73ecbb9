"""The speed at which rules approach the surface, against sphere tracing with an exact distance.

The paper's Fig. 23: the 2 pi level set is meshed finely, and sphere tracing walks by the exact
distance to that mesh (libigl's closest-point query), which is its best case.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import harnack as hk
from harnack.geometry import example_curves

from .scenes import camera

STEPS = 120
SHOWN = 60
RAYS_ACROSS = 64
GOALS = (1e-3, 1e-4, 1e-5)
ARRIVED = 1e-6
RULES = (("classic", 1.75), ("slope", 1.4), ("caps", 1.4))


def meshed(loop: np.ndarray, rings: int = 320, spokes: int = 960) -> tuple[np.ndarray, np.ndarray]:
    """A triangle mesh of the 2 pi level of a curve that is a graph over the plane.

    Vertical rays through a polar grid inside the polygon give the heights, in double precision.
    """
    s = np.linspace(0, 1, rings + 1)
    u = np.arange(spokes) / spokes * len(loop)
    i, w = u.astype(int) % len(loop), (u % 1)[:, None]
    border = (1 - w) * loop[i] + w * np.roll(loop, -1, axis=0)[i]
    inner = (s[1:-1, None, None] * border[None])[..., :2].reshape(-1, 2)
    xy = np.concatenate([[[0.0, 0.0]], inner])
    start = np.column_stack([xy, np.full(len(xy), 3.0)])
    hits = hk.trace(hk.SolidAngle(loop), start, [[0, 0, -1.0]], precision="double", tolerance=1e-10)
    assert (hits.status == hk.RayStatus.HIT).all()
    vertices = np.concatenate([hits.position, border])
    k = np.arange(spokes)
    n = (k + 1) % spokes
    faces = [np.column_stack([0 * k, 1 + k, 1 + n])]
    for ring in range(rings - 1):
        a, b = 1 + ring * spokes, 1 + (ring + 1) * spokes
        faces.append(np.column_stack([a + k, b + k, b + n]))
        faces.append(np.column_stack([a + k, b + n, a + n]))
    return vertices, np.concatenate(faces)


def errors(
    loop: np.ndarray,
    *,
    across: int = RAYS_ACROSS,
    steps: int = STEPS,
    rules: tuple[tuple[str, float], ...] = RULES,
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """For each rule, |f - level| and |t - t*| (steps + 1, rays) over the rays that hit the 2 pi
    level of a polygon (n, 3) that is a graph over the plane."""
    import igl

    field = hk.SolidAngle(loop)
    eye, d = camera(across)
    exact = hk.trace(field, eye[None], d, precision="double", tolerance=1e-10)
    d, t_exact = d[exact.status == hk.RayStatus.HIT], exact.t[exact.status == hk.RayStatus.HIT]
    start, _ = _clip(field, eye, d)
    results: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for enclosures, over_relaxation in rules:
        lengths = [start]
        for k in range(1, steps + 1):
            hits = hk.trace(
                field, eye[None], d, precision="double", tolerance=1e-12,
                max_steps=k, enclosures=enclosures, over_relaxation=over_relaxation,
            )  # fmt: skip
            lengths.append(hits.t)
        results[enclosures] = _measure(field, eye, d, np.array(lengths), t_exact)
    vertices, faces = meshed(loop)
    tree = igl.AABB()
    tree.init(vertices, faces)
    t, lengths = start.copy(), [start]
    for _ in range(steps):
        distance = np.sqrt(tree.squared_distance(vertices, faces, eye + t[:, None] * d)[0])
        t = t + np.where(distance < ARRIVED, 0, distance)  # a ray that has arrived stays
        lengths.append(t)
    results["sphere tracing, exact distance"] = _measure(field, eye, d, np.array(lengths), t_exact)
    return results


def _clip(field: hk.SolidAngle, eye: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from harnack.backend import choose_backend, to_float, to_numpy, to_vector3

    backend = choose_backend("double")
    volume = field.extent((field.default_level,))
    assert volume is not None
    rays = to_vector3(backend, eye[None]), to_vector3(backend, d)
    interval = to_float(backend, 0.0), to_float(backend, 10.0)
    near, far = volume.upload(backend).clip(*rays, *interval)
    return to_numpy(near), to_numpy(far)


def _measure(
    field: hk.SolidAngle, eye: np.ndarray, d: np.ndarray, t: np.ndarray, t_exact: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    from harnack.backend import choose_backend, to_numpy, to_vector3

    backend = choose_backend("double")
    points = (eye + t[..., None] * d).reshape(-1, 3)
    f = to_numpy(field.evaluate(to_vector3(backend, points)).value).reshape(t.shape)
    gap = np.abs((f - field.default_level + 2 * np.pi) % (4 * np.pi) - 2 * np.pi)
    return gap, np.abs(t - t_exact)


def plot(path: Path) -> dict[str, tuple[float, ...]]:
    """Write the plot; return, for each rule, the median steps to |t - t*| < 1e-3, 1e-4 and 1e-5."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rule_errors = errors(example_curves.wavy_polygon(64))
    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained")
    summary: dict[str, tuple[float, ...]] = {}
    for name, (gap, along) in rule_errors.items():
        for axis, error in zip(axes, (gap, along), strict=True):
            mean = np.exp(np.log(np.maximum(error, 1e-13)).mean(axis=1))
            axis.semilogy(mean[:SHOWN], label=name)
        reached = [(along < eps).argmax(axis=0) for eps in GOALS]
        never = [~(along < eps).any(axis=0) for eps in GOALS]
        counts = [np.where(n, np.inf, r) for r, n in zip(reached, never, strict=True)]
        summary[name] = tuple(float(np.median(count)) for count in counts)
    axes[0].set(xlabel="evaluations", ylabel="|f - level| (geometric mean)")
    axes[1].set(xlabel="evaluations", ylabel="|t - t*| (geometric mean)")
    axes[0].legend()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
    return summary
