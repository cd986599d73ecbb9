"""A curve from three masks.

The surface that a closed curve spans is seen by three cameras, and nothing is known of it but where
it covers the picture. `hk.picture` draws it with derivatives by the vertices of the curve, outlines
included, so a few lines of gradient descent find the curve. Steps are made smooth along the curve:
else each vertex would run off by itself.

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

CAMERAS = [
    hk.Camera(position=place, target=(0, 0, 0), fov=40)
    for place in ((3.2, 0, 1.5), (-1.6, 2.8, 1.5), (0.5, -1.5, 3.2))
]


def draw(vertices, camera: hk.Camera, size: int, seed: int):
    field = hk.SolidAngle(vertices)
    return hk.picture(field, camera=camera, size=size, show="mask", seed=seed)


def gradient(vertices: np.ndarray, goals: list[np.ndarray], seed: int) -> np.ndarray:
    """The gradient (n, 3) of the mean squared difference from the masks, by the vertices."""
    moving = TensorXf64(vertices)
    dr.enable_grad(moving)
    for camera, goal in zip(CAMERAS, goals, strict=True):
        difference = draw(moving, camera, len(goal), seed) - TensorXf64(goal)
        dr.backward(dr.mean(dr.square(difference), axis=None))
    return dr.grad(moving).numpy()


def smoothing(n: int, amount: float) -> np.ndarray:
    """The matrix (1 + amount L)^-1, where L is the Laplacian of a closed chain of n vertices."""
    unit_matrix = np.eye(n)
    laplacian = 2 * unit_matrix - np.roll(unit_matrix, 1, 0) - np.roll(unit_matrix, -1, 0)
    return np.linalg.inv(unit_matrix + amount * laplacian)


def fit(start: np.ndarray, goals: list[np.ndarray], steps: int) -> list[np.ndarray]:
    """The curves of all steps, by Adam in coordinates in which smooth motions are short."""
    curve, smooth = start, smoothing(len(start), 2.0)
    mean = square = np.zeros_like(start)
    curves = [start]
    for k in range(steps):
        g = smooth @ gradient(curve, goals, seed=k)
        mean, square = 0.9 * mean + 0.1 * g, 0.99 * square + 0.01 * g * g
        unit = mean / (1 - 0.9 ** (k + 1)) / np.sqrt(square / (1 - 0.99 ** (k + 1)) + 1e-16)
        curve = curve - 0.03 * smooth @ unit
        curves.append(curve)
    return curves


def mean_distance(first: np.ndarray, second: np.ndarray) -> float:
    """The mean distance of two closed polygons, as a part of the size of the second."""
    part = np.arange(40)[:, None] / 40
    a, b = (
        np.concatenate([p + part * (q - p) for p, q in zip(c, np.roll(c, -1, 0), strict=True)])
        for c in (first, second)
    )
    both = cKDTree(a).query(b)[0].mean(), cKDTree(b).query(a)[0].mean()
    return float(max(both) / np.ptp(second, axis=0).max())


def main(folder: Path, size: tuple[int, int] = (320, 240), steps: int = 100, n: int = 32) -> float:
    t = 2 * np.pi * np.arange(n) / n
    radius = 1 + 0.25 * np.cos(3 * t)
    height = 0.35 * np.sin(2 * t) + 0.1 * np.cos(3 * t)
    target = np.column_stack([radius * np.cos(t), radius * np.sin(t), height])
    pixels = min(128, 2 * size[1])
    # Each mask is the mean of four, as that of a photograph is of many rays.
    goals = [np.mean([draw(target, c, pixels, s) for s in range(4)], 0) for c in CAMERAS]
    start = np.column_stack([np.cos(t), np.sin(t), 0 * t])
    curves = fit(start, [goal.astype(float) for goal in goals], steps)
    shown = [curves[0], curves[min(steps // 10, 20)], curves[-1], target]
    strip = [
        hk.render(
            hk.SolidAngle(curve), show="shaded", boundary_radius=0.03, size=size,
            camera=hk.Camera(position=(2.4, -2.4, 2.4), target=(0, 0, 0), fov=46),
        )
        for curve in shown
    ]  # fmt: skip
    Image.fromarray(np.hstack([picture.srgb[..., :3] for picture in strip])).save(
        folder / "fitted_curve.png"
    )
    error = mean_distance(curves[-1], target)
    print(f"{steps} steps: mean distance {100 * error:.2f} % of the size")
    return error


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
