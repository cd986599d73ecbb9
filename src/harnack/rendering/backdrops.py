"""The surroundings of a picture in the studio, the stage on which surfaces are drawn: the ground
and the lights, or a color or an image behind the surfaces. What is seen behind the surfaces is
called the backdrop.

Ground and lights are placed relative to the camera. A color or an image takes the place of the
studio's wall behind the surfaces.

The camera does not see the environment that lights the studio but a backdrop, which is added to the
picture afterwards. So pictures can have alpha, and there is no horizon.
"""

from __future__ import annotations

import math
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray
from harnack.files.file_geometry import FileLocation, read_bytes
from harnack.name_suggestions import did_you_mean
from harnack.rendering.mitsuba import load_mitsuba
from harnack.rendering.scales import NAMED_COLORS, Color, parse_color

# Radiances of the environment, linear sRGB: at the horizon, overhead, and of a soft strip of
# light behind the stage that draws edges and gives metal something to reflect.
_HORIZON = np.array([0.17, 0.17, 0.18])
_ZENITH = np.array([0.36, 0.40, 0.46])
_STRIP = np.array([0.70, 0.66, 0.60])
_KEY = (4.7, 4.5, 4.25)
# The height of the floor, just below what stands on it.
FLOOR_HEIGHT = -0.002
# The radius of the floor.
FLOOR_RADIUS = 100.0
# Reflectance of the ground, by the backdrop's name. With other backdrops there is no ground, and
# the surfaces alone are laid over them.
GROUNDS = {"light": (0.74, 0.73, 0.715), "dark": (0.055, 0.058, 0.065)}
# (height, width) of the environment's bitmap.
_ENVIRONMENT_SIZE = (64, 128)


def reflectance_of(backdrop: str) -> FloatArray:
    """Return the reflectance (3,) of the ground, in linear sRGB. backdrop: "light" or "dark"."""
    return np.array(GROUNDS[backdrop])


def distant_ground_radiance(backdrop: str, azimuth: float) -> FloatArray:
    """Compute the radiance (3,) of the ground far from the stage, which only the environment
    lights.

    backdrop: "light" or "dark".
    azimuth: of the camera, in degrees.

    The radiance of a diffuse ground is its reflectance times the mean of the environment over the
    upper hemisphere, weighted by the cosine to the vertical.
    """
    image = environment(azimuth)
    # The z of the directions of each row, from 1 (straight up) to -1.
    z = np.cos(math.pi * (np.arange(len(image)) + 0.5) / len(image))
    # The weight of a row: the cosine to the vertical, times the row's solid angle.
    weight = np.clip(z, 0, None) * np.sqrt(1 - z * z)
    mean = np.average(image.mean(axis=1), axis=0, weights=weight)
    return reflectance_of(backdrop) * mean


def ground(mi: Any, backdrop: str) -> dict[str, Any]:
    """Return a wide floor as an entry of a Mitsuba scene dictionary. backdrop: "light" or
    "dark"."""
    floor = mi.ScalarTransform4f().translate([0, 0, FLOOR_HEIGHT]).scale(FLOOR_RADIUS)
    color = {"type": "rgb", "value": list(GROUNDS[backdrop])}
    return {
        "ground": {
            "type": "disk",
            "to_world": floor,
            "bsdf": {"type": "diffuse", "reflectance": color},
        }
    }


def lights(mi: Any, azimuth: float) -> dict[str, Any]:
    """Return the lights of the studio as entries of a Mitsuba scene dictionary: a large key light
    to the left of the camera and above it, and an environment as fill light.

    azimuth: of the camera, in degrees.

    The environment is not sampled as a light: it is so smooth that light paths that reach it by
    sampling BSDFs are less noisy than paths that sample it.
    """
    # A disk of radius 2.2 at a distance of 4.9 from the stage, 52 degrees to the left of the camera
    # and 55 degrees above the horizon.
    key_position = 4.9 * _direction(azimuth - 52, 55)
    key_to_world = mi.ScalarTransform4f().look_at(
        origin=key_position.tolist(), target=[0, 0, 0.3], up=[0, 0, 1]
    )
    # In Mitsuba's environment, y is up.
    y_to_z = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {
        "key": {
            "type": "disk",
            # The radius of the disk.
            "to_world": key_to_world.scale(2.2),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(_KEY)}},
        },
        "fill": {
            "type": "envmap",
            "bitmap": mi.Bitmap(environment(azimuth)),
            "to_world": y_to_z,
            "sampling_weight": 0.0,
        },
    }


