"""A broken mesh, made whole for a printer.

A ball has lost its top and some more of its faces. The winding number of what is left is a
function that needs no closed mesh: its 1/2 level is the mesh where there is one and a smooth
surface where there is none. The picture shows that level, patches in amber; `hk.repair` gives the
same as triangles, with all triangles that were there kept as they were.
"""

import sys
from pathlib import Path

import numpy as np
import trimesh

import harnack as hk


def main(folder: Path, size: tuple[int, int] = (640, 480)) -> trimesh.Trimesh:
    vertices, faces = hk.geometry.example_meshes.bumpy_sphere(3)
    middles = vertices[faces].mean(axis=1)
    is_lost = (middles[:, 2] > 0.75) | (np.abs(middles - [0.6, -0.6, 0.2]).sum(axis=1) < 0.5)
    broken = trimesh.Trimesh(vertices, faces[~is_lost], process=False)

    hk.render(
        hk.WindingNumber(broken.vertices, broken.faces),
        folder / "repaired_mesh.png",
        show="shaded",
        size=size,
        camera=hk.Camera(elevation=40),
    )
    whole = hk.repair(broken, filling="harmonic")
    whole.export(folder / "repaired_mesh.stl")
    print(f"watertight: {broken.is_watertight}, then {whole.is_watertight}")
    return whole


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
