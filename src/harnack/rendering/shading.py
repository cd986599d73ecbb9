"""Parts of shaded pictures, which are computed by formulas from the first hit of each ray: the
order in which pixels are traced, the light of the studio, the shadow on its floor, and the wall or
backdrop behind everything. The studio is the stage on which surfaces are drawn, with a floor at z =
0. `mi` is the Mitsuba module, and a hemisphere is the upper half of all directions over a surface,
from which light of the sky comes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import BoolArray, FloatArray, IntArray, to_numpy
from harnack.backend.arrays import upload_floats, upload_integers
from harnack.rendering.backdrops import (
    FLOOR_HEIGHT,
    GradientBackdrop,
    GroundBackdrop,
    ImageBackdrop,
    distant_ground_radiance,
    reflectance_of,
)
from harnack.rendering.mitsuba import mitsuba_backend
from harnack.rendering.scales import linear_from_srgb

# Pixels in tiles and bands, and places within them.

_TILE = 4
# Neighbors that differ by more than this, of 255, are an edge.
_EDGE = 16


def pixel_ranges(pixels: int, step: int) -> Iterator[tuple[int, int]]:
    """Divide range(pixels) into ranges (start, stop) of at most `step` pixels. Ctrl-C works between
    the ranges."""
    for start in range(0, pixels, step):
        yield start, min(start + step, pixels)


def tiled_pixel_order(size: tuple[int, int]) -> IntArray:
    """Return the indices (n,) of all pixels of a picture of `size` (width, height), ordered by
    squares of 4 x 4 pixels. An index counts pixels by rows.

    Rays that a processor follows together are then close to each other and have about the same
    length.
    """
    width, height = size
    # The numbers of squares down and across, rounded up.
    rows, columns = -(-height // _TILE), -(-width // _TILE)
    y, x = np.indices((rows * _TILE, columns * _TILE))
    # Squares may go beyond the right and lower border; such places hold -1 and are left out.
    inside = (x < width) & (y < height)
    pixel_of_place = np.where(inside, y * width + x, -1).reshape(rows, _TILE, columns, _TILE)
    order = pixel_of_place.swapaxes(1, 2).ravel()
    return order[order >= 0]


def upload_indices(mi: Any, pixels: IntArray) -> Any:
    """Return the indices of pixels as an array of the Mitsuba variant."""
    return upload_integers(mitsuba_backend(mi), pixels)


def film_positions(mi: Any, pixel: Any, offset: Any, size: tuple[int, int]) -> Any:
    """Return points on the film, in [0, 1]^2.

    pixel: indices of pixels, counted by rows.
    offset: (2,) the coordinates of the point in its pixel, from 0 to 1.
    size: (width, height) of the film in pixels.
    """
    position = mi.Vector2f(pixel % size[0], pixel // size[0]) + offset
    return mi.Point2f(position / mi.ScalarVector2f(*size))


def grid_sample_count(spp: int) -> int:
    """Return the smallest number of samples, at least `spp`, that fills a nearly square grid."""
    rows = max(1, math.isqrt(spp))
    return rows * -(-spp // rows)


def multijitter_offsets(count: int) -> FloatArray:
    """Return at least `count` points (n, 2) in the unit square, always the same for a count.

    They are the canonical arrangement of multi-jittering (Kensler 2013): one point in each cell of
    a nearly square grid, and no two in the same row or column of a grid of n x n cells. So edges of
    any slope look smooth.
    """
    point_count = grid_sample_count(count)
    # The grid with the most rows that is not higher than wide.
    rows = max(
        r for r in range(1, point_count + 1) if point_count % r == 0 and r * r <= point_count
    )
    columns = point_count // rows
    j, i = (index.ravel() for index in np.mgrid[:rows, :columns])
    # In each cell, the point is shifted by an amount that depends on the cell's row or column.
    x = (i + (j + 0.5) / rows) / columns
    y = (j + (i + 0.5) / columns) / rows
    return np.column_stack([x, y])


def edge_pixels(picture: npt.NDArray[np.uint8]) -> BoolArray:
    """Return the mask (h, w) of the pixels of a picture (h, w, 3) that differ from one of their
    four neighbors by more than 16 of 255 in a channel."""
    shown = picture.astype(np.int64)
    edge = np.zeros(shown.shape[:2], dtype=np.bool_)
    differs_from_right = (np.abs(np.diff(shown, axis=1)) > _EDGE).any(axis=-1)
    differs_from_below = (np.abs(np.diff(shown, axis=0)) > _EDGE).any(axis=-1)
    # Both pixels of a pair that differs are marked.
    edge[:, 1:] |= differs_from_right
    edge[:, :-1] |= differs_from_right
    edge[1:] |= differs_from_below
    edge[:-1] |= differs_from_below
    return edge


# Light.

Color = tuple[float, float, float]

# Irradiance over pi, linear sRGB: of the key light at its brightest, and of the hemisphere.
KEY_IRRADIANCE: Color = (0.74, 0.71, 0.66)
SKY_IRRADIANCE: Color = (0.36, 0.40, 0.46)
GROUND_IRRADIANCE: Color = (0.25, 0.225, 0.20)
# Towards the key light, along the camera's axes to the right, up and back.
KEY_DIRECTION = np.array([-0.52, 0.62, 0.59]) / np.linalg.norm([-0.52, 0.62, 0.59])
# The key light reaches round to where its cosine is minus this.
KEY_WRAP = 0.25
# The fraction of the key light that is removed if the whole hemisphere is hidden.
KEY_HIDDEN = 0.6
HIGHLIGHT = 0.22
HIGHLIGHT_EXPONENT = 60.0
RIM = 0.45
# The color of transparent matter; and the reflectance of mirrors, which keep their hue.
_CLEAR: Color = (0.52, 0.60, 0.64)
_METAL = 0.78
# The side of larger values of a surface that has one color for both.
_INNER_TINT: Color = (0.52, 0.60, 0.74)
# Where a level set closes a hole of a mesh: this fraction of amber, or of teal on warm colors.
_FILLING_TINT = 0.55
_AMBER: Color = (0.92, 0.40, 0.06)
_TEAL: Color = (0.05, 0.40, 0.46)


@dataclass(frozen=True)
class StudioLight:
    """The light of shaded pictures. It is a formula, so one ray a sample suffices.

    It consists of a soft key light from the upper left of the camera, a hemisphere of light that is
    cooler above than below, and highlights on glossy materials. `shaded_render.ambient_visibility`
    computes how much of the hemisphere nearby surfaces hide, and `FloorShadow` where the studio's
    floor lies in shadow.

    key, up: unit vectors, as lists of three numbers, to the key light and to the middle of the
        brighter half of the hemisphere.
    """

    key: Sequence[float]
    up: Sequence[float]

    @classmethod
    def of(cls, world_from_camera: FloatArray) -> StudioLight:
        """Return the light for a camera, relative to which its key light stands.

        world_from_camera: (4, 4) the camera's matrix, whose axes point left, up and forward.
        """
        left, up, forward = (axis / np.linalg.norm(axis) for axis in world_from_camera[:3, :3].T)
        key = np.stack([-left, up, -forward], axis=1) @ KEY_DIRECTION
        return cls(key.tolist(), up.tolist())

    def shade(
        self, color: Any, normal: Any, eye: Any, glossy: Any, visible: Any, reached: Any = 1.0
    ) -> Any:
        """Compute the radiance (3,) of surface points toward the eye. All parameters are Dr.Jit
        arrays.

        color: (3,) reflectance.
        normal, eye: (3,) the surface's unit normal and the unit direction to the eye, on the same
            side of the surface.
        glossy: mask of glossy materials.
        visible: the fraction of the hemisphere over the normal that nothing near hides.
        reached: the fraction of the key light that is not in shadow.
        """
        key, up = _parameter(normal, self.key), _parameter(normal, self.up)
        # The key light is large: it reaches a little around the terminator.
        key_cosine = dr.clip((dr.dot(normal, key) + KEY_WRAP) / (1 + KEY_WRAP), 0, 1)
        # What hides the sky hides a part of the large key light, too.
        key_visible = (1 - KEY_HIDDEN * (1 - visible)) * reached
        upper_fraction = 0.5 + 0.5 * dr.dot(normal, up)
        # Light of the hemisphere, between its color below and its color above.
        sky = (
            dr.lerp(_like(color, GROUND_IRRADIANCE), _like(color, SKY_IRRADIANCE), upper_fraction)
            * visible
        )
        radiance = color * (_like(color, KEY_IRRADIANCE) * (key_cosine * key_visible) + sky)
        half_vector = dr.normalize(key + eye)
        # Where the light is below the horizon there is no highlight, and no edge to it either.
        highlight = HIGHLIGHT * dr.power(
            dr.maximum(dr.dot(normal, half_vector), 0), HIGHLIGHT_EXPONENT
        )
        # Glossy matter reflects more sky at grazing angles (Schlick).
        rim = RIM * dr.power(1 - dr.clip(dr.dot(normal, eye), 0, 1), 5)
        gloss = _like(color, KEY_IRRADIANCE) * (highlight * key_cosine * key_visible) + sky * rim
        return radiance + dr.select(glossy, gloss, 0)


def reflectance(color: Any, painted: Any) -> Any:
    """Return the color (3,) in which a surface is drawn, from the reflectance of its BSDF at normal
    incidence. Metal is darkened and keeps its hue. Matter without diffuse reflectance, such as
    clear glass, gets the color of glass.

    color: (3,) the reflectance; a channel above 1 marks metal.
    painted: mask of points on isolines, which keep their reflectance, even if it is 0.
    """
    painted_color = color
    largest_channel = dr.max(color)
    # The square, as light in a mirror is reflected more than once.
    metal = dr.square(color / largest_channel) * _METAL
    color = dr.select(largest_channel > 1, metal, color)
    return dr.select(
        painted, painted_color, dr.select(largest_channel > 0, color, _like(color, _CLEAR))
    )


def two_sided_color(color: Any, other: Any, inside: Any) -> Any:
    """Return the color (3,) of the visible side of an open surface. If both sides have one color,
    the side of larger values of the field is drawn darker and cooler.

    color, other: the colors of the visible and of the hidden side.
    inside: mask of points that are seen from the side of larger values.
    """
    is_one_color = dr.max(dr.abs(color - other)) < 1e-4  # equal up to rounding
    return dr.select(inside & is_one_color, color * _like(color, _INNER_TINT), color)


def hole_filling_tint(color: Any, is_filling: Any) -> Any:
    """Tint colors (3,) amber, or teal if they are warm, where a level set closes a hole of a mesh.
    Returns all colors.

    is_filling: mask of such points.
    """
    # In a warm color, red is much stronger than blue.
    tint = dr.select(color[0] > 1.6 * color[2], _like(color, _TEAL), _like(color, _AMBER))
    return dr.select(is_filling, dr.lerp(color, tint, _FILLING_TINT), color)


def _parameter(array: Any, numbers: Sequence[float]) -> Any:
    """Return numbers as an array of the type of `array`, as kernel parameters: other numbers
    compile no other kernel."""
    vector = _like(array, numbers)
    dr.make_opaque(vector)
    return vector


def _like(array: Any, numbers: Sequence[float]) -> Any:
    """Return numbers as an array of the type of `array`."""
    return type(array)(*numbers)


# The floor's shadow.

# The number of cells along a side of the shadow's square, and half its side; the square contains
# all objects on the stage and their shadows.
FLOOR_CELLS = 64
FLOOR_HALF_WIDTH = 2.4
# The number of rays of a cell to the key light, and to the sky. In a block of 4 x 4 cells the rays
# of all cells differ.
RAYS_PER_CELL = 8
SAMPLE_BLOCK = 4
# The tangent of the angular radius of the key light, and the length of the rays.
KEY_LIGHT_RADIUS = 0.34
FLOOR_RAY_LENGTH = 3.5
# The least height of a unit vector to the key light: the floor itself casts no shadow.
LEAST_KEY_HEIGHT = 0.05
# Weights of a cell and its neighbors along each axis: a block's cells count nearly alike. Their
# number is odd, so that the picture stays in place.
BLUR_WEIGHTS = np.convolve((0.05, 0.2, 0.25, 0.25, 0.2, 0.05), (0.5, 0.5))


class ShadowCaster(Protocol):
    """Interface to objects that cast shadows, such as a `HybridScene`. `mi` is the Mitsuba
    module."""

    @property
    def mi(self) -> Any: ...

    def occluded(self, ray: Any, active: Any) -> Any:
        """Return the mask of rays of Mitsuba's that hit an object."""
        ...


