"""Figs. 7, 19, 20 and 21: harmonics, Riemann surfaces, the gyroid, eigenfunctions."""

from __future__ import annotations

import math

import numpy as np

import harnack as hk
from harnack.rendering import Camera

from .figure import Counts, Report
from .panels import Panel, drawn, fitting, halved, montage, scene
from .view import BACK, FRONT, View


def figure_7(width: int) -> Report:
    """Level sets of the harmonic polynomials of degrees 1 to 4 in the unit ball."""
    side = max(24, round(0.5 * width))
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.68
    view = View.of(corners, (2 * side, 2 * side), Camera(azimuth=-60, elevation=25))
    ball = hk.Ball(radius=1.0)
    rows: list[list[Panel]] = []
    totals, hits_of, most, lost = [], [], 0, 0
    for degree in range(1, 5):
        row = []
        for order in range(degree + 1):
            field = hk.SphericalHarmonic(degree, order)
            values = field.value(_sphere(), precision="single")
            lower, upper = float(values.min()), float(values.max())
            levels = [0.5 * lower, 0.15 * lower, 0.15 * upper, 0.5 * upper]
            hits = view.trace(field, level=levels, clip=ball)
            counts = Counts.of(hits.status, hits.evaluations)
            totals.append(counts.evaluations)
            hits_of.append(counts.evaluations_hitting)
            most, lost = max(most, counts.most), lost + counts.out_of_steps
            positive = (hits.value > 0)[:, None]
            color = np.where(positive, FRONT, BACK)
            row.append(Panel(halved(view.shade(hits.normal, hits.is_hit, color, 0.8 * color)),
                             f"l = {degree}, m = {order}"))  # fmt: skip
        rows.append(row)
    caption = (
        f"Level sets of the {len(totals)} solid harmonics of degrees 1 to 4 with m ≥ 0, cut to "
        "the unit ball: levels 0.15 and 0.5 of the least and the largest value on the sphere, "
        f"positive ones red, traced at once. Evaluations a ray {min(totals):.1f} to "
        f"{max(totals):.1f}, a hitting ray {min(hits_of):.1f} to {max(hits_of):.1f}, {most} at "
        f"most, {lost} rays out of steps. Bounds are proved from the coefficients, without the "
        "radius 1.25 and the constant of the paper."
    )
    differs = "The paper does not give its levels. Orders m < 0 are the same surfaces, turned."
    return Report(montage(*rows), caption, differs)


def _sphere() -> np.ndarray:
    """Points (n, 3), evenly spread over the unit sphere."""
    k = np.arange(4000) + 0.5
    z, angle = 1 - 2 * k / 4000, np.pi * (1 + math.sqrt(5)) * k
    across = np.sqrt(1 - z * z)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])


def figure_19(width: int) -> Report:
    """Riemann surfaces, with and without a cut to a ball."""
    names = (
        ("riemann-log", "log"), ("riemann-sqrt", "square root"), ("riemann-cbrt", "cube root"),
        ("riemann-asin", "arc sine, real part"),
    )  # fmt: skip
    top, texts = [], []
    for name, label in names:
        picture, counts = scene(name, width)
        top.append(Panel(picture, label))
        texts.append(f"{label} {counts.evaluations:.1f} and {counts.evaluations_hitting:.1f}")
        assert counts.out_of_steps == 0, name
    opened = {
        "log": ("log", "imag", 30.0, Camera(azimuth=-60, elevation=12, zoom=2.2)),
        "square root": ("sqrt", "imag", 6.0, Camera(azimuth=-60, elevation=24, zoom=2.2)),
        "cube root": ("cbrt", "imag", 6.0, Camera(azimuth=-60, elevation=24, zoom=2.2)),
        "arc sine": ("asin", "real", 20.0, Camera(azimuth=-70, elevation=15, zoom=2.2)),
    }
    below = []
    for label, (function, part, radius, camera) in opened.items():
        field = hk.fields.RiemannSurface(function, part, domain=hk.Ball(radius=radius))
        picture, counts = drawn(
            field,
            fitting(width),
            tolerance=2e-4,
            camera=camera,
            material="two-tone",
        )
        below.append(Panel(picture, f"{label}, full view"))
        texts.append(
            f"{label}, whole picture, {counts.evaluations:.1f} and {counts.evaluations_hitting:.1f}"
        )
        assert counts.out_of_steps == 0, label
    caption = (
        "Graphs of the imaginary part of the logarithm, the square and the cube root and of the "
        "real part of the arc sine with all their branches: cut to a ball (top) and filling the "
        "picture (bottom). Evaluations of all rays and of those that hit: "
        + "; ".join(texts)
        + ". No ray ran out of steps; branches are not followed, each step is free of every sheet."
    )
    differs = (
        "The paper names log and the square root only; the others are our choice. Balls are of "
        "radius 7, 1, 1 and 6, not all the unit ball; the full views are cut to balls of radius "
        "6 to 30 that are larger than the picture."
    )
    return Report(montage(top, below), caption, differs)


