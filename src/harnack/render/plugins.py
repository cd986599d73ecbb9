"""Our plug-ins, made known to Mitsuba."""

from __future__ import annotations

from typing import Any

from harnack.render import integrator
from harnack.render.variant import load_mitsuba


def register() -> Any:
    """Make the integrator `harnack_path` known to Mitsuba, and return the `mitsuba` module.

    Needed once in each variant, before a scene that names it is loaded with Mitsuba's own
    functions.
    """
    mi = load_mitsuba()
    path_class = integrator.integrator_class(mi.variant())
    mi.register_integrator(integrator.PLUGIN, lambda props: path_class(props))
    return mi