@dataclass(frozen=True)
class FloorShadow:
    """The soft shadow on the studio's floor, traced on a coarse grid and blurred.

    texture: has two channels, the fractions of the key light and of the sky's light that reach a
        point of the floor.
    """

    mi: Any
    texture: Any

    @classmethod
    def of(cls, world: ShadowCaster, light: StudioLight) -> FloorShadow:
        """Compute the shadow of the objects of a scene on the floor, by tracing rays from the floor
        to the key light and to the sky."""
        mi = world.mi
        cell_centers = (
            np.arange(FLOOR_CELLS) + 0.5
        ) / FLOOR_CELLS * 2 * FLOOR_HALF_WIDTH - FLOOR_HALF_WIDTH
        y, x = np.meshgrid(cell_centers, cell_centers, indexing="ij")
        fractions = _visible_fractions(
            world, x, y, np.stack([_key_directions(light.key), sky_directions()])
        )
        # The channels of the texture are the fractions of the key light and of the sky.
        image = np.stack([_blurred(fraction) for fraction in fractions], axis=-1)
        numbers = mi.Float(upload_floats(mitsuba_backend(mi), image.ravel()))
        tensor = mi.TensorXf(numbers, image.shape)
        return cls(mi, mi.Texture2f(tensor, wrap_mode=dr.WrapMode.Clamp))

    def at(self, position: Any) -> tuple[Any, Any]:
        """Return the fractions of the key light and of the sky's light that reach points (3,) of
        the world. Both are 1 for points that are not on the floor."""
        mi = self.mi
        # Everything on the stage stands above the floor, which is at a small negative height.
        on_floor = position.z < 0.5 * FLOOR_HEIGHT
        texture_position = mi.Point2f(position.x, position.y) / (2 * FLOOR_HALF_WIDTH) + 0.5
        key, sky = self.texture.eval(dr.select(on_floor, texture_position, 0))
        return dr.select(on_floor, key, 1), dr.select(on_floor, sky, 1)