def figure_20(width: int) -> Report:
    """The gyroid."""
    camera = Camera(azimuth=-55, elevation=24)
    sheet = hk.Gyroid(cell=2 / 3, domain=hk.Ball(radius=1))
    pictures = [
        (drawn(sheet, fitting(2 * width), camera=camera), "level 0 in a ball, three cells across"),
        (
            drawn(
                hk.Gyroid(cell=0.8, domain=hk.Box((-1, -1, -1), (1, 1, 1))), fitting(2 * width),
                camera=camera, level=(-0.35, 0.35), side="between", material="silver",
            ),
            "a wall as it is printed, in a box",
        ),
    ]  # fmt: skip
    texts = [f"{label}: {counts}" for (_, counts), label in pictures]
    view = View.of(_sphere(), fitting(width), camera)
    published = view.trace(sheet, enclosures="classic", over_relaxation=1.75)
    counts = Counts.of(published.status, published.evaluations)
    caption = (
        "The gyroid sin x cos y + sin y cos z + sin z cos x, which is not harmonic, but a slice "
        "of a harmonic function of four variables. "
        "" + "; ".join(texts) + ". The published kind of step, "
        f"Harnack's inequality in four dimensions alone (over-stepping 1.75): {counts}."
    )
    differs = (
        "The paper's left half is a photograph of printed parts; ours is drawn. The extension "
        "here is even in the fourth variable, and steps rest on second derivatives where these "
        "prove more."
    )
    panels = [Panel(picture, label) for (picture, _), label in pictures]
    return Report(montage(panels), caption, differs)


def figure_21(width: int) -> Report:
    """The 1/2 level of a sum of two eigenfunctions."""
    camera = Camera(azimuth=-50, elevation=26)
    picture, counts = scene("eigenfunctions", 2 * width, camera=camera)
    terms = [
        hk.fields.WaveProduct(
            1.0, x=hk.fields.sine_factor(k), y=hk.fields.sine_factor(k), z=hk.fields.sine_factor(k)
        )
        for k in (6.0, 2.0)
    ]
    side = math.pi / 2
    box = hk.Box((-side, -side, -side), (side, side, side))
    field = hk.fields.EigenfunctionSum(terms, domain=box)
    corners = side * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    view = View.of(corners, fitting(width), camera)
    rows = []
    for name, enclosures, over_relaxation in (
        ("Harnack's inequality in four dimensions alone, over-stepping 1.75", "classic", 1.75),
        ("with the slope", "slope", 1.4),
        ("all proofs", None, None),
    ):
        hits = view.trace(field, level=0.5, enclosures=enclosures, over_relaxation=over_relaxation)
        rows.append(f"{name}: {Counts.of(hits.status, hits.evaluations)}")
    caption = (
        "The 1/2 level of sin 6x sin 6y sin 6z + sin 2x sin 2y sin 2z, as a solid in a cube of "
        f"side π: {counts}. The open surface in the same cube, by the proofs used: "
        f"{'; '.join(rows)}."
    )
    differs = (
        "The cube is our choice. The paper's bound c with R = 0.15 is not ours; see "
        "[benchmarks](benchmarks.md) for what each proof takes on other functions."
    )
    return Report(montage([Panel(picture, "level 1/2, solid")]), caption, differs)
