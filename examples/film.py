"""A film of all surfaces that span one curve.

The levels of a curve's solid angle, from nearly 0 to nearly a whole turn, are surfaces that sweep
space around the curve and never leave it. Whatever is a function of s, which goes from 0 to 1,
moves. Only the first frame compiles anything.

Needs Pillow: `pip install 'harnack[film]'`.
"""

import sys
from pathlib import Path

import numpy as np

import harnack as hk


def main(folder: Path, size: tuple[int, int] = (320, 240), frames: int = 24) -> Path:
    curve = hk.SolidAngle(hk.geometry.example_curves.wavy_polygon(48))
    path = folder / "film.gif"
    hk.animate(
        curve,
        path,
        frames=frames,
        fps=12,
        orbit=90,
        level=lambda s: 2 * np.pi - 1.4 * np.pi * np.sin(2 * np.pi * s),
        camera=hk.Camera(elevation=20),
        size=size,
    )
    return path


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
