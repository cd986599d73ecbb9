"""Parts to print: a bolt and its nut, a vase, a plate with text, a lattice, a Seifert surface.

Each is one expression, in millimeters. It is drawn as it is, without triangles, and meshed, closed,
into an STL file for a slicer.

Needs matplotlib for the text: `pip install 'harnack[outlines]'`.
"""

import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

import harnack as hk

HEXAGON = hk.io.outline.regular_polygon(6, 13 / math.sqrt(3))  # 13 mm from side to side


def bolt() -> hk.solids.Solid:
    return hk.solids.metric_thread("M8", 22.0) | hk.Extrusion(HEXAGON, 5.3).translated((0, 0, -5.3))


def nut() -> hk.solids.Solid:
    return hk.Extrusion(HEXAGON, 6.5) - hk.solids.metric_thread(
        "M8", 8.0, internal=True, clearance=0.1
    )


def vase() -> hk.solids.Solid:
    """Seven waves around, turned by a quarter and half as wide again above; walls of 1.8 mm."""
    angle = np.linspace(0, 2 * math.pi, 420, endpoint=False)
    radius = 24 + 2.5 * np.cos(7 * angle)
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    body = hk.Extrusion([ring], 90.0, twist=90.0, taper=1.5)
    # The hollow goes on above the rim, and ends above the floor.
    hollow = hk.Extrusion([(1 - 1.8 / 24) * ring], 99.0, twist=99.0, taper=1.55)
    return body - (hollow & hk.Cuboid((120.0, 120.0, 120.0)).translated((0, 0, 62)))


def plate() -> hk.solids.Solid:
    word = hk.io.outline.text("harnack", 12.0)
    low, high = np.concatenate(word).min(axis=0) - 4, np.concatenate(word).max(axis=0) + 4
    rim = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    # A little way into the plate, so that no faces coincide.
    return hk.Extrusion([rim], 2.0) | hk.Extrusion(word, 1.5).translated((0, 0, 1.5))


def lattice() -> hk.solids.Solid:
    gyroid = hk.Gyroid(5.0)
    walls = hk.solid(gyroid, between=gyroid.levels_of_thickness(0.8))
    return walls & hk.Cylinder(20.0, 40.0)


def seifert() -> hk.SolidAngle:
    return hk.SolidAngle(16 * hk.geometry.example_curves.torus_knot(2, 3, 128))


PARTS: dict[str, Callable[[], hk.solids.Solid | hk.SolidAngle]] = {
    part.__name__: part for part in (bolt, nut, vase, plate, lattice, seifert)
}
# Where parts stand in the picture.
PLACES = {
    "bolt": (-40, -30, 5.3),
    "nut": (-20, -38, 0),
    "vase": (0, 45, 0),
    "plate": (0, -40, 0),
    "lattice": (-65, 25, 20),
    "seifert": (70, 20, 14),
}


def standing(name: str) -> hk.Field:
    part, place = PARTS[name](), PLACES[name]
    if isinstance(part, hk.SolidAngle):
        return hk.SolidAngle([loop + place for loop in part.loops])
    return part.translated(place)


def main(
    folder: Path,
    size: tuple[int, int] = (640, 480),
    tolerance: float | None = None,  # in mm; None: a thousandth of the longest side
    names: tuple[str, ...] = tuple(PARTS),
) -> dict[str, float]:
    scene = [standing(name) for name in names]
    camera = hk.Camera(azimuth=-75, elevation=28)
    picture = folder / "printed_parts.png"
    look = {"show": "shaded", "material": "clay", "camera": camera, "size": size}
    hk.render(scene, picture, tolerance=2e-3, **look)
    volumes: dict[str, float] = {}
    for name in names:
        part = PARTS[name]()
        if isinstance(part, hk.solids.Solid):
            triangles = hk.mesh(part, tolerance=tolerance, simplify=True)
        else:
            triangles = hk.mesh(part, thickness=2.0, tolerance=tolerance, simplify=True)
        triangles.export(folder / f"{name}.stl")
        volumes[name] = float(triangles.volume)
        print(f"{name}: {len(triangles.faces):,} triangles, {volumes[name]:,.0f} mm³")
    return volumes


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