def environment(azimuth: float) -> Any:
    """Compute the radiance of the environment as an equirectangular image (h, w, 3) of float32 with
    z up: gray at the horizon, brighter and bluer overhead, with a soft strip of light behind the
    stage.

    azimuth: of the camera, in degrees.
    """
    height, width = _ENVIRONMENT_SIZE
    theta = math.pi * (np.arange(height) + 0.5) / height
    phi = 2 * math.pi * (np.arange(width) + 0.5) / width
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    # Mitsuba's direction at these angles, after its y axis has been turned up to z.
    x, y, z = np.sin(phi) * np.sin(theta), np.cos(phi) * np.sin(theta), np.cos(theta)
    direction = np.stack([x, y, z], axis=-1)
    # With a power below 1, the color changes fastest just above the horizon.
    height_fraction = np.clip(z, 0, 1)[..., None] ** 0.7
    image = _HORIZON + (_ZENITH - _HORIZON) * height_fraction
    # The middle of the strip is 125 degrees from the camera's azimuth, 28 above the horizon; its
    # light falls off with the angle to this direction, to 1/e at 31 degrees.
    strip_direction = _direction(azimuth + 125, 28)
    image += _STRIP * np.exp((direction @ strip_direction - 1) / 0.14)[..., None]
    return image.astype(np.float32)


def _direction(azimuth: float, elevation: float) -> FloatArray:
    """Return the unit vector (3,) with an azimuth, counted from the x axis, and an elevation, both
    in degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])


# Colors and images behind the surfaces.

FloatImage = npt.NDArray[np.float32]

TRANSPARENT = "transparent"
BACKDROPS = (*GROUNDS, "white", TRANSPARENT)
"""Names of backdrops; names of colors are backdrops too."""
IMAGE_FILES = (".png", ".jpg", ".jpeg", ".exr")


@dataclass(frozen=True)
class GroundBackdrop:
    """A backdrop: the studio's floor, which turns into a wall far away. name: "light" or "dark"."""

    name: str


@dataclass(frozen=True)
class GradientBackdrop:
    """A backdrop: a color at the bottom of a picture that changes gradually to another one at its
    top, both in sRGB. They may be the same."""

    bottom: Color
    top: Color


@dataclass(frozen=True, eq=False)
class ImageBackdrop:
    """A backdrop: an image behind the surfaces, scaled to fill the picture. pixels: (h, w, 3)
    linear sRGB, first row at the top."""

    pixels: FloatImage


Backdrop = GroundBackdrop | GradientBackdrop | ImageBackdrop | None
"""None for a transparent picture."""


def parse_backdrop(backdrop: Any) -> Backdrop:
    """Return the backdrop that the value of an option describes.

    backdrop: a name of `BACKDROPS`, a color, two colors (bottom, top), an image (h, w, 3), or the
        file of an image.

    Raises:
        TypeError, ValueError: it is no backdrop; the message lists the backdrops.
        FileFormatError: an image file that cannot be read.
    """
    if isinstance(backdrop, os.PathLike):
        return ImageBackdrop(_read(Path(cast("os.PathLike[str]", backdrop))))
    # An array of one dimension is a color.
    if isinstance(backdrop, np.ndarray) and backdrop.ndim != 1:
        return ImageBackdrop(_pixels(cast("npt.NDArray[Any]", backdrop)))
    if isinstance(backdrop, str):
        return _backdrop_from_text(backdrop)
    if isinstance(backdrop, list | tuple) and len(pair := cast("list[Any]", backdrop)) == 2:
        return GradientBackdrop(*(parse_color(end, "a color of the backdrop") for end in pair))
    try:
        color = parse_color(backdrop, "backdrop")
    except TypeError:
        raise TypeError(f"backdrop must be one of {_BACKDROP_HELP}, not {backdrop!r}") from None
    return GradientBackdrop(color, color)


_BACKDROP_HELP = (
    f"{', '.join(BACKDROPS)}, a color, (bottom, top) with two colors, an image (h, w, 3) or its "
    f"file ({', '.join(IMAGE_FILES)})"
)


def _backdrop_from_text(name: str) -> Backdrop:
    """Return the backdrop that a text describes: its name, the name of an image file, or a color.

    Raises:
        ValueError: the text is none of these.
    """
    if name in GROUNDS:
        return GroundBackdrop(name)
    if name == TRANSPARENT:
        return None
    if Path(name).suffix.lower() in IMAGE_FILES:
        return ImageBackdrop(_read(Path(name)))
    try:
        color = parse_color(name, "backdrop")
    except ValueError:
        known = (*BACKDROPS, *NAMED_COLORS)
        raise ValueError(
            f"backdrop must be one of {_BACKDROP_HELP}, not {name!r}{did_you_mean(name, known)}"
        ) from None
    return GradientBackdrop(color, color)


