"""Numbers of shapes from pictures.

Five Gaussians from one shaded picture, a solid of five numbers from one picture of depths, and an
expansion in spherical harmonics from two pictures of normals. Each is a function from a vector of
numbers to a field, and the same gradient descent fits all of them: Adam, with one new seed a step.

The row of pictures needs Pillow, which is in `pip install 'harnack[film]'`.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import harnack as hk  # isort: skip; it has Dr.Jit load its LLVM

import drjit as dr
import numpy as np
from drjit.auto.ad import TensorXf64
from PIL import Image

Y = [hk.SphericalHarmonic(degree, m) for degree in (1, 2) for m in range(-degree, degree + 1)]


def blobs(x: Any) -> Any:
    """Centers, and all radii but the first. A scene that is twice as large and twice as far away
    looks the same, so one picture leaves one number open: here the first radius is known."""
    centers = [[x[3 * i + k] for k in range(3)] for i in range(5)]
    radii = [0.42 + 0 * x[0], *(x[15 + i] for i in range(4))]
    return hk.Surface(hk.Blobs(centers, radii), 0.5)


def part(x: Any) -> Any:
    """A box less a cylinder: three sides, the radius, and the place of its axis."""
    hole = hk.Cylinder(x[3], 3.0).translated((x[4], 0, 0))
    return hk.Surface(hk.Cuboid((x[0], x[1], x[2])) - hole)


def expansion(x: Any) -> Any:
    """The sum of x_k r^l Y_lm, in the unit ball."""
    return hk.Surface(hk.fields.FieldSum(Y, [x[k] for k in range(len(Y))]), 0.1)


def camera(*position: float) -> hk.Camera:
    return hk.Camera(position=position, target=(0, 0, 0), fov=40)


@dataclass(frozen=True)
class Fit:
    """make: from numbers to a surface. show: what the pictures show. rate: of Adam."""

    make: Callable[[Any], Any]
    show: Any
    cameras: list[hk.Camera]
    start: list[float]
    truth: list[float]
    rate: float = 0.03

    def draw(self, x: Any, view: hk.Camera, size: int, seed: int) -> Any:
        return hk.picture(self.make(x), camera=view, size=size, show=self.show, seed=seed)

    def run(self, size: int, steps: int) -> list[np.ndarray]:
        """The numbers of all steps."""
        x, truth = np.array(self.start), np.array(self.truth)
        goals = [
            np.mean([self.draw(truth.tolist(), view, size, s) for s in range(4)], 0).astype(float)
            for view in self.cameras
        ]
        mean = square = np.zeros_like(x)
        path = [x]
        for k in range(steps):
            moving = [TensorXf64([number]).array for number in x]
            dr.enable_grad(moving)
            for view, goal in zip(self.cameras, goals, strict=True):
                difference = self.draw(moving, view, size, k) - TensorXf64(goal)
                dr.backward(dr.mean(dr.square(difference), axis=None))
            g = np.array([dr.grad(number)[0] for number in moving])
            mean, square = 0.9 * mean + 0.1 * g, 0.99 * square + 0.01 * g * g
            unit = mean / (1 - 0.9 ** (k + 1)) / np.sqrt(square / (1 - 0.99 ** (k + 1)) + 1e-16)
            x = x - self.rate * (1 - 0.95 * k / steps) * unit  # smaller steps towards the end
            path.append(x)
        return path


CENTERS = [-0.55, 0, 0.3, 0.5, 0.1, 0.4, 0, -0.2, -0.1, -0.4, 0.1, -0.55, 0.6, -0.1, -0.45]
ASIDE = [0.1, 0.1, 0.1, -0.2, 0.1, 0, 0.15, 0.1, 0.1, -0.1, 0, 0.15, 0.1, 0.2, -0.1]
FITS = {
    "blobs": Fit(
        blobs, "shaded", [camera(0, -4, 1.2)],
        [*np.add(CENTERS, ASIDE), *4 * [0.4]], [*CENTERS, 0.36, 0.45, 0.33, 0.38],
    ),
    "part": Fit(
        part, "depth", [camera(1.6, -2.6, 1.8)],
        [1.0, 1.2, 1.0, 0.2, -0.1], [1.3, 1.0, 0.7, 0.3, 0.2],
    ),
    "expansion": Fit(
        expansion, "normals", [camera(1.6, -2.6, 1.8), camera(-1.6, 2.6, 0.8)],
        [0, 0, 1, 0, 0.3, 0, 0, 0], [0.3, 0.8, 0.4, 0.5, -0.6, 0.4, 0.7, -0.3], rate=0.05,
    ),
}  # fmt: skip


def main(folder: Path, size: tuple[int, int] = (240, 180), steps: int = 100) -> dict[str, float]:
    errors: dict[str, float] = {}
    rows: list[np.ndarray] = []
    for name, fit in FITS.items():
        path = fit.run(min(64, size[0] // 2), steps)
        errors[name] = float(np.abs(path[-1] - fit.truth).max())
        print(f"{name}: largest error of a number {errors[name]:.4f}")
        shown = [path[0], path[min(len(path) // 4, 10)], path[-1], np.array(fit.truth)]
        pictures = [
            hk.render(fit.make(x.tolist()), show="shaded", size=size, camera=fit.cameras[0])
            for x in shown
        ]
        rows.append(np.hstack([picture.srgb[..., :3] for picture in pictures]))
    Image.fromarray(np.vstack(rows)).save(folder / "fitted_shapes.png")
    return errors


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
