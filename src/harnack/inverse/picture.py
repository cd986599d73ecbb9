"""`picture`, which draws a surface as a tensor with derivatives by all that the surface is made
of."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import backend_of, choose_backend, to_numpy
from harnack.backend.validation import as_integer_in_range, check_no_derivatives, has_derivatives
from harnack.inverse.channels import Show, channel_function
from harnack.inverse.distant_lights import DistantLights
from harnack.inverse.drawing import Drawing, with_fine_tolerance
from harnack.inverse.film import Film, Grid
from harnack.rendering.camera import Camera
from harnack.tracer.trace_options import TRACE_OPTIONS, shows_keywords, surface_and_options
from harnack.tracer.traced_surface import TracedSurface

if TYPE_CHECKING:
    from collections.abc import Callable

    from typing_extensions import Unpack

    from harnack.backend import Backend, FloatArray
    from harnack.fields.field import Field
    from harnack.tracer import Hits, Surface
    from harnack.tracer.trace_options import TraceKeywords, TraceOptions

_HONORED = ("level", "clip", "section", *(name for name in TRACE_OPTIONS if name != "backend"))
# Pictures of more pixels a side, and of more samples, are refused: they need too much memory.
_MAX_SIDE, _MAX_SAMPLES = 8192, 16
# Light paths to the sky for each ray of the camera.
_SPP, _MAX_SPP = 8, 256


@shows_keywords(*_HONORED)
def picture(
    surface: Field | Surface,
    *,
    camera: Camera | None = None,
    size: int | tuple[int, int] = 128,
    show: Show | Callable[[Hits], Any] = "shaded",
    samples: int = 1,
    spp: int | None = None,
    seed: int | None = 0,
    background: Any = 0.0,
    light: Any = None,
    options: TraceOptions | None = None,
    **keywords: Unpack[TraceKeywords],
) -> Any:
    """Draw a surface as a tensor (h, w, c) with derivatives, silhouettes included.

    surface: a field, or a `Surface` without a `side`.
    camera: from where it is seen, in the coordinates of the surface. For derivatives its frame must
        not follow the surface: it needs a box, or a position (or a distance), a target and a fov.
    size: (width, height) in pixels, or one number for both.
    show: "shaded", brightness under one light (c = 1); "path", the same with shadows, as described
        below (c = 1); "normals", unit normals on the side of the camera (c = 3); "depth", distances
        from the camera (c = 1); "mask", 1 where the surface is (c = 1). Or a function from `Hits`,
        as Dr.Jit arrays, to a Dr.Jit array or vector, or a list of arrays: the channels. Its hits
        have normals on the side of the camera.
    samples: each pixel is the mean of samples x samples rays, one in each of its parts.
    spp: of a path-traced picture, the number of light paths from each hit to the sky; by default 8.
        With 0 there is only a sun.
    seed: of the places of the rays in these parts, and of the sky's light. Take another one for
        each step of an optimization; with None, rays go through the middle, and derivatives of
        silhouettes have a small bias.
    background: the number, or one for each channel, where nothing is hit.
    light: (x, y, z), the direction to the light of a shaded picture, or to the sun of a path-traced
        one; by default from above the left shoulder of the camera.
    options, keywords: as of `trace`.

    A path-traced picture shows direct light, that of paths of two edges, on a surface that is matt
    on both sides: 0.8 in full sun, plus 0.2 under the whole of a uniform sky all around, where
    nothing of the surface is in between. The sky is sampled in `spp` directions, which are the same
    for all pixels and turned by the seed: so shadows have edges within one picture, and the mean
    over seeds is the light of the whole sky. Neither the picture nor its derivative has light that
    goes from the surface to itself, mirrors or glass.

    Returns a Dr.Jit tensor, of the precision of the parameters, if parameters of the field or the
    level are Dr.Jit arrays, as within functions for PyTorch and JAX (`harnack.io.wrap_for_torch`);
    in double precision, if only numbers that a function `show` uses have derivatives; else a NumPy
    array. Derivatives by these parameters have all of: changes of hits and normals, and motions of
    outlines, of edges of solids, of the curves at which level sets end, of the curves at which
    `clip` or the domain cuts the surface, and of the edges of shadows, each found by bisection with
    proved first hits, and outlines from there by Newton's method. Their mean over `seed` is the
    derivative of the mean picture. Not found are: parts of the surface, and gaps between them, that
    are thinner than the distance of the rays; and jumps of the color by less than 0.4 percent of
    its range.

    Raises:
        TypeError, ValueError: arguments or channels of the wrong kind or size; a surface without
            bounds seen by a camera that needs them; derivatives with a camera whose frame follows
            the surface.
        NotImplementedError: derivatives of fields with facets or patches; by parameters that have
            none (`trace`), or that move a domain which cuts the surface in the picture; where more
            than two jumps, and more than 2 percent of the length of boundaries, are of an unknown
            kind, such as where the color itself jumps on the surface.

    Warns if rays ran out of steps; these show the background.
    """
    other = None if callable(show) else show
    check_no_derivatives("picture", camera, size, samples, spp, seed, background, light, other)
    camera = Camera() if camera is None else camera
    if not isinstance(cast("object", camera), Camera):
        raise TypeError(f"camera is a harnack.Camera, not {type(camera).__name__}")
    if seed is not None:
        seed = as_integer_in_range(seed, "seed", 0, 2**63 - 1)
    samples = as_integer_in_range(samples, "samples", 1, _MAX_SAMPLES)
    if spp is not None:
        spp = as_integer_in_range(spp, "spp", 0, _MAX_SPP)
        if show != "path":
            raise ValueError('spp counts the light paths of show="path"; give samples instead')
    target, choices = surface_and_options("picture", surface, options, keywords, _HONORED)
    traced = TracedSurface.of(target, choices).with_call_cache()
    backend = _backend_of_numbers(traced)
    if backend is None and callable(show) and has_derivatives(show):
        backend = choose_backend(choices.precision or "double")
    elif backend is not None and choices.precision not in (None, backend.precision):
        raise ValueError(
            f"the parameters are in {backend.precision} precision, and so is the picture; give "
            "precision only with numbers of Python or NumPy"
        )
    film = Film.of(camera, _checked_size(size), traced.volume)

    def lights(sun: FloatArray) -> DistantLights:
        """The lights of a path-traced picture. sun: (3,) the direction to the sun."""
        turn = None if seed is None else np.random.default_rng((seed, 1))
        count = _SPP if spp is None else spp
        return DistantLights.sun_and_sky(sun, count, turn, with_fine_tolerance(traced))

    channels = channel_function(show, background, light, film, lights)
    random = None if seed is None else np.random.default_rng(seed)
    grid = Grid.of(film.size, samples, random)
    plain = choose_backend(choices.precision or "single")
    image = Drawing(traced, film, channels, grid, backend or plain, random, camera).image()
    if backend is None:
        return to_numpy(image.array).reshape(image.shape)
    return image


def _checked_size(size: Any) -> tuple[int, int]:
    """The width and height of a picture."""
    sides: tuple[Any, ...] = (
        tuple(cast("Any", size)) if isinstance(size, tuple | list) else (size, size)
    )
    if len(sides) != 2:
        raise ValueError(f"size is (width, height), not {size!r}")
    width, height = (as_integer_in_range(side, "size", 2, _MAX_SIDE) for side in sides)
    return width, height


def _backend_of_numbers(traced: TracedSurface) -> Backend | None:
    """The backend of the first of the field's parameters and the levels that is a Dr.Jit array;
    None if none is."""
    for value in (*traced.field.parameters().values(), *traced.levels):
        if dr.is_array_v(type(value)):
            return backend_of(value.array if dr.is_tensor_v(type(value)) else value)
    return None
