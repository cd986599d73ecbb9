"""A warning where Mitsuba's own integrators are asked to draw our surfaces.

They ask Mitsuba's shapes alone, for which a carrier is two points: they would draw nothing, and
say nothing. No method of a shape is called while they render, so `mitsuba.render` looks first.
"""

from __future__ import annotations

import functools
import warnings
from typing import Any

from harnack.rendering.mitsuba.carrier import is_carrier
from harnack.rendering.mitsuba.integrator import INTEGRATOR, PLUGIN

_MARK = "watched_by_harnack"


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
    if not type(integrator).__module__.startswith("mitsuba") or INTEGRATOR in str(integrator):
        return
    unseen = sum(is_carrier(shape) for shape in scene.shapes())
    if unseen:
        kind, _, _ = str(integrator).partition("[")
        warnings.warn(
            f"{unseen} of the scene's shapes are level sets of harnack, which Mitsuba's own "
            f"integrators cannot see: {kind} draws nothing of them. Take the integrator "
            f'{{"type": "{PLUGIN}"}}, or draw the scene with harnack.render(scene)',
            stacklevel=3,
        )
