"""Pictures of docs/pictures.md with lines, scales and backdrops, and that of the cookbook:
`make images` makes them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import harnack as hk

# Those of the cookbook.
POINTS = [
    (1.2, 0.0, 0.3), (0.9, 0.8, -0.2), (0.2, 1.1, 0.4), (-0.5, 0.7, -0.3), (-1.2, 0.6, 0.2),
    (-0.9, -0.3, -0.1), (-1.0, -1.0, 0.4), (-0.1, -0.8, -0.3), (0.6, -1.1, 0.3), (0.8, -0.5, -0.4),
]  # fmt: skip


def main(folder: Path) -> None:
    """Draw all of them into a folder."""
    shaded: dict[str, Any] = {"show": "shaded", "size": (400, 300)}
    net = [
        hk.Isolines("z", interval=0.1, width=0.012),
        hk.Isolines(
            lambda x, y, z: (3 * x * x * y - y**3) / 2, interval=0.1, width=0.012, color="white"
        ),
    ]
    graph = hk.fields.HeightField(lambda x, y: (x**3 - 3 * x * y * y) / 2, domain=hk.Ball())
    hk.render(graph, folder / "view-conjugates.png", isolines=net, material="plastic", **shaded)
    trefoil = hk.SolidAngle(hk.geometry.example_curves.torus_knot(2, 3, 60))
    heights = hk.Isolines("z", interval=0.2, color="white")
    sky = ("white", "steelblue")
    hk.render(trefoil, folder / "view-heights.png", isolines=heights, backdrop=sky, **shaded)
    gyroid = hk.Gyroid(1.0, domain=hk.Ball(radius=1.0))
    walls = hk.Surface(gyroid, (-0.3, 0.3), side="between")
    scale: dict[str, Any] = {"size": (400, 300), "color_bar": True}
    hk.render(walls, folder / "view-value.png", show="value", color_by="z", **scale)
    hk.render(walls, folder / "view-evaluations.png", show="evaluations", **scale)
    smooth = hk.SolidAngle(hk.geometry.smooth_curve(POINTS))
    camera, size = hk.Camera(azimuth=25), (640, 480)
    hk.render(
        smooth,
        folder / "smooth.png",
        show="shaded",
        boundary_radius=0.02,
        size=size,
        camera=camera,
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
