"""The worth of a bounded Laplacian: the gyroid with more and more promises."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr

import harnack as hk
from harnack.backend.elementary import fmax, fmin

from .rays import measure
from .scenes import Scene

_CELL = 2 / 3
_DOMAIN = hk.Ball(radius=1.0)
# Of f at cell 2 pi: |f| <= 3/2 and |grad f| <= sqrt 3, both attained, and Laplacian f = -2f.
_LARGEST, _STEEPEST = 1.5, math.sqrt(3)


class GyroidByLaplacian(hk.Field):
    """sin x cos y + sin y cos z + sin z cos x, with coordinates in units of cell/(2 pi), of which
    no second derivative is known but their sum, -2f.

    cell: edge length of the cubic cell. share: the radius of the promise's balls, in units of
    cell/(2 pi), 3 by experiment. None: f is only known to be Lipschitz. domain: where it is drawn.

    On a ball of radius r (in those units) f stays within [-3/2, 3/2] and within sqrt(3) r of its
    value at the center, and the Laplacian between these ends times -2.
    """

    default_level = 0.0

    def __init__(
        self, cell: float = _CELL, share: float | None = 3.0, domain: hk.Ball = _DOMAIN
    ) -> None:
        self.scale, self.share, self.domain = 2 * math.pi / cell, share, domain

    def evaluate(self, p: Any) -> hk.fields.Sample:
        k = self.scale
        (sx, cx), (sy, cy), (sz, cz) = (dr.sincos(k * coordinate) for coordinate in (p.x, p.y, p.z))
        value = sx * cy + sy * cz + sz * cx
        gradient = k * type(p)(cx * cy - sz * sx, cy * cz - sx * sy, cz * cx - sy * sz)
        if self.share is None:
            return hk.fields.Sample(
                value, gradient, (hk.proofs.Lipschitz(k * _STEEPEST * (1 + 1e-6)),)
            )
        movement = _STEEPEST * self.share + 1e-5
        lower = fmax(value - movement, -_LARGEST - 1e-5)
        upper = fmin(value + movement, _LARGEST + 1e-5)
        ends = -2 * k * k * upper, -2 * k * k * lower
        radius = type(value)(self.share / k)
        return hk.fields.Sample(
            value, gradient, (hk.proofs.BoundedLaplacian(radius, lower, upper, *ends),)
        )


def laplacian() -> str:
    """The section of the page."""
    gyroid = Scene("gyroid", lambda: hk.Gyroid(cell=_CELL, domain=_DOMAIN))
    known: tuple[tuple[str, str, hk.Field | None], ...] = (
        ("a Lipschitz constant: sphere tracing", "lipschitz", GyroidByLaplacian(share=None)),
        ("a bounded Laplacian", "laplacian", GyroidByLaplacian()),
        ("the harmonic extension to R^4", "caps", None),
        ("second derivatives", "curvature", None),
    )
    lines = [
        "## Bounded Laplacians\n",
        "The gyroid, 3 cells across, with ever more known of it: the largest |grad f|; |f| <= 3/2 "
        "and Laplacian f = -2 k^2 f as well (k = 2 pi/cell); its extension to a harmonic function "
        "of four dimensions; all second derivatives. Without and with over-stepping.\n",
        "| what is known | over-stepping | evaluations, all | hitting | most | out of steps "
        "| hits |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name, enclosures, field in known:
        for over_relaxation in (1.0, 1.4):
            row = measure(gyroid, (name, enclosures, over_relaxation), field)
            lines.append(
                f"| {name} | {over_relaxation} | {row.evaluations:.2f} "
                f"| {row.evaluations_hitting:.2f} | {row.most} | {row.out_of_steps} | {row.hits} |"
            )
    return "\n".join(lines) + "\n"
