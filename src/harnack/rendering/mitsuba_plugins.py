"""Plug-ins for Mitsuba: a shape that is a surface of harnack (a level set of a field, or the
boundary of a solid), an integrator that sees such surfaces, and a replacement of `mitsuba.render`
that warns if another integrator cannot see them. `mi` is the Mitsuba module, and `props` are the
properties that a scene gives to a shape.

Scene files can name them once they are registered (`register`); `mitsuba_shape` makes surfaces for
scenes that are put together in Python.

<shape type="harnack">
    <string name="file" value="curve.loops"/>      curves of an .obj, .ply or .loops file, or
    <string name="field" value="gyroid"/>          gyroid, schwarz_p or schwarz_d with cell,
                                                    spherical_harmonic with integers l and m
    <float name="level" value="0"/>                or low and/or high, of a closed solid
    <float name="clip_radius" value="1"/>          a ball about clip_center, and/or a box from
    <point name="clip_lower" x="-1" y="0" z="0"/>  clip_lower to clip_upper
    <float name="tolerance" value="1e-4"/>         and the integer max_steps
    <boolean name="require_crossing" value="true"/> hits only where the field changes sign
    <transform name="to_world"> ... </transform>   moves, turns and one scale for all axes
    <bsdf type="..."/>
</shape>
<integrator type="harnack_path"/>                  max_depth, rr_depth, hide_emitters, clamp

Mitsuba's own integrators trace rays to Mitsuba's shapes only. A level set is represented by a proxy
mesh of two triangles, each of which is a single point, so they would draw nothing of it and say
nothing. Mitsuba calls no method of a shape while it renders, so `mitsuba.render` is replaced by a
function that checks the scene first and warns. `harnack.render` draws a scene by its own path
tracer if the scene's integrator computes the same light, as Mitsuba's `path` does. All other scenes
are left to Mitsuba, unless they have level sets that their integrator cannot see: these raise an
error.

Finding a hit and describing it to Mitsuba (`SurfaceInteraction`) are separate, since Mitsuba's next
release lets Python define shapes.
"""

from __future__ import annotations

import functools
import math
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

from harnack.fields import Field
from harnack.geometry import Ball, Box, VolumeIntersection
from harnack.name_suggestions import did_you_mean
from harnack.rendering import integrator, mitsuba_proxy
from harnack.rendering.integrator import INTEGRATOR, PLUGIN, PathTracer
from harnack.rendering.isolines import Isolines, parse_isolines
from harnack.rendering.mitsuba import load_dict, load_mitsuba
from harnack.rendering.mitsuba_proxy import (
    as_matrix,
    from_properties,
    is_proxy,
    refuse_attached_surfaces,
)
from harnack.tracer import Surface, TracedSurface, traced_surface
from harnack.tracer.traced_surface import check_has_inside

if TYPE_CHECKING:
    import numpy.typing as npt
    from typing_extensions import Unpack

    from harnack.geometry import Volume
    from harnack.tracer import TraceKeywords, TraceOptions

_MARK = "watched_by_harnack"
# Integrators that follow paths, and those among them that see media.
_PATHS, _IN_MEDIA = "PathIntegrator", ("VolumetricSimplePath", "VolumetricMisPath")
_DIRECT, _CHANNELS = "DirectIntegrator", "AOVIntegrator"


def patch_mitsuba_render(mi: Any) -> None:
    """Replace `mitsuba.render` by a function that warns of level sets of harnack that will not be
    drawn, and refuses derivatives by what they are made of; and then renders as before. If it has
    been replaced before, nothing changes."""
    original = mi.render
    if _MARK in vars(original):
        return

    @functools.wraps(original)
    def render(scene: Any, *args: Any, **settings: Any) -> Any:
        """Call the original `mitsuba.render`, after a warning of level sets of harnack that it will
        not draw."""
        # The third argument after the scene is the integrator.
        chosen = settings.get("integrator") or (args[2] if len(args) > 2 else None)
        if isinstance(scene, mi.Scene):
            warn_unsupported_integrator(scene, chosen or scene.integrator())
            refuse_attached_surfaces(scene)
        return original(scene, *args, **settings)

    vars(render)[_MARK] = True
    mi.render = render


