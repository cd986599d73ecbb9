"""The surface that spans a knot.

The solid angle of a closed curve, seen from a point of space, is a harmonic function of that
point, determined up to whole turns. Each of its level sets ends at the curve and nowhere else:
spanning, or Seifert, surfaces of the knot. This draws two of them, and meshes one to count what
its topology is. A surface with one edge and Euler characteristic -1 is a torus with a hole.
"""

import sys
from pathlib import Path

import numpy as np

import harnack as hk


def main(folder: Path, size: tuple[int, int] = (640, 480)) -> int:
    knot = hk.SolidAngle(
        hk.geometry.example_curves.torus_knot(2, 3, 60)
    )  # points (60, 3), or your own
    hk.render(
        knot,
        folder / "spanning_surface.png",
        level=2 * np.pi,
        show="shaded",
        boundary_radius=0.04,  # a tube around the knot
        camera=hk.Camera(azimuth=-60, elevation=35),
        size=size,
    )
    triangles = hk.mesh(knot, level=2 * np.pi, tolerance=1e-2)
    characteristic = triangles.metadata["harnack"]["euler_characteristic"]
    print(f"{len(triangles.faces):,} triangles, Euler characteristic {characteristic}")
    return characteristic


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
