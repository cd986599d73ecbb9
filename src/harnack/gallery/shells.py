"""Scenes of the gallery: meshes whose faces are large nonplanar polygons, and grid shells (curved
roofs of crossing beams). Each function that returns a list of `Surface` makes the surfaces of a
scene. A "line" is a polyline, an array (k, 3) of points; the "ground" is the plane z = 0. Lines of
curvature are curves along a direction of largest or smallest curvature.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harnack.backend import FloatArray
from harnack.distance import Family, curvature_lines
from harnack.fields.solid_angles.polygon_mesh import PolygonMesh
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.fields.solids.tube import Tube, TubeNetwork
from harnack.gallery.scene import Scene
from harnack.geometry import Circle, HalfSpace, example_meshes
from harnack.geometry.polygon_meshes import cluster_into_polygons
from harnack.rendering import Camera
from harnack.tracer import Surface, TraceOptions

# Edges of faces lie inside the picture: hits within the tolerance of an edge have no normal.
_PATCH_OPTIONS = TraceOptions(tolerance=1e-5)


def _exoskeleton() -> list[Surface]:
    """Return a wavy torus of some 150 nonplanar polygons, and tubes around their edges."""
    # The two radii, and the numbers of segments the long way round and the short way.
    vertices, faces = example_meshes.torus_mesh(1.0, 0.45, 240, 108)
    angle = np.arctan2(vertices[:, 1], vertices[:, 0])
    # The center line of the torus goes up and down three times, and its tube is thicker and
    # thinner.
    ring = np.column_stack([np.cos(angle), np.sin(angle), 0.25 * np.sin(3 * angle)])
    across = vertices - np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    wavy = ring + across * (1 + 0.25 * np.cos(3 * angle))[:, None]
    # About 150 polygons, whose edges are smoothed twelve times; the tubes have the radius 0.011.
    mesh = PolygonMesh(*cluster_into_polygons(wavy, faces, 150, smoothing=12))
    tubes = TubeNetwork(mesh.vertices, mesh.edges, 0.011)
    return [Surface(mesh), Surface(tubes)]


def _patches() -> list[Surface]:
    """Return a bumpy sphere of 5,200 nonplanar polygons with some eleven corners each."""
    vertices, faces = example_meshes.bumpy_sphere(6)
    mesh = PolygonMesh(*cluster_into_polygons(vertices, faces, 5200))
    return [Surface(mesh)]


EXOSKELETONS = (
    Scene(
        "exoskeleton",
        "a surface through the net of curves on a torus, one level set a face (paper, Fig. 14)",
        _exoskeleton,
        ("eggshell", "gold"),
        Camera(elevation=42),
        show="shaded",
        options=_PATCH_OPTIONS,
        demo_spp=9,
    ),
    Scene(
        "patches",
        "5,200 polygons that are not flat, each a level set of its own",
        _patches,
        ("porcelain",),
        show="shaded",
        options=_PATCH_OPTIONS,
    ),
)


# Grid shells.

_FAMILIES: tuple[Family, Family] = ("maximum", "minimum")


@dataclass(frozen=True)
class GridShell:
    """A grid shell (a curved roof of crossing beams) over a region of the ground between an outline
    and round holes. Its surface is a level set of the solid angle of these curves, and its beams
    follow lines of curvature.

    After Fig. 17 of Gillespie et al. (2024), whose data are not public: outlines and holes are
    reconstructed. The level -2 pi + a leaves the ground at the angle a/2 everywhere. So the outline
    and the holes are lines of curvature themselves (Joachimsthal), and the lines of curvature of
    the other family (largest or smallest curvature) meet them at right angles.

    outline: (n, 2), counter-clockwise.
    holes: (x, y, radius) of each hole.
    angle: a in radians, twice the angle at which the shell leaves the ground.
    spacing: the distance of the beams along the outline and the holes, a length.
    thickness: the radius of the beams, a length.
    """

    outline: FloatArray
    holes: tuple[tuple[float, float, float], ...]
    angle: float
    spacing: float
    thickness: float

    def field(self) -> SolidAngle:
        """Return the solid angle of the outline and the holes, a function of space. The shell is
        its level set at `level`."""
        # The normals of the circles point down: holes run clockwise.
        corners = np.column_stack([self.outline, np.zeros(len(self.outline))])
        return SolidAngle([corners, *(Circle(r, (x, y, 0), (0, 0, -1)) for x, y, r in self.holes)])

    @property
    def level(self) -> float:
        """The value of the solid angle on the shell, -2 pi + `angle`."""
        return -2 * math.pi + self.angle

    def beams(self, field: SolidAngle) -> list[FloatArray]:
        """Find the center lines of all beams, each (k, 3). Returns the "ribs", which are lines of
        curvature from the outline and the holes across the shell; then lines of the other family,
        which cross the ribs; then the outline and the holes themselves.

        field: the solid angle.
        """
        above_ground = HalfSpace((0, 0, -1), 0.0)
        points, inward = self._boundary_points_and_normals()
        # The shell leaves the ground at half of `angle`.
        slope = 0.5 * self.angle
        upward = np.column_stack([math.cos(slope) * inward, np.full(len(points), math.sin(slope))])
        boundary_points = np.column_stack([points, np.zeros(len(points))])

        def lines(seeds: FloatArray) -> tuple[list[FloatArray], list[FloatArray]]:
            """Return the lines of curvature through the points `seeds` (n, 3), as two lists with a
            line for each seed: the lines along the largest curvature, and the lines along the
            smallest."""
            step = 0.25 * self.spacing
            maximum_lines, minimum_lines = (
                curvature_lines(field, seeds, step=step, length=100 * step, family=family,
                                level=self.level, clip=above_ground)
                for family in _FAMILIES
            )  # fmt: skip
            return maximum_lines, minimum_lines

        offset = 0.3 * self.spacing
        # Through each seed near the boundary there are two lines of curvature. The one that rises
        # from the boundary is chosen; the other runs along it.
        candidates = [
            max(both_families, key=lambda line: _relative_height(line, offset))
            for both_families in zip(*lines(boundary_points + offset * upward), strict=True)
        ]
        ribs = _drop_parallel_lines(candidates, 0.55 * self.spacing)
        # Seeds of the other family lie along about six of the ribs.
        spines = ribs[:: max(1, len(ribs) // 6)]
        # Every second point, and none near the ends.
        seeds = np.concatenate([spine[2:-2:2] for spine in spines])
        # Of the two lines through each seed, the one is chosen that crosses a rib more nearly at a
        # right angle.
        crossing_lines = [
            min(
                both_families,
                key=lambda line: min(_crossing_cosine(line, spine) for spine in spines),
            )
            for both_families in zip(*lines(seeds), strict=True)
        ]
        return [*ribs, *_drop_parallel_lines(crossing_lines, 0.55 * self.spacing), *self._edges()]

    def _boundary_points_and_normals(self) -> tuple[FloatArray, FloatArray]:
        """Return points (n, 2) on the outline and the holes, spaced by about `spacing`, and the
        unit normals (n, 2) there that point into the region. Both are in the plane of the
        ground."""
        points: list[FloatArray] = []
        inward: list[FloatArray] = []
        for a, b in zip(self.outline, np.roll(self.outline, -1, axis=0), strict=True):
            length = float(np.linalg.norm(b - a))
            count = max(1, round(length / self.spacing))
            fraction = (np.arange(count)[:, None] + 0.5) / count
            points.append(a + fraction * (b - a))
            # The outline is counter-clockwise, so the region is on the left of its edges.
            inward.append(np.tile(np.array([a[1] - b[1], b[0] - a[0]]) / length, (count, 1)))
        for x, y, r in self.holes:
            count = max(8, round(2 * math.pi * r / self.spacing))
            angle = 2 * math.pi * (np.arange(count) + 0.5) / count
            # The region is outside of the holes.
            outward = np.column_stack([np.cos(angle), np.sin(angle)])
            points.append(np.array([x, y]) + r * outward)
            inward.append(outward)
        return np.concatenate(points), np.concatenate(inward)

    def _edges(self) -> list[FloatArray]:
        """Return the outline and the holes as closed lines (k, 3) on the ground."""
        closed = np.concatenate([self.outline, self.outline[:1]])
        edges = [np.column_stack([closed, np.zeros(len(closed))])]
        for x, y, r in self.holes:
            ring = Circle(r, (x, y, 0.0)).polygon(32)
            edges.append(np.concatenate([ring, ring[:1]]))
        return edges


def _relative_height(line: FloatArray, reach: float) -> float:
    """Return the difference of the largest and smallest height of a line (k, 3), divided by the
    length `reach`; -1 for a line without points. The result is small for a line that runs along the
    boundary."""
    return float(line[:, 2].max() - line[:, 2].min()) / reach if len(line) else -1.0


def _crossing_cosine(line: FloatArray, other: FloatArray) -> float:
    """Return the absolute value of the cosine of the angle between two lines (k, 3), at their
    points that are nearest to each other: 0 for a right angle; 2 if a line has fewer than three
    points."""
    if min(len(line), len(other)) < 3:
        return 2.0
    distance = np.linalg.norm(line[:, None] - other[None], axis=2)
    i, j = np.unravel_index(int(distance.argmin()), distance.shape)
    # The tangents are taken from the points before and after; the ends have only one neighbor.
    i, j = min(max(int(i), 1), len(line) - 2), min(max(int(j), 1), len(other) - 2)
    a, b = line[i + 1] - line[i - 1], other[j + 1] - other[j - 1]
    return float(abs(a @ b) / (np.linalg.norm(a) * np.linalg.norm(b)))


def _drop_parallel_lines(lines: Sequence[FloatArray], gap: float) -> list[FloatArray]:
    """Return the lines (k, 3) that do not run along longer ones, longest first. A line is dropped
    if more than 60 % of its points are within the distance `gap` of the lines that are kept before
    it, or if it has fewer than three points. Of each line, every second point is returned, and its
    last."""
    kept: list[FloatArray] = []
    for line in sorted(lines, key=len, reverse=True):
        if len(line) < 3:
            continue
        if kept:
            points = np.concatenate(kept)
            nearest = np.linalg.norm(line[:, None] - points[None], axis=2).min(axis=1)
            if (nearest < gap).mean() > 0.6:
                continue
        kept.append(line)
    return [np.concatenate([line[:-1:2], line[-1:]]) for line in kept]


def _grid_shell_surfaces(shell: GridShell) -> list[Surface]:
    """Return a grid shell as two surfaces: the shell above the ground, and its beams as a solid."""
    field = shell.field()
    ground = HalfSpace((0, 0, -1), 0.0)
    beams = Tube.from_polylines(shell.beams(field), shell.thickness)
    return [
        Surface(field, shell.level, clip=ground),
        Surface(beams, 0.0, side="below"),
    ]


def _regular(sides: int) -> FloatArray:
    """Return the corners (sides, 2) of a regular polygon in the unit circle."""
    angle = 2 * math.pi * (np.arange(sides) + 0.5) / sides
    return np.column_stack([np.cos(angle), np.sin(angle)])


# The Great Court of the British Museum (Williams 2001), in units of half its width.
_HALF_WIDTH = 36.625
_COURT = np.array([(-36.625, -51.125), (36.625, -51.125), (36.625, 46.025), (-36.625, 46.025)])
_PAVILION = np.array(
    [(-1.6, -1), (0.2, -1.15), (1.7, -0.8), (1.9, 0.4), (0.6, 1.1), (-1.1, 1), (-1.9, 0.2)]
)
_COLUMNS = ((-1.1, -0.3), (0.0, -0.5), (1.1, -0.2), (0.9, 0.5), (-0.5, 0.4))

SHELLS = (
    Scene(
        "shell-ring",
        "a grid shell over a 12-gon with a round hole (after the paper's Fig. 17)",
        lambda: _grid_shell_surfaces(GridShell(_regular(12), ((0.0, 0.0, 0.4),), 1.4, 0.13, 0.006)),
        ("porcelain", "copper"),
        Camera(azimuth=-60, elevation=34),
        show="shaded",
    ),
    Scene(
        "shell-court",
        "a grid shell over the Great Court of the British Museum (after the paper's Fig. 17)",
        lambda: _grid_shell_surfaces(
            GridShell(_COURT / _HALF_WIDTH, ((0.0, 0.0, 22.245 / _HALF_WIDTH),), 1.2, 0.15, 0.008)
        ),
        ("porcelain", "copper"),
        Camera(azimuth=-60, elevation=34),
        show="shaded",
    ),
    Scene(
        "shell-columns",
        "a grid shell on five columns (after the paper's Fig. 17)",
        lambda: _grid_shell_surfaces(
            GridShell(_PAVILION, tuple((x, y, 0.13) for x, y in _COLUMNS), 1.2, 0.16, 0.008)
        ),
        ("porcelain", "copper"),
        Camera(azimuth=-60, elevation=38),
        show="shaded",
    ),
)