def warn_unsupported_integrator(scene: Any, integrator: Any) -> None:
    """Warn if the integrator is one of Mitsuba's own and the scene holds level sets of harnack,
    which it cannot see."""
    if not type(integrator).__module__.startswith("mitsuba") or _sees_ours(integrator):
        return
    unseen_count = sum(is_proxy(shape) for shape in scene.shapes())
    if unseen_count:
        class_name = _kind(integrator)
        if INTEGRATOR in str(integrator):
            class_name = f"apart from {PLUGIN} inside it, {class_name}"
        warnings.warn(
            f"{unseen_count} of the scene's shapes are level sets of harnack, which Mitsuba's own "
            f"integrators cannot see: {class_name} draws nothing of them. Take the integrator "
            f'{{"type": "{PLUGIN}"}}, or draw the scene with harnack.render(scene)',
            stacklevel=3,
        )


def equivalent_path_tracer(mi: Any, scene: Any) -> PathTracer | None:
    """Return a path tracer of harnack that computes the same light as the scene's integrator.
    Returns None if Mitsuba itself can draw the scene: its integrator is none of Mitsuba's path
    tracers, and either the scene has no level sets of harnack or the integrator can see them.

    Raises:
        ValueError: the scene has level sets of harnack, and its integrator computes something that
            a path tracer without media does not, such as light in a medium or channels of its own.
    """
    integrator = scene.integrator()
    if integrator is None:
        return PathTracer(mi)
    tracer = getattr(integrator, "tracer", None)
    count = sum(is_proxy(shape) for shape in scene.shapes())
    has_medium = any(shape.is_medium_transition() for shape in scene.shapes())
    has_medium |= any(sensor.get_medium() is not None for sensor in scene.sensors())
    # The integrator is this library's own.
    if isinstance(tracer, PathTracer):
        if has_medium:
            warnings.warn(f"{PLUGIN} follows no light in media: they are left out", stacklevel=5)
        return tracer
    class_name = _kind(integrator)
    follows_paths = class_name == _PATHS or (class_name.startswith(_IN_MEDIA) and not has_medium)
    # One of Mitsuba's path tracers: its settings are taken over.
    if follows_paths:
        return _with_settings(mi, integrator)
    if not count or _sees_ours(integrator):
        return None
    # Direct light is the light of paths of at most two edges.
    if class_name == _DIRECT:
        return PathTracer(mi, 2, hide_emitters=bool(integrator.hide_emitters))
    wrong = (
        "light in its media" if class_name.startswith(_IN_MEDIA) else f"what {class_name} asks for"
    )
    raise ValueError(
        f"{count} of the scene's shapes are level sets of harnack, which Mitsuba's own integrators "
        f"cannot see, and {wrong} is not found by paths alone. Take the integrator "
        f'{{"type": "{PLUGIN}"}} (or path, direct, volpath without media); depths and normals are '
        'drawn by show="depth" and show="normal"'
    )


def _with_settings(mi: Any, integrator: Any) -> PathTracer:
    """Return a path tracer of harnack with the path lengths and other settings of one of Mitsuba's
    integrators. They can only be read from the integrator's text."""
    words = str(integrator)
    depths = {name: int(n) for name, n in re.findall(r"(max_depth|rr_depth) = (\d+)", words)}
    # A limit of 2^31 or more, or none, means no limit, which is -1 here.
    depth = depths.get("max_depth", 2**32 - 1)
    return PathTracer(
        mi, -1 if depth >= 2**31 else depth, depths["rr_depth"], bool(integrator.hide_emitters)
    )


def _sees_ours(integrator: Any) -> bool:
    """Return whether all light of an integrator comes from harnack's integrator inside it. That
    holds for an integrator of moments, but not for `aov`, which adds channels of its own."""
    words = str(integrator)
    return INTEGRATOR in words and _CHANNELS not in words


def _kind(integrator: Any) -> str:
    """Return the name of the C++ class of a Mitsuba integrator."""
    moment_class = "MomentIntegrator"  # its text says that it is a Scene
    kind = str(integrator).partition("[")[0]
    return moment_class if kind == "Scene" else kind


