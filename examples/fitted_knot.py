"""A trefoil from eight masks.

The fit starts from a trefoil that was squeezed and bent. Whether the fitted polygon is still a
trefoil is told by an invariant of knots, the determinant: 1 for a circle, 3 for the trefoil, 5 for
the figure eight.

The row of pictures needs Pillow, which is in `pip install 'harnack[film]'`.
"""

import sys
from pathlib import Path

import harnack as hk  # isort: skip; it has Dr.Jit load its LLVM

import drjit as dr
import numpy as np
from drjit.auto.ad import TensorXf64
from PIL import Image
from scipy.spatial import cKDTree


def directions(n: int) -> np.ndarray:
    """n unit vectors (n, 3), evenly over the sphere along a spiral."""
    k = np.arange(n) + 0.5
    z, angle = 1 - 2 * k / n, np.pi * (3 - 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z])


CAMERAS = [hk.Camera(position=d, target=(0, 0, 0), fov=40) for d in (5 * directions(8)).tolist()]


def draw(vertices, camera: hk.Camera, size: int, seed: int):
    field = hk.SolidAngle(vertices)
    return hk.picture(field, camera=camera, size=size, show="mask", seed=seed)


def fit(start: np.ndarray, goals: list[np.ndarray], steps: int) -> list[np.ndarray]:
    """The curves of all steps. A step looks at two of the masks in turn."""
    n, unit_matrix = len(start), np.eye(len(start))
    laplacian = 2 * unit_matrix - np.roll(unit_matrix, 1, 0) - np.roll(unit_matrix, -1, 0)
    smooth = np.linalg.inv(unit_matrix + 2 * laplacian)
    curve, curves = start, [start]
    mean = square = np.zeros((n, 3))
    for k in range(steps):
        moving = TensorXf64(curve)
        dr.enable_grad(moving)
        for view in (2 * k % 8, (2 * k + 5) % 8):
            goal = goals[view]
            difference = draw(moving, CAMERAS[view], len(goal), k) - TensorXf64(goal)
            dr.backward(dr.mean(dr.square(difference), axis=None))
        g = smooth @ dr.grad(moving).numpy()
        mean, square = 0.9 * mean + 0.1 * g, 0.99 * square + 0.01 * g * g
        unit = mean / (1 - 0.9 ** (k + 1)) / np.sqrt(square / (1 - 0.99 ** (k + 1)) + 1e-16)
        curve = curve - 0.04 * (1 - 0.9 * k / steps) * smooth @ unit
        curves.append(curve)
    return curves


def knot_determinant(curve: np.ndarray) -> int:
    """The determinant of the knot that a closed polygon (n, 3) is.

    Seen along z (after a turn, so that nothing lies behind itself), each crossing gives a row of
    the coloring matrix: twice the arc above, less the two arcs that end there below.
    """
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    start = curve @ turn
    along = np.roll(start, -1, axis=0) - start
    crossings: list[tuple[float, float]] = []  # where the curve passes below, and where above
    for i, (p, d) in enumerate(zip(start, along, strict=True)):
        gap, wide = start - p, d[0] * along[:, 1] - d[1] * along[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            s = (gap[:, 0] * along[:, 1] - gap[:, 1] * along[:, 0]) / wide
            t = (gap[:, 0] * d[1] - gap[:, 1] * d[0]) / wide
        apart = ~np.isin(np.arange(len(start)), np.array([i - 1, i, i + 1]) % len(start))
        is_below = p[2] + s * d[2] < start[:, 2] + t * along[:, 2]
        met = (s > 0) & (s < 1) & (t > 0) & (t < 1) & is_below & apart
        crossings += [(i + s[j], j + t[j]) for j in np.flatnonzero(met)]
    below, above = np.array(sorted(crossings)).reshape(-1, 2).T
    n = len(below)
    if n < 3:
        return 1
    rows = np.arange(n)
    matrix = np.zeros((n, n))
    np.add.at(matrix, (rows, rows), -1)
    np.add.at(matrix, (rows, (rows + 1) % n), -1)
    np.add.at(matrix, (rows, np.searchsorted(below, above) % n), 2)
    return round(abs(np.linalg.det(matrix[1:, 1:])))


def main(
    folder: Path, size: tuple[int, int] = (320, 240), steps: int = 100, n: int = 48
) -> tuple[int, float]:
    target = hk.geometry.example_curves.torus_knot(2, 3, n)
    target = 1.3 * target / np.abs(target).max()
    t = 2 * np.pi * np.arange(n)[:, None] / n
    bend = np.hstack([np.cos(t + 1), np.sin(2 * t), np.cos(4 * t + 2)])
    start = target * [0.85, 1.1, 0.7] + 0.15 * bend
    pixels = min(64, 2 * size[1])
    goals = [
        np.mean([draw(target, camera, pixels, s) for s in range(4)], 0).astype(float)
        for camera in CAMERAS
    ]
    curves = fit(start, goals, steps)
    look = {"show": "shaded", "boundary_radius": 0.04, "size": size}
    shown = [curves[0], curves[min(steps // 10, 10)], curves[-1], target]
    strip = [
        hk.render(
            hk.SolidAngle(curve),
            camera=hk.Camera(position=(2, -3, 3), target=(0, 0, 0), fov=40),
            **look,
        )
        for curve in shown
    ]
    Image.fromarray(np.hstack([picture.srgb[..., :3] for picture in strip])).save(
        folder / "fitted_knot.png"
    )
    steps_between = np.arange(40)[:, None] / 40
    fine = [
        p + steps_between * (q - p) for p, q in zip(target, np.roll(target, -1, 0), strict=True)
    ]
    away = cKDTree(np.concatenate(fine)).query(curves[-1])[0].mean()
    determinant, error = knot_determinant(curves[-1]), float(away / np.ptp(target, axis=0).max())
    print(f"determinant {determinant}; vertices are {100 * error:.2f} % of the size away")
    return determinant, error


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
