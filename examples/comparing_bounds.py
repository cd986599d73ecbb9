"""What a sharper proof is worth.

The same rays, the same surface, the same hits; what differs is the proof that steps rest on.
`enclosures=` chooses it: the rule of the paper, its refinements by the slope along the ray, and
what harnack takes by default. Work is counted in evaluations of the function, and the picture shows
it for each pixel.
"""

import sys
from pathlib import Path

import numpy as np

import harnack as hk


def main(folder: Path, size: tuple[int, int] = (640, 480)) -> dict[str, float]:
    field = hk.SolidAngle(hk.geometry.example_curves.wavy_polygon(64))
    hk.render(
        field, folder / "comparing_bounds.png", show="evaluations", enclosures="classic", size=size
    )
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, 60), np.linspace(-1.2, 1.2, 60))
    origins = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)])
    work, hit_counts = {}, set()
    for enclosures in ("classic", "slope", "caps", None):
        hits = hk.trace(field, origins, [[0.1, 0.2, -1.0]], enclosures=enclosures)
        work[enclosures or "default"] = float(hits.evaluations.mean())
        hit_counts.add(int((hits.status == hk.RayStatus.HIT).sum()))
    for name, evaluations in work.items():
        print(f"{name:8} {evaluations:6.1f} evaluations a ray")
    print(f"hits of each: {hit_counts}")
    return work


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
