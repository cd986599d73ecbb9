"""Named materials: Mitsuba BSDF dictionaries that look well in the studio."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

from harnack.names import did_you_mean
from harnack.rendering.surfaces.colors import NAMED_COLORS, Color, color_of, linear

Dictionary = dict[str, Any]

# How rough a surface is that only a color is given of: between porcelain and eggshell. No paint
# reflects all light, or none.
_PAINT, _BLACK, _WHITE = 0.2, 0.005, 0.9


def _rgb(color: Color) -> Dictionary:
    """A color as linear sRGB reflectance."""
    return {"type": "rgb", "value": list(color)}


def _glazed(color: Color, roughness: float) -> Dictionary:
    """A colored base under a clear coat."""
    return {
        "type": "roughplastic",
        "diffuse_reflectance": _rgb(color),
        "alpha": roughness,
        "nonlinear": True,
    }


def _metal(name: str, roughness: float) -> Dictionary:
    return {"type": "roughconductor", "material": name, "alpha": roughness, "distribution": "ggx"}


@dataclass(frozen=True)
class Material:
    """What a surface is made of.

    front: BSDF of the side of larger values (the normal's side); of a solid, its outside.
    back: of the other side of an open surface; None for the same as the front.
    two_sided: whether open surfaces are to be seen from both sides. A BSDF that takes care of
        that itself does not want it.
    transparent: light passes through it, so that only a solid can be made of it.
    tint: what it leaves of red, green and blue light that passes through one unit of length on the
        stage, where half the diagonal of all that stands there is 1; None for all.
    """

    front: Dictionary
    back: Dictionary | None = None
    two_sided: bool = True
    transparent: bool = False
    tint: Color | None = None

    def __post_init__(self) -> None:
        if self.tint is not None and not self.transparent:
            raise ValueError(
                "tint needs a material that light passes through: give transparent=True too"
            )

    def bsdf(self, *, solid: bool, traced_light: bool = True) -> Dictionary:
        """The BSDF's dictionary for a solid or an open surface.

        traced_light: whether light is to be traced at it; otherwise only its diffuse reflectance
            and its kind are asked for, and the dictionary may be of a BSDF that is made sooner.

        Raises:
            ValueError: the material is transparent, and the surface is open.
        """
        front, back = self.front, self.back
        if not traced_light:
            front, back = _without_table(front), back and _without_table(back)
        if solid:
            return front
        if self.transparent:
            raise ValueError(
                "light passes through this material, so what is made of it needs an inside: give "
                "solid=(low, high), for instance solid=(-math.inf, level)"
            )
        if not self.two_sided:
            return front
        nested: Dictionary = {"type": "twosided", "front": front}
        return nested if back is None else {**nested, "back": back}


def _without_table(bsdf: Dictionary) -> Dictionary:
    """A BSDF with the same diffuse reflectance, which takes no 0.07 s for a table of what a rough
    coat lets through."""
    if bsdf.keys() != _glazed((0, 0, 0), 0).keys() or bsdf["type"] != "roughplastic":
        return bsdf
    return {**{key: bsdf[key] for key in bsdf if key != "alpha"}, "type": "plastic"}


def _tinted(tint: Color, index: float = 1.5) -> Material:
    """Glass that takes some of the light away."""
    glass: Dictionary = {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}
    return Material(glass, transparent=True, tint=tint)


def _painted(color: Color) -> Material:
    red, green, blue = (max(_WHITE * part, _BLACK) for part in color)
    return Material(_glazed((red, green, blue), _PAINT))


MATERIALS: Mapping[str, Material] = {
    "two-tone": Material(_glazed((0.80, 0.255, 0.11), 0.22), _glazed((0.07, 0.25, 0.40), 0.22)),
    "eggshell": Material(_glazed((0.66, 0.13, 0.06), 0.3), _glazed((0.80, 0.74, 0.64), 0.3)),
    "clay": Material({"type": "diffuse", "reflectance": _rgb((0.72, 0.62, 0.53))}),
    "porcelain": Material(_glazed((0.84, 0.83, 0.80), 0.06)),
    "plastic": Material(_glazed((0.62, 0.05, 0.07), 0.10)),
    "gold": Material(_metal("Au", 0.10)),
    "copper": Material(_metal("Cu", 0.12)),
    "silver": Material(_metal("Ag", 0.12)),
    "glass": Material({"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}, transparent=True),
    "frosted": Material(
        {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.12}, transparent=True
    ),
    "amber": _tinted((0.86, 0.42, 0.06)),
    "cobalt": _tinted((0.10, 0.24, 0.72)),
    "jelly": _tinted((0.80, 0.12, 0.16), 1.35),
}
"""Materials by name."""


def material_of(wanted: Any) -> Material:
    """A material from its name, from a color, or from a BSDF dictionary used as it stands.

    Raises:
        TypeError: it is none of these.
        ValueError: there is no material or color of that name.
    """
    if wanted is None:
        return MATERIALS["two-tone"]
    if isinstance(wanted, Material):
        return wanted
    if isinstance(wanted, Mapping):
        return Material(dict(cast("Mapping[str, Any]", wanted)), two_sided=False)
    if isinstance(wanted, str) and wanted.strip().lower() in MATERIALS:
        return MATERIALS[wanted.strip().lower()]
    try:
        return _painted(linear(color_of(wanted, "material")))
    except TypeError:
        raise TypeError(
            f"a material is a name, a color, a Material or a BSDF dictionary, not {wanted!r}; "
            f"there are {', '.join(MATERIALS)}"
        ) from None
    except ValueError:
        raise ValueError(
            f"unknown material {wanted!r}; there are {', '.join(MATERIALS)}, and colors, by a "
            f'name of CSS, "#rrggbb" or three numbers from 0 to 1'
            f"{did_you_mean(wanted, (*MATERIALS, *NAMED_COLORS))}"
        ) from None