def _visible_fractions(
    world: ShadowCaster, x: FloatArray, y: FloatArray, towards: FloatArray
) -> FloatArray:
    """Trace rays from n x n points of the floor into k sets of directions. Returns for each set and
    point the fraction of its rays that hit nothing, (k, n, n).

    x, y: (n, n) coordinates of the points.
    towards: (k, 16, RAYS_PER_CELL, 3) unit directions of rays. Each point of a block of 4 x 4
        points takes one of the 16 groups of a set.
    """
    mi = world.mi
    # The place of a point in its block of 4 x 4 points chooses its group of rays.
    j, i = np.indices(x.shape)
    d = towards[:, (j % SAMPLE_BLOCK) * SAMPLE_BLOCK + i % SAMPLE_BLOCK]
    # A copy of each point for each of its rays.
    o = np.stack([x, y, np.zeros_like(x)], axis=-1)[:, :, None]
    o = np.broadcast_to(o, d.shape)
    ray = mi.Ray3f(_vectors(mi.Point3f, o), _vectors(mi.Vector3f, d))
    ray.maxt = mi.Float(FLOOR_RAY_LENGTH)
    is_free = to_numpy(~world.occluded(ray, mi.Bool(True)))
    fractions: FloatArray = is_free.reshape(d.shape[:-1]).mean(axis=-1)
    return fractions