def _pixels(image: npt.NDArray[Any]) -> FloatImage:
    """Return an array (h, w, 3) as an image in linear sRGB. Bytes are sRGB and are converted;
    floats are linear light.

    Raises:
        ValueError: another shape, or numbers that are negative or not finite.
        TypeError: not numbers, or integers above 1 that are no bytes.
    """
    wrong = f"a backdrop's image must have the shape (h, w, 3), not {image.shape}"
    if image.ndim != 3 or image.shape[-1] != 3 or not image.size:
        raise ValueError(wrong)
    if image.dtype == np.uint8:
        return _decoded(load_mitsuba().Bitmap(np.ascontiguousarray(image)))
    if image.dtype.kind not in "fiu":
        raise TypeError(f"a backdrop's image must hold numbers, not {image.dtype}")
    pixels = image.astype(np.float32)
    if not (np.isfinite(pixels).all() and pixels.min() >= 0):
        raise ValueError("a backdrop's image must hold finite numbers that are not negative")
    if image.dtype.kind != "f" and pixels.max() > 1:
        raise TypeError(f"a backdrop's image must hold bytes (uint8) or floats, not {image.dtype}")
    return pixels


def _read(path: Path) -> FloatImage:
    """Read the image (h, w, 3) in a file, in linear sRGB, laid over white if it is transparent.

    Raises:
        FileFormatError: it is no image of a known type, or cannot be read.
    """
    if path.suffix.lower() not in IMAGE_FILES:
        raise FileLocation(path).error(f"a backdrop is an image: {', '.join(IMAGE_FILES)}")
    data = read_bytes(path)
    try:
        return _read_exr(data) if path.suffix.lower() == ".exr" else _read_bitmap(data)
    except (RuntimeError, ValueError, KeyError, OSError) as error:
        raise FileLocation(path).error(
            f"this is no image that can be read as {path.suffix.lower()}"
        ) from error


def _read_bitmap(data: bytes) -> FloatImage:
    """Decode the bytes of a PNG or JPEG file. Returns the image (h, w, 3) in linear sRGB."""
    mi = load_mitsuba()
    stream = mi.MemoryStream()
    stream.write(data)
    stream.seek(0)
    return _decoded(mi.Bitmap(stream))


def _decoded(bitmap: Any) -> FloatImage:
    """Return the pixels (h, w, 3) of a Mitsuba bitmap, in linear sRGB, laid over white if it is
    transparent."""
    mi = load_mitsuba()
    has_alpha = bitmap.has_alpha()
    kind = mi.Bitmap.PixelFormat.RGBA if has_alpha else mi.Bitmap.PixelFormat.RGB
    # False: without the transfer function of sRGB, that is linear.
    pixels = np.array(bitmap.convert(kind, mi.Struct.Type.Float32, False), dtype=np.float32)
    if has_alpha:
        pixels = pixels[..., :3] * pixels[..., 3:] + (1 - pixels[..., 3:])
    return np.ascontiguousarray(pixels)


def _read_exr(data: bytes) -> FloatImage:
    """Decode the bytes of an EXR file. Returns the image (h, w, 3), laid over white if it is
    transparent.

    It is read by the package OpenEXR: Mitsuba's reader never returns if Dr.Jit has one thread.
    """
    import OpenEXR  # here, since most pictures do without

    library = cast("Any", OpenEXR)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "backdrop.exr")
        path.write_bytes(data)
        with library.File(str(path)) as file:
            channels: dict[str, FloatImage] = {
                name: np.array(channel.pixels, dtype=np.float32)
                for name, channel in file.channels().items()
            }
    if "RGBA" in channels:  # colors are multiplied by alpha
        rgba = channels["RGBA"]
        pixels = rgba[..., :3] + (1 - np.clip(rgba[..., 3:], 0, 1))
    elif "RGB" in channels:
        pixels = channels["RGB"]
    else:  # luminance alone; KeyError if there are no colors at all
        pixels = np.repeat(channels["Y"][..., None], 3, axis=-1)
    # The backdrop's light must be finite and not negative.
    return np.maximum(np.nan_to_num(pixels, posinf=1e6), 0)