def register() -> Any:
    """Register the shape `harnack` and the integrator `harnack_path` with Mitsuba, and return the
    module `mitsuba`.

    It is needed once in each variant before Mitsuba's own functions load a scene that names them;
    `render` and `mitsuba_shape` call it themselves. From then on `mitsuba.render` warns of level
    sets that another integrator would leave out.
    """
    mi = load_mitsuba()

    def make_shape(props: Any) -> Any:
        """Return the shape for the properties that a scene gives: a proxy, the Mitsuba mesh that
        stands for the surface and that no ray of Mitsuba hits."""
        # With a cache the evaluator is made only once for this shape.
        surface = surface_from_properties(props).with_call_cache()
        return mitsuba_proxy.from_properties(mi, props, surface)

    mi.register_shape(mitsuba_proxy.PLUGIN, make_shape)
    mi.register_integrator(integrator.PLUGIN, integrator.integrator_class(mi.variant()))
    patch_mitsuba_render(mi)
    return mi


def surface_from_properties(props: Any) -> TracedSurface:
    """Return the surface that the properties of a `harnack` shape describe. The properties "low"
    and "high" make the shape a closed solid, on which the field lies between them; one of them may
    be missing.

    Raises:
        ValueError: the properties describe no surface, or contradict each other.
    """
    keywords: dict[str, Any] = {"clip": _clip(props)}
    ends = [props[name] for name in ("low", "high") if name in props]
    if ends:
        if "level" in props:
            raise ValueError("give either level, or low and high of a solid")
        keywords["level"] = ends
        keywords["side"] = "between" if len(ends) == 2 else "above" if "low" in props else "below"
    for name in ("level", "tolerance", "max_steps", "require_crossing"):
        if name in props:
            keywords[name] = props[name]
    # The verb is the subject of messages of errors.
    surface = traced_surface(_field(props), verb="a shape", **keywords)
    check_has_inside(surface)
    return surface


def _field(props: Any) -> Field:
    """Return the field that the properties of a `harnack` shape name: that of a file of curves, or
    one of a few formulas.

    Raises:
        ValueError: unknown names, or not exactly one of file and field.
    """
    # Imported here: they take time, and only scenes of Mitsuba's need them.
    from harnack.fields import Gyroid, SchwarzD, SchwarzP, SolidAngle, SphericalHarmonic
    from harnack.files import read_loops

    if ("file" in props) == ("field" in props):
        raise ValueError("a harnack shape needs either a file of curves or a field")
    if "file" in props:
        path = load_mitsuba().file_resolver().resolve(props["file"])
        return SolidAngle(read_loops(str(path), boundary=props.get("boundary", False)))
    name = props["field"]
    periodic = {"gyroid": Gyroid, "schwarz_p": SchwarzP, "schwarz_d": SchwarzD}
    if name in periodic:
        # The clip takes the place of the field's own domain.
        return periodic[name](props.get("cell", 2 * math.pi), domain=_clip(props))
    if name == "spherical_harmonic":
        return SphericalHarmonic(props["l"], props["m"])
    known = (*periodic, "spherical_harmonic")
    raise ValueError(
        f"unknown field {name!r}; there are {', '.join(known)}{did_you_mean(name, known)}"
    )


def _clip(props: Any) -> Volume | None:
    """Return the volume that the clip properties of a `harnack` shape describe, a ball, a box or
    their intersection; None without such properties."""
    volumes: list[Volume] = []
    if "clip_radius" in props:
        center = props.get("clip_center", [0.0, 0.0, 0.0])
        volumes.append(Ball(_point(center), props["clip_radius"]))
    if ("clip_lower" in props) != ("clip_upper" in props):
        raise ValueError("a clip box needs both clip_lower and clip_upper")
    if "clip_lower" in props:
        volumes.append(Box(_point(props["clip_lower"]), _point(props["clip_upper"])))
    if len(volumes) > 1:
        return VolumeIntersection(volumes)
    return volumes[0] if volumes else None


def _point(value: Any) -> tuple[float, float, float]:
    """Return a vector of Mitsuba's as three floats."""
    x, y, z = (float(component) for component in value)
    return x, y, z


