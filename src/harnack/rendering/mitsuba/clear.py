"""Clear matter: solids that light passes through, what they take away of it, and how they bend it.

What a solid takes away follows Beer and Lambert: of light that travels a length t in it, the part
tint^t is left. As going in and out of a solid alternate (`CappedSolid.meet`), a ray that leaves a
point of its boundary against the outward normal is inside up to the next thing that it meets.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

# A solid whose index of refraction differs less from 1 does not bend light.
_SAME = 1e-6


def tint_of(mi: Any, tint: Any) -> Any:
    """A texture of what is left of light after one unit of length; None where all of it is.

    Raises:
        TypeError, ValueError: not three numbers in (0, 1].
    """
    if tint is None:
        return None
    wrong = "tint is what is left of red, green and blue after one unit of length, in (0, 1]"
    try:
        color = [float(part) for part in tint]
    except (TypeError, ValueError):
        raise TypeError(f"{wrong}, such as (0.9, 0.5, 0.1), not {tint!r}") from None
    if len(color) != 3 or not all(0 < part <= 1 for part in color):
        raise ValueError(f"{wrong}, such as (0.9, 0.5, 0.1), not {tint!r}")
    if min(color) == 1:
        return None
    return mi.load_dict({"type": "srgb", "color": color}, parallel=False)


def index_of(mi: Any, carrier: Any) -> Any:
    """The index of refraction of a solid that light passes through, relative to what is around it,
    as a number that no kernel is compiled anew for; None for what is opaque, or no solid."""
    bsdf = carrier.bsdf()
    passes = (mi.BSDFFlags.DeltaTransmission, mi.BSDFFlags.GlossyTransmission)
    if carrier.surface.solid is None or not any(mi.has_flag(bsdf.flags(), one) for one in passes):
        return None
    named = mi.traverse(bsdf)
    for name, _ in named:
        if name == "eta":
            return dr.opaque(mi.Float, float(np.ravel(named[name])[0]))
    return None


def is_inside(mi: Any, carrier: Any, start: Any, d: Any) -> Any:
    """Whether rays that leave interactions in directions d run inside a carrier's solid."""
    leaves = start.is_valid() & (start.shape == mi.ShapePtr(carrier))
    return leaves & (dr.dot(start.n, d) < 0)


def transmittance(mi: Any, carriers: Any, start: Any, si: Any, d: Any) -> Any:
    """What is left of light between interactions, along rays from `start` in directions d."""
    left = mi.Spectrum(1)
    for carrier in carriers:
        if carrier.tint is None:
            continue
        inside = is_inside(mi, carrier, start, d) & si.is_valid()
        # The spectrum of a reflectance of that color, at the ray's wavelengths.
        once = mi.Spectrum(carrier.tint.eval(si, inside))
        left *= dr.select(inside, dr.power(dr.maximum(once, 1e-6), si.t), 1)
    return left


def refracted(normal: Any, d: Any, index: Any) -> tuple[Any, Any]:
    """Where rays in unit directions d go through a boundary with an outward unit normal, and how
    much of unpolarized light is reflected there (Fresnel). All of it is where it is 1: then the
    direction is that of the mirror.

    index: of refraction, of the inside relative to the outside.
    """
    along = dr.dot(normal, d)
    entering = along < 0
    eta = dr.select(entering, 1 / index, index)
    facing = dr.select(entering, 1, -1) * normal
    cosine = dr.clip(dr.abs(along), 0, 1)
    inner = 1 - eta * eta * (1 - cosine * cosine)
    passes = inner > 0
    inner = dr.sqrt(dr.maximum(inner, 0))
    across = (eta * cosine - inner) / dr.maximum(eta * cosine + inner, 1e-9)
    within = (cosine - eta * inner) / dr.maximum(cosine + eta * inner, 1e-9)
    reflected = dr.select(passes, 0.5 * (across * across + within * within), 1)
    reflected = dr.select(dr.abs(index - 1) < _SAME, 0, reflected)
    through = eta * d + (eta * cosine - inner) * facing
    away = d + 2 * cosine * facing
    return dr.normalize(dr.select(passes, through, away)), reflected
