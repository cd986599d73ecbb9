"""Mitsuba's own integrators: what stands in for them where a scene holds our surfaces.

They ask Mitsuba's shapes alone, for which a carrier is two points: they would draw nothing, and
say nothing. No method of a shape is called while they render, so `mitsuba.render` looks first and
warns. `harnack.render` follows paths itself where the integrator asks for the same light, leaves
scenes without our surfaces to Mitsuba, and refuses the rest.
"""

from __future__ import annotations

import functools
import re
import warnings
from typing import Any

from harnack.rendering.mitsuba.carrier import is_carrier
from harnack.rendering.mitsuba.integrator import INTEGRATOR, PLUGIN, PathTracer

_MARK = "watched_by_harnack"
# Integrators that follow paths, and those among them that see media.
_PATHS, _IN_MEDIA = "PathIntegrator", ("VolumetricSimplePath", "VolumetricMisPath")
_DIRECT, _CHANNELS = "DirectIntegrator", "AOVIntegrator"


def watch(mi: Any) -> None:
    """Have `mitsuba.render` warn of surfaces that it will not draw; it renders as before."""
    original = mi.render
    if _MARK in vars(original):
        return

    @functools.wraps(original)
    def render(scene: Any, *args: Any, **settings: Any) -> Any:
        chosen = settings.get("integrator") or (args[2] if len(args) > 2 else None)
        if isinstance(scene, mi.Scene):
            warn_of_unseen(scene, chosen or scene.integrator())
        return original(scene, *args, **settings)

    vars(render)[_MARK] = True
    mi.render = render


def warn_of_unseen(scene: Any, integrator: Any) -> None:
    """Warn if the integrator is Mitsuba's own, and the scene holds surfaces of ours."""
    if not type(integrator).__module__.startswith("mitsuba") or _sees_ours(integrator):
        return
    unseen = sum(is_carrier(shape) for shape in scene.shapes())
    if unseen:
        kind = _kind(integrator)
        if INTEGRATOR in str(integrator):
            kind = f"apart from {PLUGIN} inside it, {kind}"
        warnings.warn(
            f"{unseen} of the scene's shapes are level sets of harnack, which Mitsuba's own "
            f"integrators cannot see: {kind} draws nothing of them. Take the integrator "
            f'{{"type": "{PLUGIN}"}}, or draw the scene with harnack.render(scene)',
            stacklevel=3,
        )


def stand_in(mi: Any, scene: Any) -> PathTracer | None:
    """The path tracer that finds the light that the scene's integrator asks for; None for scenes
    without surfaces of ours that Mitsuba has to draw itself.

    Raises:
        ValueError: the scene holds surfaces of ours, and its integrator asks for what no path
            tracer without media finds, such as light in a medium or channels of its own.
    """
    integrator = scene.integrator()
    if integrator is None:
        return PathTracer(mi)
    own = getattr(integrator, "tracer", None)
    ours = sum(is_carrier(shape) for shape in scene.shapes())
    has_medium = any(shape.is_medium_transition() for shape in scene.shapes())
    has_medium |= any(sensor.get_medium() is not None for sensor in scene.sensors())
    if isinstance(own, PathTracer):
        if has_medium:
            warnings.warn(f"{PLUGIN} follows no light in media: they are left out", stacklevel=5)
        return own
    kind = _kind(integrator)
    follows_paths = kind == _PATHS or (kind.startswith(_IN_MEDIA) and not has_medium)
    if follows_paths:
        return _with_settings(mi, integrator)
    if not ours or _sees_ours(integrator):
        return None
    if kind == _DIRECT:
        return PathTracer(mi, 2, hide_emitters=bool(integrator.hide_emitters))
    wrong = "light in its media" if kind.startswith(_IN_MEDIA) else f"what {kind} asks for"
    raise ValueError(
        f"{ours} of the scene's shapes are level sets of harnack, which Mitsuba's own integrators "
        f"cannot see, and {wrong} is not found by paths alone. Take the integrator "
        f'{{"type": "{PLUGIN}"}} (or path, direct, volpath without media); depths and normals are '
        'drawn by show="depth" and show="normal"'
    )


def _with_settings(mi: Any, integrator: Any) -> PathTracer:
    """A path tracer with the settings of one of Mitsuba's, which tells them in words alone."""
    words = str(integrator)
    found = {name: int(n) for name, n in re.findall(r"(max_depth|rr_depth) = (\d+)", words)}
    depth = found.get("max_depth", 2**32 - 1)
    return PathTracer(
        mi, -1 if depth >= 2**31 else depth, found["rr_depth"], bool(integrator.hide_emitters)
    )


def _sees_ours(integrator: Any) -> bool:
    """Whether all that it finds comes from our integrator inside it: moments of its light do, and
    channels of `aov` do not."""
    words = str(integrator)
    return INTEGRATOR in words and _CHANNELS not in words


def _kind(integrator: Any) -> str:
    """The name of its class in Mitsuba."""
    moments = "MomentIntegrator"  # says that it is a Scene
    kind = str(integrator).partition("[")[0]
    return moments if kind == "Scene" else kind
