"""Fig. 12: formulas for the solid angle and its gradient, in single precision."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import harnack as hk
from benchmarks import formulas
from benchmarks.baselines import APART
from harnack.geometry import example_curves

from .figure import Report
from .panels import Panel, doubled, fitting, montage
from .published import MOST, Claim, distance_to_loop, published
from .view import FALSE, MISSED, Array, View, marked

# Normals with a larger error than this, in degrees, are marked.
_OFF = 1.0
# A ball around the origin that holds the surface.
_REACH = 1.3


def figure_12(width: int) -> Report:
    """First hits by three formulas of the value; normals by three of the gradient."""
    loop = example_curves.wavy_polygon(8).astype(np.float32)
    field = hk.SolidAngle(loop)
    view = View.of(loop, fitting(width // 2))  # these formulas take a minute in NumPy
    truth = view.trace(field, tolerance=1e-7, precision="double")
    is_near = view.eye @ view.eye - (view.directions() @ view.eye) ** 2 < _REACH**2
    d = view.directions()[is_near].astype(np.float32)
    middle = -(d @ view.eye.astype(np.float32))
    distance = distance_to_loop(loop)
    first, second, texts = [], [], []
    values: tuple[tuple[str, Callable[[Array, Array], Array]], ...] = (
        ("fan of triangles", formulas.fan), ("quaternions", formulas.quaternions),
        ("angle sum", formulas.angle_sum),
    )  # fmt: skip
    for name, value in values:

        def look(p: Array, value: Callable[[Array, Array], Array] = value) -> tuple[Array, ...]:
            with np.errstate(all="ignore"):
                return value(loop, p), formulas.adiels(loop, p), distance(p)

        claim = Claim(look, -4 * np.pi, 2 * np.pi, 4 * np.pi)
        with np.errstate(all="ignore"):
            ends = published(claim, view.eye, d, middle - _REACH, middle + _REACH)
        t = np.full(len(is_near), np.inf)
        t[is_near] = ends.t
        real = np.where(truth.is_hit, truth.t, np.inf)
        lost = np.zeros(len(is_near), bool)
        lost[is_near] = ~np.isfinite(ends.t) & (ends.evaluations >= MOST)
        missed = truth.is_hit & (t > real + APART) & ~lost
        false = np.isfinite(t) & (t < real - APART)
        shown = view.shade(truth.normal, truth.is_hit)
        for is_marked, color in ((missed, MISSED), (false, FALSE)):
            shown = marked(shown, is_marked, color)
        first.append(Panel(doubled(shown), name))
        texts.append(
            f"{name} {int(missed.sum()):,} missed, {int(false.sum()):,} false, "
            f"{int(lost.sum()):,} out of {MOST} steps"
        )
    ours = view.trace(field)
    unequal = truth.is_hit & ~(ours.t < truth.t + APART) | ours.is_hit & ~truth.is_hit
    wrong: list[str] = []
    gradients: tuple[tuple[str, Callable[[Array, Array], Array]], ...] = (
        ("Biot-Savart", formulas.biot_savart), ("Adiels", formulas.adiels),
        ("differences", formulas.differences),
    )  # fmt: skip
    at = truth.position[truth.is_hit].astype(np.float32)
    for name, gradient in gradients:
        with np.errstate(all="ignore"):
            directions = gradient(loop, at).astype(np.float64)
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        angle = np.degrees(
            np.arccos(np.clip((directions * truth.normal[truth.is_hit]).sum(axis=1), -1, 1))
        )
        normal = np.zeros_like(truth.normal)
        normal[truth.is_hit] = np.nan_to_num(directions)
        is_off = np.zeros(len(is_near), bool)
        is_off[truth.is_hit] = ~(angle < _OFF)
        shown = marked(view.shade(normal, truth.is_hit), is_off, MISSED)
        second.append(Panel(doubled(shown), name))
        wrong.append(f"{name} {int(is_off.sum()):,} (median {np.nanmedian(angle):.1e} degrees)")
    caption = (
        "Top (unproved): first hits by the published algorithm in single precision with three "
        f"formulas of the solid angle of 8 vertices, of {int(truth.is_hit.sum()):,} hits; missed "
        f"ones are magenta, hits where nothing is or more than {APART} before the surface green: "
        f"{'; '.join(texts)}. `hk.trace` in single precision differs from the reference on "
        f"{int(unequal.sum())} rays. Bottom: normals at the same hits by three formulas of the "
        f"gradient; off by more than {_OFF:g} degree in magenta: "
        f"{'; '.join(wrong)}. The errors "
        "at random points are in [benchmarks](benchmarks.md)."
    )
    differs = (
        "The paper's polygon is not public. Its angle sum is in its supplement, which we do not "
        "have; ours is 2π less the exterior angles, which is right modulo 2π only, so that "
        "levels that do not exist are false hits as well. Differences are of the fan, 1e-3 "
        "apart, as it is: where its terms jump between the corners of the tetrahedron, the "
        "normal is wrong."
    )
    return Report(montage(first, second), caption, differs)
