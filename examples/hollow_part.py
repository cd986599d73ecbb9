"""A part from a mesh: hollowed, with a gyroid inside and two vents, and checked.

A closed mesh is a solid. Its shell, the lattice inside and the vents are put together by operators,
drawn as they are, opened, and meshed; then `check_print` says what a slicer would complain of, and
`thickness` where walls are thinner than asked. Lengths are millimeters. Any closed file does in
place of the ring: hk.solid("part.stl").
"""

import sys
from pathlib import Path

import numpy as np

import harnack as hk
from harnack.geometry import example_meshes


def main(
    folder: Path, size: tuple[int, int] = (640, 480), tolerance: float = 0.36
) -> hk.printing.PrintCheck:
    part = hk.solid(example_meshes.torus_mesh(20.0, 10.0, 96, 48))
    gyroid = hk.Gyroid(cell=8.0)
    walls = hk.solid(gyroid, between=gyroid.levels_of_thickness(0.8))
    hollow = part.shell(2.0) | (part & walls)
    for x in (-20.0, 20.0):
        hollow = hollow - hk.Cylinder(2.0, 8.0).translated((x, 0.0, -10.0))
    opened = hk.HalfSpace((0.0, -1.0, 0.0), 0.0)
    hk.render(hollow, folder / "hollow_part.png", show="shaded", section=opened, size=size)

    triangles = hk.mesh(hollow, tolerance=tolerance)
    triangles.export(folder / "hollow_part.stl")
    check = hk.check_print(folder / "hollow_part.stl")
    for problem in check.problems:
        print(problem.message)
    share = triangles.volume / (2 * np.pi**2 * 20.0 * 10.0**2)
    print(f"{check.triangles:,} triangles, {share:.0%} of the space is filled")
    return check


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
