"""Derivatives of pictures by twelve parameters, beside differences of pictures."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import drjit as dr
import numpy as np

import harnack as hk
from harnack.backend import choose_backend

_CAMERA = hk.Camera(position=(2.2, -2.2, 1.6), target=(0, 0, 0), fov=40)
_LOOP = hk.geometry.example_curves.wavy_polygon(12)
_CUBE = hk.Cuboid((0.6, 0.6, 0.6))
_SHOWS = "mask", "shaded", "depth", "normals"
# Pictures: their size, and the number of seeds, of derivatives and of differences. Differences are
# those of larger pictures with more rays a pixel.
_SIZE, _SEEDS = 96, 24
_FINE_SIZE, _FINE_SAMPLES, _FINE_SEEDS = 192, 2, 6


class Parameter(NamedTuple):
    """A number by which a picture is differentiated.

    make: the surface and the keywords of `picture` from the number.
    value, step: the number, and the step of central differences.
    """

    make: Callable[[Any], tuple[Any, dict[str, Any]]]
    value: float
    step: float


def _lifted(height: Any) -> Any:
    """The curve with one vertex lifted."""
    if not dr.is_array_v(type(height)):
        return _LOOP + np.where(np.arange(12) == 3, height, 0.0)[:, None] * [0, 0, 1]
    backend = choose_backend("double")
    lift = dr.select(dr.arange(backend.UInt32, 12) == 3, height, 0.0)
    return backend.Array3f(_LOOP.T) + backend.Array3f(0, 0, 1) * lift


def _waves(a: Any) -> Any:
    """A formula in a box."""
    return hk.expression(
        lambda x, y, z, a: hk.math.sin(3 * x) * hk.math.cos(3 * y) + a * z,
        a=a,
        domain=hk.Box((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6)),
    )


def _ring(x: Any) -> Any:
    """Five blobs on a ring; one of them moves outwards."""
    angle = np.arange(5) * 0.4 * np.pi
    centers = [(0.6 * c, 0.6 * s, 0.0) for c, s in zip(np.cos(angle), np.sin(angle), strict=True)]
    return hk.Blobs([(x, 0.0, 0.0), *centers[1:]], [0.6] * 5)


PARAMETERS: dict[str, Parameter] = {
    "curve, a vertex": Parameter(lambda x: (hk.SolidAngle(_lifted(x)), {}), 0.0, 0.02),
    "curve, its level": Parameter(lambda x: (hk.SolidAngle(_LOOP), {"level": x}), 2 * np.pi, 0.05),
    "ball, its radius": Parameter(lambda x: (hk.Sphere(x), {}), 0.7, 0.01),
    "box, a side": Parameter(
        lambda x: (hk.Cuboid((1.2, x, 0.8)).rotated(20, (1, 2, 3)), {}), 1.0, 0.01
    ),
    "ball and box, a translation": Parameter(
        lambda x: (hk.Sphere(0.5) | _CUBE.translated((x, 0.1, 0.3)), {}), 0.4, 0.01
    ),
    "ball and box, their blend": Parameter(
        lambda x: (hk.Sphere(0.5).blended(_CUBE.translated((0.4, 0.1, 0.3)), x), {}), 0.2, 0.02
    ),
    "ball minus box, an angle": Parameter(
        lambda x: (hk.Sphere(0.7) - hk.Cuboid((0.5, 0.9, 2)).rotated(x, (1, 0, 0.3)), {}),
        25.0, 1.0,
    ),
    "torus, its large radius, cut": Parameter(
        lambda x: (hk.Torus(x, 0.25), {"clip": hk.HalfSpace((0.3, 1, 0.2), 0.0)}), 0.7, 0.01
    ),
    "formula in a box, a number": Parameter(lambda x: (_waves(x), {"level": 0.0}), 1.0, 0.02),
    "harmonics, a weight": Parameter(
        lambda x: (
            hk.fields.FieldSum([hk.SphericalHarmonic(2, 0), hk.SphericalHarmonic(3, 1)], [2.0, x]),
            {"level": 0.3},
        ),
        0.5, 0.02,
    ),
    "five blobs, a center": Parameter(lambda x: (_ring(x), {"level": 0.2}), 0.6, 0.01),
    "capsule, an end": Parameter(
        lambda x: (hk.Capsule((-0.4, 0.1, -0.3), (0.5, x, 0.4), 0.2), {}), 0.0, 0.02
    ),
}  # fmt: skip


class _Estimate(NamedTuple):
    """The mean over seeds, its standard deviation, and the median time of one seed."""

    mean: float
    deviation: float
    seconds: float

    @classmethod
    def of(cls, compute: Callable[[int], float], seeds: int) -> _Estimate:
        """The estimate from a function of the seed."""
        numbers, times = [], []
        for seed in range(seeds):
            start = time.perf_counter()
            numbers.append(compute(seed))
            times.append(time.perf_counter() - start)
        deviation = statistics.stdev(numbers) / seeds**0.5
        return cls(statistics.mean(numbers), deviation, statistics.median(times))


def _derivative(parameter: Parameter, show: str) -> _Estimate:
    """The derivative of the mean color."""
    number = choose_backend("double").Float

    def compute(seed: int) -> float:
        """That of one picture."""
        x = number(parameter.value)
        dr.enable_grad(x)
        surface, keywords = parameter.make(x)
        image = hk.picture(surface, camera=_CAMERA, size=_SIZE, show=show, seed=seed, **keywords)
        dr.backward(dr.mean(image, axis=None))
        return float(dr.grad(x)[0])

    return _Estimate.of(compute, _SEEDS)


def _difference(parameter: Parameter, show: str) -> _Estimate:
    """The central difference of the mean color of pictures with the same random numbers."""

    def compute(seed: int) -> float:
        """That of two pictures."""
        means = []
        for x in (parameter.value + parameter.step, parameter.value - parameter.step):
            surface, keywords = parameter.make(x)
            image = hk.picture(
                surface, camera=_CAMERA, size=_FINE_SIZE, samples=_FINE_SAMPLES, show=show,
                seed=seed, precision="double", **keywords,
            )  # fmt: skip
            means.append(float(image.mean()))
        return (means[0] - means[1]) / (2 * parameter.step)

    return _Estimate.of(compute, _FINE_SEEDS)


def derivatives() -> str:
    """The section of the page."""
    lines = [
        "## Derivatives of pictures\n",
        "Of the mean color of pictures by `hk.picture`, by twelve parameters, outlines, creases, "
        f"cuts and ends included: the mean over {_SEEDS} pictures of {_SIZE}² pixels, one ray a "
        "pixel. Beside it central differences of the mean colors of pictures of "
        f"{_FINE_SIZE}² pixels with {_FINE_SAMPLES**2} rays each and the same random numbers, the "
        f"mean over {_FINE_SEEDS} seeds. Both with a standard deviation. The last columns: their "
        "distance in these, and the time of a picture with its derivative.\n",
        "| parameter | picture | derivative | difference | deviations | time, ms |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for name, parameter in PARAMETERS.items():
        for show in _SHOWS:
            ours, other = _derivative(parameter, show), _difference(parameter, show)
            spread = float(np.hypot(ours.deviation, other.deviation))
            lines.append(
                f"| {name} | {show} | {ours.mean:.5f} ± {ours.deviation:.5f} | "
                f"{other.mean:.5f} ± {other.deviation:.5f} | "
                f"{abs(ours.mean - other.mean) / max(spread, 1e-12):.1f} | "
                f"{1000 * ours.seconds:.0f} |"
            )
    return "\n".join(lines) + "\n"
