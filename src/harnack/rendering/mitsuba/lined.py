"""Surfaces that have lines drawn on them: matter of other colours, chosen by the line's number."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.rendering.mitsuba.scene_files import load_dictionary
from harnack.rendering.mitsuba.variant import load_mitsuba
from harnack.rendering.surfaces.colours import Colour, linear

if TYPE_CHECKING:
    from harnack.backend import Mask


def with_lines(mi: Any, bsdf: Any, colours: Sequence[Colour]) -> Any:
    """A BSDF that is another one off lines, and matt on both sides on them.

    colours: of the lines, in sRGB.
    """
    paints = [load_dictionary(mi, _matt(colour)) for colour in colours]
    return _lined_class(mi.variant())(bsdf, paints)


def _matt(colour: Colour) -> dict[str, Any]:
    reflectance = {"type": "rgb", "value": list(linear(colour))}
    return {"type": "twosided", "nested": {"type": "diffuse", "reflectance": reflectance}}


@functools.cache
def _lined_class(variant: str) -> Any:
    """The class of such BSDFs; Mitsuba's classes differ from variant to variant."""
    mi = load_mitsuba()
    assert mi.variant() == variant

    class Lined(mi.BSDF):
        """`interaction` puts the number of the line into the index of the primitive."""

        def __init__(self, base: Any, paints: Sequence[Any]) -> None:
            mi.BSDF.__init__(self, mi.Properties())
            self.base, self.paints = base, tuple(paints)
            parts = (base, *self.paints)
            self.m_components = [
                part.flags(k) for part in parts for k in range(part.component_count())
            ]
            flags = 0
            for part in parts:
                flags |= part.flags()
            self.m_flags = flags

        def _chosen(self, ask: Callable[[Any, Mask], Any], si: Any, active: Mask) -> Any:
            """What `ask` is told by the part that is seen, of which it gets the mask."""
            line = si.prim_index
            found = ask(self.base, active & (line == 0))
            for number, paint in enumerate(self.paints, start=1):
                here = line == number
                found = dr.select(here, ask(paint, active & here), found)
            return found

        def sample(
            self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Mask = True
        ) -> tuple[Any, Any]:
            def ask(part: Any, here: Mask) -> tuple[Any, Any]:
                return part.sample(ctx, si, sample1, sample2, here)

            return self._chosen(ask, si, active)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Mask = True) -> Any:
            return self._chosen(lambda part, here: part.eval(ctx, si, wo, here), si, active)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Mask = True) -> Any:
            return self._chosen(lambda part, here: part.pdf(ctx, si, wo, here), si, active)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Mask = True) -> tuple[Any, Any]:
            return self._chosen(lambda part, here: part.eval_pdf(ctx, si, wo, here), si, active)

        def eval_diffuse_reflectance(self, si: Any, active: Mask = True) -> Any:
            return self._chosen(
                lambda part, here: part.eval_diffuse_reflectance(si, here), si, active
            )

        def eval_null_transmission(self, si: Any, active: Mask = True) -> Any:
            return self._chosen(
                lambda part, here: part.eval_null_transmission(si, here), si, active
            )

        def traverse(self, callback: Any) -> None:
            self.base.traverse(callback)

        def parameters_changed(self, keys: Any) -> None:
            self.base.parameters_changed(keys)

        def to_string(self) -> str:
            return f"Lined[{self.base}, lines = {len(self.paints)}]"

    return Lined
