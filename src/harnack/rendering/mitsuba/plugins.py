"""Our plug-ins, made known to Mitsuba, so that scene files can name them.

<shape type="harnack">
    <string name="file" value="curve.loops"/>      curves of an .obj, .ply or .loops file, or
    <string name="field" value="gyroid"/>          gyroid, schwarz_p or schwarz_d with cell,
                                                    spherical_harmonic with integers l and m
    <float name="level" value="0"/>                or low and/or high, of a closed solid
    <float name="clip_radius" value="1"/>          a ball about clip_center, and/or a box from
    <point name="clip_lower" x="-1" y="0" z="0"/>  clip_lower to clip_upper
    <float name="tolerance" value="1e-4"/>         and the integer max_steps
    <boolean name="confirm" value="true"/>         hits only where the field changes sign
    <transform name="to_world"> ... </transform>   moves, turns and one scale for all axes
    <bsdf type="..."/>
</shape>
<integrator type="harnack_path"/>                  max_depth, rr_depth, hide_emitters, clamp
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from harnack.fields.curves.solid_angle import SolidAngle
from harnack.fields.polynomials.polynomial import SphericalHarmonic
from harnack.fields.waves.periodic import Gyroid, SchwarzD, SchwarzP
from harnack.files import read_loops
from harnack.geometry import Ball, Box, Intersection
from harnack.names import did_you_mean
from harnack.rendering.mitsuba import carrier, integrator
from harnack.rendering.mitsuba.other_integrators import watch
from harnack.rendering.mitsuba.variant import load_mitsuba
from harnack.tracer import LevelSet, level_set

if TYPE_CHECKING:
    from harnack.fields import Field
    from harnack.geometry import Volume

_PERIODIC = {"gyroid": Gyroid, "schwarz_p": SchwarzP, "schwarz_d": SchwarzD}


def register() -> Any:
    """Make `harnack` (shape) and `harnack_path` (integrator) known, and return `mitsuba`.

    Needed once in each variant, before a scene that names them is loaded with Mitsuba's own
    functions; `render` and `shape` do it by themselves. From then on `mitsuba.render` warns of
    surfaces that another integrator would leave out.
    """
    mi = register_surfaces(carrier.PLUGIN, surface_of)
    mi.register_integrator(integrator.PLUGIN, integrator.integrator_class(mi.variant()))
    watch(mi)
    return mi


def register_surfaces(plugin: str, surface: Callable[[Any], LevelSet]) -> Any:
    """Make a shape known whose surfaces come from a function of `mitsuba.Properties`.

    The function reads what it understands; `to_world` and BSDF are taken care of.
    """
    mi = load_mitsuba()

    def made(props: Any) -> Any:
        return carrier.from_properties(mi, props, surface(props).in_one_call())

    mi.register_shape(plugin, made)
    return mi


def surface_of(props: Any) -> LevelSet:
    """The surface that the properties of a `harnack` shape describe.

    Raises:
        ValueError: they describe none, or contradict each other.
    """
    settings: dict[str, Any] = {"clip": _clip(props)}
    if "low" in props or "high" in props:
        settings["solid"] = (props.get("low", -math.inf), props.get("high", math.inf))
    for name in ("level", "tolerance", "max_steps", "confirm"):
        if name in props:
            settings[name] = props[name]
    return level_set(_field(props), **settings)


def _field(props: Any) -> Field:
    if ("file" in props) == ("field" in props):
        raise ValueError("a harnack shape needs either a file of curves or a field")
    if "file" in props:
        path = load_mitsuba().file_resolver().resolve(props["file"])
        return SolidAngle(read_loops(str(path), boundary=props.get("boundary", False)))
    name = props["field"]
    if name in _PERIODIC:
        # The clip takes the place of the field's own domain.
        return _PERIODIC[name](props.get("cell", 2 * math.pi), domain=_clip(props))
    if name == "spherical_harmonic":
        return SphericalHarmonic(props["l"], props["m"])
    known = (*_PERIODIC, "spherical_harmonic")
    raise ValueError(
        f"unknown field {name!r}; there are {', '.join(known)}{did_you_mean(name, known)}"
    )


def _clip(props: Any) -> Volume | None:
    volumes: list[Volume] = []
    if "clip_radius" in props:
        center = props.get("clip_center", [0.0, 0.0, 0.0])
        volumes.append(Ball(_point(center), props["clip_radius"]))
    if ("clip_lower" in props) != ("clip_upper" in props):
        raise ValueError("a clip box needs both clip_lower and clip_upper")
    if "clip_lower" in props:
        volumes.append(Box(_point(props["clip_lower"]), _point(props["clip_upper"])))
    if len(volumes) > 1:
        return Intersection(volumes)
    return volumes[0] if volumes else None


def _point(value: Any) -> tuple[float, float, float]:
    x, y, z = (float(component) for component in value)
    return x, y, z