def mitsuba_shape(
    surface: Field | Surface | TracedSurface,
    *,
    bsdf: Mapping[str, Any] | Any = None,
    to_world: npt.ArrayLike | Any = None,
    tint: Sequence[float] | None = None,
    section_bsdf: Mapping[str, Any] | Any = None,
    isolines: Isolines | Sequence[Isolines] | None = None,
    options: TraceOptions | None = None,
    **keywords: Unpack[TraceKeywords],
) -> Any:
    """Return a Mitsuba shape of a field's level set, for a scene dictionary or a scene.

        scene = mitsuba.load_dict({
            "type": "scene",
            "integrator": {"type": "harnack_path"},
            "surface": harnack.rendering.mitsuba_shape(field, bsdf={"type": "roughconductor"}),
            ...
        })

    bsdf: a dictionary or a BSDF object; by default gray diffuse, seen from both sides. An open
        surface has two sides: wrap a one-sided BSDF as {"type": "twosided", ...}.
    to_world: a matrix (4, 4) or a Mitsuba transform of translations, rotations, mirrors and one
        scale for all axes.
    tint: for a solid of glass, the fractions of red, green and blue light that are left after one
        unit of length in it, in the world: (1, 1, 1) for clear glass (Beer and Lambert).
    section_bsdf: the BSDF of the faces at which `section` cuts an opaque solid; by default that of
        the rest.
    isolines: `harnack.Isolines` to draw on the surface, or a list of them; later ones cover earlier
        ones.
    options, keywords: a `TraceOptions`, and the options level, clip, section, side, tolerance, ...
        as `render` takes them. Glass needs a `side`.

    Raises:
        ValueError: the surface has no bounds and no `clip`, or `to_world` does not scale all
            lengths alike.
    """
    mi = register()
    if isinstance(surface, Surface | Field):
        if "material" in keywords:
            raise TypeError(
                "a shape takes bsdf=..., not material=...: that is an option of harnack.render"
            )
        # The verb is the subject of messages of errors.
        surface = traced_surface(surface, options, verb="a shape", **keywords)
    check_has_inside(surface)
    # With a cache the evaluator is made only once for this shape.
    surface = surface.with_call_cache()
    props = mi.Properties()
    props["bsdf"] = as_bsdf(mi, bsdf)
    if to_world is not None:
        props["to_world"] = mi.ScalarTransform4f(as_matrix(to_world))
    # Faces on the section may have another material.
    of_cut = _section_bsdf(mi, surface, props["bsdf"], section_bsdf)
    return from_properties(mi, props, surface, tint, of_cut, parse_isolines(isolines))


def _section_bsdf(mi: Any, surface: TracedSurface, bsdf: Any, section_bsdf: Any) -> Any:
    """Return the BSDF of the faces at which a section cuts a solid; None if they have the BSDF of
    the rest.

    bsdf: the BSDF of the rest.
    section_bsdf: what the caller set: a BSDF, its dictionary, or None.

    Raises:
        ValueError: there are no such faces, or light passes through the solid.
    """
    if section_bsdf is None:
        return None
    if surface.solid_range is None or surface.section is None:
        raise ValueError(
            "section_bsdf is of the faces of a solid on its section: give a section, such as a "
            'half-space, and side="below" or side="above" as well'
        )
    loaded = as_bsdf(mi, section_bsdf)
    for material in (bsdf, loaded):
        if mi.has_flag(material.flags(), mi.BSDFFlags.Transmission):
            raise ValueError(
                "the faces of a cut have a material of their own on opaque solids only"
            )
    return loaded


def as_bsdf(mi: Any, bsdf: Any) -> Any:
    """Return a BSDF object of Mitsuba's. bsdf: such an object, its dictionary, or None for gray
    diffuse on both sides."""
    if bsdf is None:
        bsdf = {"type": "twosided", "nested": {"type": "diffuse"}}
    loaded: Any = bsdf
    if isinstance(bsdf, Mapping):
        loaded = load_dict(mi, cast("Mapping[str, Any]", bsdf))
    if not isinstance(loaded, mi.BSDF):
        raise TypeError(
            "bsdf must be a BSDF or its dictionary, such as harnack.rendering.MATERIALS['gold']"
            f".front, not {type(loaded).__name__}"
        )
    return loaded