def _vectors(kind: Any, rows: FloatArray) -> Any:
    """Return rows (..., 3) as a Dr.Jit array of vectors, of the type `kind`."""
    return kind(np.ascontiguousarray(rows.reshape(-1, 3).T, dtype=np.float32))


def _square_points() -> FloatArray:
    """Return points in the unit square, from which directions of shadow rays are made. There is a
    group of them for each cell of a block of 4 x 4 cells of the floor, and in a group a point for
    each ray of the cell: (16, RAYS_PER_CELL, 2). All points together are spread evenly (Roberts
    2018)."""
    k = np.arange(SAMPLE_BLOCK * SAMPLE_BLOCK * RAYS_PER_CELL)
    plastic = 1.32471795724474602596  # the real root of x^3 = x + 1
    points = np.mod(0.5 + np.outer(k, [1 / plastic, 1 / plastic**2]), 1.0)
    # Successive points go to different groups.
    return points.reshape(RAYS_PER_CELL, SAMPLE_BLOCK * SAMPLE_BLOCK, 2).transpose(1, 0, 2)


def key_light_points() -> FloatArray:
    """Return points spread over the round key light, the aims of shadow rays: 16 groups, one for
    each cell of a block of 4 x 4 cells of the floor, (16, RAYS_PER_CELL, 2). The two numbers of a
    point are its distance from the middle of a light at distance 1, and the angle around the
    middle, in radians."""
    # The square root spreads points evenly over the disc.
    return np.stack(
        [
            KEY_LIGHT_RADIUS * np.sqrt(_square_points()[..., 0]),
            2 * math.pi * _square_points()[..., 1],
        ],
        axis=-1,
    )


