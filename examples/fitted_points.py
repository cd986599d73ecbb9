"""Oriented points from twelve shaded pictures.

The surface is a level of the smoothed dipole potential of 500 points that start on a ball. Points,
normals and areas move together; steps are smooth over neighbors on that ball, which also keeps the
points apart. A step draws three of the twelve views.

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

SMOOTHING, LEVEL, RADIUS = 0.1, 2 * np.pi, 0.6


def directions(n: int) -> np.ndarray:
    """n unit vectors (n, 3), evenly over the sphere along a spiral."""
    k = np.arange(n) + 0.5
    z, angle = 1 - 2 * k / n, np.pi * (3 - 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z])


CAMERAS = [hk.Camera(position=d, target=(0, 0, 0), fov=36) for d in (4 * directions(12)).tolist()]


def surface(points, normals, areas) -> hk.Surface:
    return hk.Surface(hk.DipolePotential(points, normals, areas, smoothing=SMOOTHING), LEVEL)


def of_numbers(x: np.ndarray) -> hk.Surface:
    """The surface of rows (n, 7): point, normal and logarithm of the area."""
    return surface(x[:, :3], x[:, 3:6], np.exp(x[:, 6]))


def gradient(x: np.ndarray, goals: list[np.ndarray], views: list[int], seed: int) -> np.ndarray:
    """The gradient (n, 7) of the mean squared difference from some of the pictures."""
    parts = [TensorXf64(np.ascontiguousarray(p)) for p in (x[:, :3], x[:, 3:6], np.exp(x[:, 6]))]
    dr.enable_grad(parts)
    for j in views:
        shape = {"camera": CAMERAS[j], "size": len(goals[j]), "seed": seed}
        difference = hk.picture(surface(*parts), **shape) - TensorXf64(goals[j])
        dr.backward(dr.mean(dr.square(difference), axis=None))
    by_point, by_normal, by_area = (dr.grad(part).numpy() for part in parts)
    return np.column_stack([by_point, by_normal, by_area * np.exp(x[:, 6])])


def smoothing(points: np.ndarray) -> np.ndarray:
    """The matrix (1 + 0.3 L)^-1, where L is the Laplacian of the graph of six nearest neighbors."""
    n = len(points)
    joined = np.zeros((n, n))
    neighbors = cKDTree(points).query(points, 7)[1][:, 1:]
    joined[np.repeat(np.arange(n), 6), neighbors.ravel()] = 1
    joined = np.maximum(joined, joined.T)
    return np.linalg.inv(np.eye(n) + 0.3 * (np.diag(joined.sum(axis=1)) - joined))


def fit(goals: list[np.ndarray], n: int, steps: int) -> list[np.ndarray]:
    """The rows (n, 7) of all steps."""
    ball = directions(n)
    x = np.column_stack([RADIUS * ball, ball, np.full(n, np.log(4 * np.pi * RADIUS**2 / n))])
    smooth, path, rng = smoothing(ball), [x], np.random.default_rng(0)
    mean = square = np.zeros_like(x)
    for k in range(steps):
        views = rng.choice(len(goals), 3, replace=False).tolist()
        g = smooth @ gradient(x, goals, views, seed=k)
        mean, square = 0.9 * mean + 0.1 * g, 0.99 * square + 0.01 * g * g
        unit = mean / (1 - 0.9 ** (k + 1)) / np.sqrt(square / (1 - 0.99 ** (k + 1)) + 1e-16)
        x = x - 0.04 * (1 - 0.9 * k / steps) * smooth @ unit
        path.append(x)
    return path


def on_triangles(vertices: np.ndarray, faces: np.ndarray, count: int = 10_000) -> np.ndarray:
    """Random points (count, 3) of a mesh, evenly by area."""
    rng, corners = np.random.default_rng(0), vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    chosen = corners[rng.choice(len(faces), count, p=area / area.sum())]
    return (chosen * rng.dirichlet([1, 1, 1], count)[:, :, None]).sum(axis=1)


def chamfer(x: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> float:
    """The mean distance of the surface from a mesh, there and back, as a part of its size."""
    mesh = hk.mesh(of_numbers(x), tolerance=0.02)
    a = on_triangles(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    b = on_triangles(vertices, faces)
    there, back = cKDTree(b).query(a)[0].mean(), cKDTree(a).query(b)[0].mean()
    return float((there + back) / 2 / np.ptp(vertices, axis=0).max())


def main(
    folder: Path, size: tuple[int, int] = (240, 240), steps: int = 40, n: int = 500
) -> tuple[float, float]:
    vertices, faces = hk.geometry.example_meshes.bumpy_sphere(3)
    vertices = vertices / np.abs(vertices).max()
    target = hk.Surface(hk.WindingNumber(vertices, faces), 0.5)
    pixels = min(32, size[0] // 2)
    goals = [
        np.mean([hk.picture(target, camera=c, size=pixels, seed=s) for s in range(4)], 0)
        for c in CAMERAS
    ]
    path = fit([goal.astype(float) for goal in goals], n, steps)
    shown = [of_numbers(x) for x in (path[0], path[min(steps // 4, 10)], path[-1])]
    strip = [
        hk.render(drawn, show="shaded", size=size, camera=CAMERAS[3]) for drawn in (*shown, target)
    ]
    Image.fromarray(np.hstack([picture.srgb[..., :3] for picture in strip])).save(
        folder / "fitted_points.png"
    )
    before, after = (chamfer(x, vertices, faces) for x in (path[0], path[-1]))
    print(f"Chamfer distance {100 * before:.1f} % of the size before, {100 * after:.1f} % after")
    return before, after


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
