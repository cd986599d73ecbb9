"""A surface through points of a scan.

Points with normals are small dipoles, whose potential is harmonic off the points: a level of it is
a surface through the cloud. Here the points lie on a torus, with gaps, and normals are estimated
from the points alone. No triangles are made.
"""

import sys
from pathlib import Path

import numpy as np

import harnack as hk


def main(folder: Path, size: tuple[int, int] = (640, 480), count: int = 6000) -> float:
    rng = np.random.default_rng(5)
    around, across = rng.uniform(0, 2 * np.pi, (2, count))
    from_axis = 1 + 0.4 * np.cos(across)
    points = np.column_stack(
        [from_axis * np.cos(around), from_axis * np.sin(around), 0.4 * np.sin(across)]
    )
    normals = hk.geometry.estimate_normals(points)
    surface = hk.DipolePotential(points, normals)
    hk.render(surface, folder / "point_cloud.png", show="shaded", size=size)

    # Where rays from above meet it, beside the torus that the points were taken from.
    places = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    origins = np.column_stack([np.cos(places), np.sin(places), np.full(100, 2.0)])
    hits = hk.trace(surface, origins, [[0.0, 0.0, -1.0]])
    error = float(np.abs(hits.position[:, 2] - 0.4).mean())
    print(f"{count:,} points; mean distance from the torus {error:.4f}")
    return error


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