def _key_directions(key: Any) -> FloatArray:
    """Return unit directions of shadow rays to points spread over the round key light: 16 groups,
    one for each cell of a block of 4 x 4 cells of the floor, (16, RAYS_PER_CELL, 3). key: (3,) the
    direction to the middle of the light."""
    axis = np.asarray(key, dtype=np.float64)
    # The coordinate axis that is farthest from `axis` gives a vector at right angles.
    tangent = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    tangent /= np.linalg.norm(tangent)
    radius, angle = np.split(key_light_points(), 2, axis=-1)
    d = axis + radius * (np.cos(angle) * tangent + np.sin(angle) * np.cross(axis, tangent))
    # Rays go up from the floor, which casts no shadow itself.
    d[..., 2] = np.maximum(d[..., 2], LEAST_KEY_HEIGHT)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def sky_directions() -> FloatArray:
    """Return unit directions of shadow rays to the sky: 16 groups, one for each cell of a block of
    4 x 4 cells of the floor, (16, RAYS_PER_CELL, 3). Their density is proportional to the cosine of
    the angle to the vertical."""
    # Uniform squares of the sine give the cosine distribution. The height is kept above 0, so that
    # no ray runs along the floor.
    sine_squared, turn = np.moveaxis(_square_points(), -1, 0)
    sine = np.sqrt(sine_squared)
    return np.stack([sine * np.cos(2 * math.pi * turn), sine * np.sin(2 * math.pi * turn),
                     np.sqrt(np.maximum(1 - sine_squared, 1e-3))], axis=-1)  # fmt: skip


def _blurred(image: FloatArray) -> FloatArray:
    """Blur an image (n, n) along both axes. Outside of the image its values are taken as 1: nothing
    is hidden there."""
    width = len(BLUR_WEIGHTS) // 2
    for _ in range(2):
        rows = [np.convolve(row, BLUR_WEIGHTS, mode="valid") for row in _framed(image, width)]
        # Rows become columns, so the second pass blurs along the other axis.
        image = np.array(rows).T
    return image


def _framed(image: FloatArray, width: int) -> FloatArray:
    """Return the image with `width` columns of ones added on the left and on the right."""
    return np.pad(image, ((0, 0), (width, width)), constant_values=1.0)


# Backdrops.

# The fraction by which the wall is darker straight above, and the power of the height with which it
# grows.
WALL_DARKENING, WALL_EXPONENT = 0.45, 0.7
FloatImage = npt.NDArray[np.float32]


def wall_brightness(height: Any) -> Any:
    """Compute the brightness of the wall, relative to that of the ground far away.

    height: of the unit vector to a point of the wall, in [0, 1]; NumPy's or Dr.Jit's numbers.
    """
    return 1 - WALL_DARKENING * height**WALL_EXPONENT


