"""Scenes of the gallery: solids that are extruded from outlines (closed polygons in the plane). One
is a plate with a name on it, the other a bolt with its nut. Each function here makes the surfaces
of a scene.
"""

from __future__ import annotations

import math

import numpy as np

from harnack.fields.solids.extrusions import Extrusion
from harnack.fields.solids.thread import metric_thread
from harnack.files import outline
from harnack.gallery.scene import Scene
from harnack.rendering import Camera
from harnack.tracer import Surface, TraceOptions

# harnack.io.outline.text("harnack", 1000, tolerance=4): x, y of each loop, so that the scene does
# without matplotlib. Behind the letters a are their holes.
_WORD: tuple[tuple[int, ...], ...] = (
    (91, 0, 181, 0, 181, 309, 192, 381, 223, 435, 273, 470, 338, 482, 391, 472, 429, 443, 451,
     395, 459, 327, 459, 0, 549, 0, 549, 330, 544, 400, 527, 457, 500, 502, 463, 534, 416, 554,
     358, 560, 304, 554, 257, 536, 216, 505, 181, 462, 181, 760, 91, 760),
    (877, -14, 938, -8, 989, 10, 1031, 40, 1066, 83, 1066, 0, 1156, 0, 1156, 312, 1149, 388, 1130,
     450, 1097, 498, 1051, 533, 992, 553, 920, 560, 830, 550, 734, 522, 734, 439, 819, 473, 911,
     484, 976, 475, 1025, 450, 1056, 409, 1066, 354, 1066, 345, 940, 345, 865, 340, 803, 324, 755,
     298, 721, 262, 701, 216, 694, 159, 706, 88, 743, 33, 802, -2),
    (901, 61, 852, 68, 815, 89, 791, 122, 784, 165, 794, 216, 826, 250, 861, 264, 911, 272, 977,
     275, 1066, 275, 1066, 255, 1055, 176, 1021, 114, 968, 74),
    (1337, 0, 1428, 0, 1428, 288, 1438, 370, 1468, 430, 1518, 468, 1585, 480, 1625, 476, 1658,
     463, 1657, 555, 1632, 559, 1612, 560, 1552, 554, 1501, 536, 1460, 505, 1428, 462, 1428, 547,
     1337, 547),
    (1731, 0, 1821, 0, 1821, 309, 1832, 381, 1863, 435, 1913, 470, 1978, 482, 2031, 472, 2069,
     443, 2092, 395, 2099, 327, 2099, 0, 2189, 0, 2189, 330, 2184, 400, 2168, 457, 2141, 502, 2103,
     534, 2056, 554, 1998, 560, 1944, 554, 1897, 536, 1856, 505, 1821, 462, 1821, 547, 1731, 547),
    (2517, -14, 2578, -8, 2629, 10, 2672, 40, 2706, 83, 2706, 0, 2796, 0, 2796, 312, 2789, 388,
     2770, 450, 2737, 498, 2692, 533, 2632, 553, 2560, 560, 2470, 550, 2374, 522, 2374, 439, 2459,
     473, 2551, 484, 2616, 475, 2665, 450, 2696, 409, 2706, 354, 2706, 345, 2580, 345, 2505, 340,
     2444, 324, 2396, 298, 2361, 262, 2341, 216, 2334, 159, 2346, 88, 2383, 33, 2442, -2),
    (2541, 61, 2493, 68, 2455, 89, 2432, 122, 2424, 165, 2434, 216, 2466, 250, 2501, 264, 2552,
     272, 2617, 275, 2706, 275, 2706, 255, 2695, 176, 2661, 114, 2608, 74),
    (3211, -14, 3297, -5, 3375, 21, 3375, 104, 3298, 72, 3221, 62, 3167, 68, 3121, 87, 3085, 117,
     3058, 159, 3042, 211, 3037, 273, 3042, 335, 3058, 387, 3085, 428, 3121, 459, 3167, 478, 3221,
     484, 3298, 473, 3375, 442, 3375, 526, 3298, 551, 3217, 560, 3138, 551, 3070, 526, 3015, 483,
     2975, 426, 2950, 356, 2942, 273, 2950, 191, 2974, 121, 3015, 63, 3069, 20, 3134, -6),
    (3527, 0, 3618, 0, 3618, 267, 3896, 0, 4013, 0, 3710, 291, 4000, 547, 3886, 547, 3618, 311,
     3618, 760, 3527, 760),
)  # fmt: skip


def _nameplate() -> list[Surface]:
    """Return a plate with round ends and a hole, and a word in raised letters on it."""
    # The round ends are half circles of radius 0.75 about x = 4.2 and x = -0.6.
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 90)
    right = np.column_stack([4.2 + 0.75 * np.cos(angle), 0.75 * np.sin(angle)])
    left = np.column_stack([-0.6 - 0.75 * np.cos(angle), -0.75 * np.sin(angle)])
    (hole,) = outline.regular_polygon(120, 0.25)
    # The second argument of an extrusion is its height.
    plate = Extrusion([np.concatenate([right, left]), hole - (0.65, 0.0)], 0.2)
    letters = [np.reshape(loop, (-1, 2)) / 1000.0 - (0.0, 0.37) for loop in _WORD]
    # A little way into the plate, so that no faces coincide.
    raised = Extrusion(letters, 0.25).translated((0.0, 0.0, 0.15))
    solids = (plate.translated((-1.8, 0.0, 0.0)), raised.translated((-1.8, 0.0, 0.0)))
    return [Surface(solid) for solid in solids]


def _bolt() -> list[Surface]:
    """Return an M8 bolt and a nut beside it, in millimeters."""
    hexagon = outline.regular_polygon(6, 13.0 / math.sqrt(3.0))
    bolt = metric_thread("M8", 22.0) | Extrusion(hexagon, 5.3).translated((0.0, 0.0, -5.3))
    nut = Extrusion(hexagon, 6.5) - metric_thread("M8", 8.0, internal=True, clearance=0.05)
    turned_nut = nut.rotated(20.0).translated((-8.0, -14.0, -5.3))
    return [Surface(solid) for solid in (bolt, turned_nut)]


OUTLINES = (
    Scene(
        "nameplate",
        "an outline with a hole, extruded, and the outline of a word on it",
        _nameplate,
        ("clay", "gold"),
        Camera(azimuth=-80, elevation=48),
        demo_spp=25,
    ),
    Scene(
        "bolt",
        "an M8 bolt with its thread, and a nut",
        _bolt,
        ("copper", "copper"),
        Camera(azimuth=-65, elevation=24),
        options=TraceOptions(tolerance=2e-3),
        demo_spp=25,
    ),
)
