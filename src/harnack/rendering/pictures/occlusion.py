"""How much of the sky is hidden by what is near, from what the picture itself shows."""

from __future__ import annotations

from typing import Any

import drjit as dr

# Ways across the picture, and taps along each, up to this share of its larger side.
_WAYS = 16
_TAPS = 8
_REACH = 0.16


def visible_sky(mi: Any, position: Any, normal: Any, width: Any, size: tuple[int, int]) -> Any:
    """The part of the hemisphere over each pixel's point that nothing near it hides, in [0, 1].

    position: points seen by the pixels, counted by rows; NaN where nothing is seen.
    normal: unit, towards the eye. width: of a pixel, there. size: (width, height) in pixels.

    Along each way across the picture the highest point over the tangent plane, at elevation h,
    hides sin^2 h of the light with a cosine (Bavoil and Sainz 2008), less so the farther away
    it is. It sees only what the picture shows. The ways are the same everywhere: no noise.
    """
    columns, rows = size
    count = columns * rows
    index = dr.arange(mi.UInt32, count)
    x, y = mi.Float(index % columns), mi.Float(index // columns)
    reach = _REACH * max(size)
    radius = reach * width

    def tap(k: int, direction: Any) -> Any:
        """The sine of the elevation of a tap, faded with its distance; 0 if nothing is there."""
        far = 1.0 + reach * ((k + 0.5) / _TAPS) ** 2
        u, v = x + far * direction.x, y + far * direction.y
        inside = (u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1)
        other = mi.UInt32(dr.fma(dr.round(v), columns, dr.round(u)))
        way = dr.gather(mi.Vector3f, position, other, inside) - position
        length = dr.norm(way)
        fade = dr.maximum(1 - dr.square(length / radius), 0)
        height = dr.dot(way, normal) / length - 0.06  # facets and rounding stay below that
        return dr.select(inside & (height > 0), height * fade, 0)

    def along(way: Any, hidden: Any) -> tuple[Any, Any]:
        s, c = dr.sincos((mi.Float(way) + 0.5) * (dr.two_pi / _WAYS))
        highest = mi.Float(0)
        for k in range(_TAPS):
            highest = dr.maximum(highest, tap(k, mi.Vector2f(c, s)))
        return way + 1, hidden + dr.square(highest)

    def more(way: Any, hidden: Any) -> Any:
        del hidden
        return way < _WAYS

    start = (mi.UInt32(0), dr.zeros(mi.Float, count))
    _, hidden = dr.while_loop(start, more, along, label="visible sky")
    return 1 - hidden / _WAYS