def studio_wall(
    mi: Any, sensor: Any, ground: GroundBackdrop, azimuth: float, show: str
) -> FloatImage:
    """Compute the radiance (h, w, 3) of the studio's ground and of the wall behind it, at the
    middle of each pixel.

    sensor: Mitsuba's camera, with the film.
    ground: the backdrop.
    azimuth: of the camera, in degrees.
    show: the kind of picture, "path" or "shaded", on which the brightness of the ground depends.

    The camera does not see the environment that lights the stage. It sees the ground as far as the
    horizon, and above it a wall of the same color that is darker higher up. So the horizon is no
    edge, however low the camera stands.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    pixel = dr.arange(mi.UInt32, width * height)
    position = film_positions(mi, pixel, mi.Vector2f(0.5), (width, height))
    # One fixed wavelength and the middle of the lens: no random numbers are needed.
    ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, position, mi.Point2f(0.5))
    # From 0 at the horizon to 1 straight above.
    height_of_ray = np.clip(to_numpy(ray.d)[:, 2], 0, 1)
    distant = distant_ground_radiance(ground.name, azimuth)
    if show == "shaded":
        distant = _far_shaded(mi, sensor, ground)
    image = distant * wall_brightness(height_of_ray[:, None])
    return image.astype(np.float32).reshape(height, width, 3)


def _far_shaded(mi: Any, sensor: Any, ground: GroundBackdrop) -> FloatArray:
    """Compute the radiance (3,) of the ground far from the stage, in the light of shaded pictures.
    The light moves with the camera, `sensor`."""
    matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
    color = mi.Color3f(*reflectance_of(ground.name).tolist())
    up, one = mi.Vector3f(0, 0, 1), mi.Float(1)
    # Not glossy, so that the direction to the eye does not matter; and nothing hides the sky.
    lit = StudioLight.of(matrix).shade(color, up, up, mi.Bool(False), one)
    return to_numpy(lit).reshape(3).astype(np.float64)


def backdrop_image(
    mi: Any, backdrop: GradientBackdrop | ImageBackdrop, size: tuple[int, int]
) -> FloatImage:
    """Return the linear sRGB image (h, w, 3) of a color gradient or an image behind a picture of
    `size` (width, height) pixels."""
    if isinstance(backdrop, ImageBackdrop):
        return _covering(mi, backdrop.pixels, size)
    width, height = size
    # One row for all, (1, 1, 3), or one color for each row, (h, 1, 3).
    if backdrop.bottom == backdrop.top:
        rows = np.array([[linear_from_srgb(backdrop.top)]], dtype=np.float32)
    else:  # even steps in sRGB look even
        height_fraction = (height - 0.5 - np.arange(height)[:, None]) / height
        shown = (1 - height_fraction) * np.array(backdrop.bottom) + height_fraction * np.array(
            backdrop.top
        )
        rows = np.array(
            [[linear_from_srgb(tuple(row))] for row in shown.tolist()], dtype=np.float32
        )
    return np.broadcast_to(rows, (height, width, 3))


def _covering(mi: Any, image: FloatImage, size: tuple[int, int]) -> FloatImage:
    """Scale an image so that it covers a picture of `size` (width, height) pixels. The image is
    cropped around its middle to the shape of the picture first."""
    height, width = image.shape[:2]
    scale = max(size[0] / width, size[1] / height)
    cropped_size = [
        min(round(side / scale), full) for side, full in zip(size, (width, height), strict=True)
    ]
    columns, rows = (max(length, 1) for length in cropped_size)
    left, top = (width - columns) // 2, (height - rows) // 2
    cropped = np.ascontiguousarray(image[top : top + rows, left : left + columns])
    if (columns, rows) == size:
        return cropped
    # The filter overshoots at edges: negative light is clamped.
    bitmap = mi.Bitmap(cropped).resample(mi.ScalarVector2u(*size), clamp=(0.0, np.inf))
    return np.array(bitmap, dtype=np.float32)
