"""A part of gyroid walls, to print.

A gyroid is a level set, a wall of it the part of space between two; operators cut it to a cylinder
with a bore. The solid is drawn as it is, without triangles; then it is meshed, closed, for a
slicer. Its volume says how much material it takes.
"""

import sys
from pathlib import Path

import numpy as np

import harnack as hk


def main(folder: Path, size: tuple[int, int] = (640, 480), tolerance: float = 6e-3) -> float:
    walls = hk.solid(hk.Gyroid(cell=0.8), between=(-0.35, 0.35))
    part = walls & (hk.Cylinder(1.0, 1.2) - hk.Cylinder(0.45, 2.0))
    hk.render(part, folder / "gyroid_part.png", show="shaded", material="silver", size=size)

    triangles = hk.mesh(part, tolerance=tolerance)
    triangles.apply_scale(25.0)  # one unit is 25 mm
    triangles.export(folder / "gyroid_part.stl")
    share = triangles.volume / (np.pi * 1.2 * (1 - 0.45**2) * 25.0**3)
    print(f"watertight: {triangles.is_watertight}; {share:.0%} of the space is filled")
    return share


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
