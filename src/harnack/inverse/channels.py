"""What a picture shows of first hits: functions from hits to a few numbers, the channels, for each
ray."""

from __future__ import annotations

import numbers
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, cast

import drjit as dr
import numpy as np

from harnack.backend.validation import as_real, has_derivatives
from harnack.geometry.volume import as_point
from harnack.name_suggestions import did_you_mean, with_article

if TYPE_CHECKING:
    from harnack.backend import FloatArray, Real, Vec3
    from harnack.inverse.distant_lights import DistantLights
    from harnack.inverse.film import Film
    from harnack.tracer import Hits

Show = Literal["shaded", "path", "normals", "depth", "mask"]
Channels = Callable[["Hits"], Sequence["Real"]]
# The part of the light of a shaded picture that comes from all sides.
_AMBIENT = 0.2


@dataclass(frozen=True)
class ChannelFunction:
    """The channels of a picture.

    function: from hits to the channels.
    background: the numbers of the channels where nothing is hit; a single one for all.
    is_constant: whether the channels of hits are constants.
    lights: whose shadows the picture shows. Behind the channel that is shown, `function` returns
        others, by which the edges of shadows are found. None for no lights.
    has_derivatives: whether the function uses numbers that have derivatives.
    """

    function: Channels
    background: tuple[float, ...]
    is_constant: bool = False
    lights: DistantLights | None = None
    has_derivatives: bool = False

    @property
    def hidden_count(self) -> int:
        """The number of last channels that are not shown."""
        return 0 if self.lights is None else self.lights.hidden_count

    def shown(self, color: FloatArray) -> FloatArray:
        """The channels that are shown, of an array whose last axis counts all channels."""
        return color[..., : color.shape[-1] - self.hidden_count]

    def of(self, hits: Hits, direction: Vec3) -> list[Real]:
        """The channels of rays, as Dr.Jit arrays. Where nothing is hit they are the background, and
        have no derivative. direction: (3,) the directions of the rays."""
        is_hit = hits.is_hit
        # Rays without a hit have infinite t, and their derivatives would be NaN.
        normal = dr.select(is_hit, hits.normal, -direction)
        hits = replace(
            hits,
            t=dr.select(is_hit, hits.t, 1),
            position=dr.select(is_hit, hits.position, direction),
            normal=normal * dr.select(dr.dot(dr.detach(normal), direction) > 0, -1, 1),
        )
        values = _as_channels(self.function(hits), cast("Any", type(hits.t)))
        count = len(values) - self.hidden_count
        background = self.background * (count if len(self.background) == 1 else 1)
        if len(background) != count:
            raise ValueError(
                f"background has {len(background)} numbers, and the picture {count} channels"
            )
        background += (0.0,) * self.hidden_count
        return [dr.select(is_hit, v, b) for v, b in zip(values, background, strict=True)]


def _as_channels(shown: Any, kind: Any) -> list[Real]:
    """What a function of hits returned, as a list of Dr.Jit arrays of a type.

    Raises:
        TypeError: it is no Dr.Jit array or vector, number, or list of arrays and numbers. NumPy
            arrays would have lost their derivatives.
        ValueError: an empty list.
    """
    is_vector = (
        dr.is_array_v(type(shown))
        and not dr.is_tensor_v(type(shown))
        and dr.depth_v(type(shown)) > 1
    )
    is_list = is_vector or isinstance(shown, list | tuple)
    entries: list[Any] = [*shown] if is_list else [shown]
    # A number of PyTorch times an array is a tensor.
    entries = [
        entry.array if dr.is_tensor_v(cast("Any", type(entry))) else entry for entry in entries
    ]
    for entry in entries:
        is_array = dr.is_array_v(cast("Any", type(entry))) and dr.depth_v(type(entry)) == 1
        if not is_array and not isinstance(entry, numbers.Real | np.bool_):
            raise TypeError(
                "show returns a Dr.Jit array or vector, or a list of arrays and numbers, not "
                f"{with_article(type(entry).__name__)}"
            )
    if not entries:
        raise ValueError("show returns no channels: an empty list")
    return [kind(entry) for entry in entries]


def channel_function(
    show: Any,
    background: Any,
    light: Any,
    film: Film,
    lights: Callable[[FloatArray], DistantLights],
) -> ChannelFunction:
    """The channels of a picture from the arguments of `picture`. lights: from the direction (3,) to
    the sun to the lights of a path-traced picture.

    Raises:
        TypeError, ValueError: a name that is none of `Show`, or arguments that are no numbers.
    """
    numbers = np.ravel(background).tolist()
    colors = tuple(as_real(number, "background") for number in numbers)
    if callable(show):
        has_own = has_derivatives(show)
        return ChannelFunction(cast("Any", show), colors, has_derivatives=has_own)
    if not isinstance(show, str):
        kind = with_article(type(show).__name__)
        raise TypeError(f"show is a name or a function of hits, not {kind}")
    if show == "shaded":
        return ChannelFunction(lit_by(_light_direction(light, film)), colors)
    if show == "path":
        lamps = lights(_light_direction(light, film))
        return ChannelFunction(lamps.channels, colors, lights=lamps)
    functions: dict[str, Channels] = {
        "normals": lambda hits: [*hits.normal],
        "depth": lambda hits: [hits.t],
        "mask": lambda hits: [0 * dr.detach(hits.t) + 1],
    }
    if show not in functions:
        names = ("shaded", "path", *functions)
        raise ValueError(
            f"show is one of {', '.join(names)}, not {show!r}{did_you_mean(show, names)}"
        )
    return ChannelFunction(functions[show], colors, is_constant=show == "mask")


def lit_by(light: FloatArray) -> Channels:
    """The brightness of a matt white surface in light from a direction (3,), with a fifth of it
    from all sides."""

    def brightness(hits: Hits) -> list[Real]:
        """0.2 + 0.8 max(n . l, 0), with the unit normal n and the direction l."""
        cosine = hits.normal.x * light[0] + hits.normal.y * light[1] + hits.normal.z * light[2]
        return [_AMBIENT + (1 - _AMBIENT) * dr.maximum(cosine, 0)]

    return brightness


def _light_direction(light: Any, film: Film) -> FloatArray:
    """The unit direction (3,) to the light; by default from above the left shoulder of the camera.
    light: three numbers, or None."""
    if light is None:
        right, up = (axis / np.linalg.norm(axis) for axis in (film.right, film.up))
        vector = 0.6 * up - 0.4 * right - film.forward
    else:
        vector = np.array(as_point(light, "light"))
    length = np.linalg.norm(vector)
    if not length > 0:
        raise ValueError("light must be a direction, not (0, 0, 0)")
    return vector / length
