"""A field of your own, and its promise put to the test.

The potential of a charged wire is harmonic off the wire, and positive. That is all a field has to
promise: value, gradient, and the ball in which it is known to be so. `check_field` samples the
promise; of one that is wrong it says where. Steps of rays rest on it and on nothing else.
"""

import itertools
import math
import sys
from pathlib import Path

import harnack as hk  # isort: skip  # before Dr.Jit, so that it loads an LLVM that works
import drjit as dr


class Wires(hk.Field):
    """The sum of log((r_a + r_b + L)/(r_a + r_b - L)) over segments of length L from a to b."""

    default_level = 12.0
    domain = hk.Ball(radius=3.0)

    def __init__(self, segments):
        self.segments = segments

    def evaluate(self, p):
        value, gradient, error, radius = 0.0, type(p)(0.0), 0.0, math.inf
        for start, end in self.segments:
            a, b, length = p - type(p)(*start), p - type(p)(*end), math.dist(start, end)
            r_a, r_b = dr.norm(a), dr.norm(b)
            total = r_a + r_b
            value = value + dr.log((total + length) / (total - length))
            # Beside the segment total - L is a small difference, four roundings off.
            error = error + 4 * dr.epsilon(total) * total / (total - length)
            slope = -2 * length / (total * total - length * length)
            gradient = gradient + slope * (a / r_a + b / r_b)
            # By the triangle inequality total <= L + 2 times the distance of the segment.
            radius = dr.minimum(radius, 0.5 * (total - length))
        promises = (hk.proofs.HarmonicBall(radius, lower=0.0, upper=math.inf),)
        return hk.fields.Sample(value, gradient, promises, error)


def tetrahedron() -> Wires:
    corners = [(-0.9, -0.6, -0.4), (0.9, -0.6, -0.4), (0.0, 0.9, -0.4), (0.0, 0.0, 0.9)]
    return Wires(list(itertools.combinations(corners, 2)))


def main(folder: Path, size: tuple[int, int] = (640, 480)) -> float:
    wires = tetrahedron()
    hk.testing.check_field(wires)
    hk.render(wires, folder / "own_field.png", show="shaded", material="copper", size=size)
    hits = hk.trace(wires, [[0.05, 0.1, 3.0]], [[0.0, 0.0, -1.0]], precision="double")
    print(f"hit at z = {hits.position[0, 2]:.6f} after {hits.evaluations[0]} evaluations")
    return float(hits.position[0, 2])


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
