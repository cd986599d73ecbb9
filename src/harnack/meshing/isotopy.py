"""How much of a mesh in tetrahedra is proved to have the topology of the level set.

Let f be the function minus its level, F its interpolation at the corners of the tetrahedra, linear
on each, whose zero set are the triangles of `marching_tetrahedra`, and H_t = (1-t) F + t f, 0 <= t
<= 1.

Theorem. If each tetrahedron T satisfies (a), (b) or (c), the zero sets of f and F are isotopic:
(a) neither f nor F has a zero in T, and both have the same sign there;
(b) grad f(x) . grad F|T > 0 for all x in T;
(c) each corner v of T has a vector n with n . grad F|S > 0 and n . grad f(x) > 0 for all x in S,
    for all S around v that do not satisfy (a).

Proof. Let H_t(x) = 0 for some t. By (a), x is in tetrahedra of kinds (b) and (c) alone. Some n has
n . grad f(x) > 0 and n . grad F|T > 0 for all T that hold x: if all are of kind (b), n = grad f(x);
else x lies in a simplex of one of kind (c), all corners of which have such an n, and all T that
hold x are around each of them. H_t is Lipschitz, and Clarke's generalized gradient of it at x is
the convex hull of (1-t) grad F|T + t grad f(x) over these T: it does not hold 0. By Clarke's
implicit function theorem the zero set of H in (x, t) is near there the graph of a Lipschitz
function over n's orthogonal plane and t. The fields n/(n . n), patched by a partition of unity,
still have positive products with all these gradients, and following them as t goes from 0 to 1
moves the zero set of F onto that of f (Thom's argument, for Lipschitz functions). On a wall of the
box, where the surface ends, x moves within the wall: there (b) is required of the gradients'
projections onto it, for each face, edge or corner of a tetrahedron that lies in walls.

Four corners on the level. F is 0 on such a T, and `marching_tetrahedra` gives all of it to one
side. If two of its faces are in the mesh, put F = +-epsilon at the middle of the edge that the
other two share: T becomes two tetrahedra, on each of which grad F is a normal of one of those
faces, F elsewhere changes by no more than epsilon, which (b) and (c) bear as they are strict, and
the zero set is the mesh. So (b) and (c) are required of both normals. Other such T are not proved.

An angle. Where f's lift stays within half a period of the level on T, which is a part of the check
of (b), the wrapped values at the corners are that lift's, and all is as for a number.

The check. |grad f(y) - grad f(c)| <= D for all y in the ball around T with center c and radius R,
by the field's own promise (`Field.gradient_change_bound`). So (b) holds if grad f(c) . grad F > D
|grad F|, and f has no zero in T if |f(c)| > (|grad f(c)| + D) R. If neither holds T is halved,
across its longest edge, a few times: grad F is the same in both halves, and (a) or (b) may hold in
each.

Near the curve nothing is proved. The proof is about the first triangles, before they are refined.
The refined triangles are checked not to meet (`checks.intersecting_faces`) and to face along the
gradient; it is not checked that they were moved without meeting on the way.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.delaunay_points import BoundaryCurve, TetrahedronPoints
from harnack.meshing.edges import IntArray
from harnack.meshing.level_function import LevelFunction

__all__ = ["IsotopyCoverage", "isotopy_of"]

Walls = tuple[FloatArray, FloatArray] | None
_HALVINGS = 5
_TRIALS = 20
_UNKNOWN = 1e200
# The number of tetrahedra that are examined before all are.
_FIRST_EXAMINED = 100
# The distance, in cells, beyond which tetrahedra are far from the curve.
_FAR_FROM_CURVE = 1.5


@dataclass(frozen=True)
class IsotopyCoverage:
    """The fractions of tetrahedra, among those that may hold a point of the level set or hold a
    point of the mesh, on which the topology is proved.

    proved: the fraction of all where (a), (b) or (c) is proved. If it is 1, mesh and level set are
        isotopic.
    proved_off_curve: the fraction of those farther than 1.5 cells from the curve.
    count: the number of tetrahedra; for fields that do not bound the changes of their gradient only
        of those that hold a point of the mesh.
    unproved_off_curve: (k, 4) the corners of those farther than 1.5 cells from the curve where
        nothing is proved.
    """

    proved: float
    proved_off_curve: float
    count: int
    unproved_off_curve: IntArray

    def shares(self) -> dict[str, float]:
        """The fractions, for the metadata of a mesh."""
        return {"isotopy": self.proved, "isotopy_far": self.proved_off_curve}


def isotopy_of(
    function: LevelFunction,
    points: TetrahedronPoints,
    tetrahedra: IntArray,
    is_cut: BoolArray,
    faces: IntArray,
    boundary: BoundaryCurve,
    spacing: float,
    walls: Walls,
) -> IsotopyCoverage:
    """The tetrahedra on which the topology of their mesh is proved; tetrahedra: (m, 4) corners.

    is_cut: (m,) whether a tetrahedron holds a point of the mesh. faces: (k, 3) of the mesh, whose
        first vertices are the points.
    """
    corners = points.points[tetrahedra]
    if not _has_bounds(function, corners[is_cut]):
        return IsotopyCoverage(0.0, 0.0, int(is_cut.sum()), tetrahedra[is_cut])
    uncut = np.flatnonzero(~is_cut)
    holds = is_cut.copy()
    holds[uncut[~_proved_empty(function, corners[uncut])]] = True
    index, corners = tetrahedra[holds], corners[holds]
    values = points.samples.value[index]
    values[points.is_on_level[index]] = 0.0
    slopes = _slopes_on(function, corners, index, values, faces)
    beside = (index < len(boundary.points)).any(axis=1)
    proved = np.bincount(slopes.owner, minlength=len(index)) > 0
    proved &= ~beside
    rows = np.flatnonzero(proved[slopes.owner])
    is_regular = _proved_regular(
        function, corners[slopes.owner[rows]], values[slopes.owner[rows], 0],
        slopes.slope[rows], np.ones(3),
    )  # fmt: skip
    proved[slopes.owner[rows[~is_regular]]] = False
    on_walls = np.ones(len(index), np.bool_)
    if walls is not None:
        on_walls = _regular_on_walls(function, corners, values, slopes, proved, walls)
    far = np.ones(len(index), np.bool_)
    if len(boundary.edges):
        far = _distances(corners.mean(axis=1), boundary) > _FAR_FROM_CURVE * spacing
    stars = ~proved & ~beside & far
    proved[stars] = _proved_by_stars(function, corners, index, slopes, np.flatnonzero(stars))
    proved &= on_walls
    return IsotopyCoverage(
        _proved_fraction(proved), _proved_fraction(proved[far]), len(index), index[far & ~proved]
    )


def _has_bounds(function: LevelFunction, corners: FloatArray) -> bool:
    """Whether changes of the gradient are bounded on any of a selection of tetrahedra (n, 4, 3); if
    not, all cut tetrahedra stay unproved, and no others need to be examined."""
    sampled = corners[:: max(1, len(corners) // _FIRST_EXAMINED)]
    center, radius = _balls(sampled)
    return not len(sampled) or bool((function.gradient_bounds(center, radius)[1] < _UNKNOWN).any())


def _proved_fraction(proved: BoolArray) -> float:
    return float(proved.mean()) if len(proved) else 1.0


def _balls(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centers (n, 3) and radii (n,) of balls around simplices (n, k, 3)."""
    center = corners.mean(axis=1)
    return center, np.linalg.norm(corners - center[:, None], axis=2).max(axis=1)


@dataclass(frozen=True)
class _LinearGradients:
    """Gradients of F, slope (k, 3), on the tetrahedra owner (k,): each has one gradient, or two, or
    none."""

    owner: IntArray
    slope: FloatArray


def _slopes_on(
    function: LevelFunction,
    corners: FloatArray,
    index: IntArray,
    values: FloatArray,
    faces: IntArray,
) -> _LinearGradients:
    """The gradients on tetrahedra with corners (m, 4, 3), their indices (m, 4) and values (m, 4):
    none for flat tetrahedra, two for those with four corners on the level and two faces in the
    mesh."""
    sides = corners[:, 1:] - corners[:, :1]
    size = np.linalg.norm(sides, axis=2).max(axis=1)
    sound = np.abs(np.linalg.det(sides)) > 1e-9 * size**3
    flat = (values == 0).all(axis=1)
    rows = np.flatnonzero(sound & ~flat)
    rise = values[rows, 1:] - values[rows, :1]
    slope: FloatArray = np.linalg.solve(sides[rows], rise[..., None])[..., 0].astype(np.float64)
    owners, slopes = [rows], [slope]
    rows = np.flatnonzero(sound & flat)
    count = int(index.max(initial=0)) + 1
    keys = _triple_keys(faces[(faces < count).all(axis=1)], count)
    triples = np.array([np.delete(np.arange(4), k) for k in range(4)])
    in_mesh = np.stack(
        [np.isin(_triple_keys(index[rows][:, triple], count), keys) for triple in triples], axis=1
    )
    sign = np.sign(function.values(corners[rows].mean(axis=1)))
    pair = in_mesh.sum(axis=1) == 2
    for k, triple in enumerate(triples):
        chosen = np.flatnonzero(pair & in_mesh[:, k])
        a, b, c = (corners[rows[chosen], corner] for corner in triple)
        normal = np.cross(b - a, c - a)
        inward = ((corners[rows[chosen], k] - a) * normal).sum(axis=1)
        owners.append(rows[chosen])
        slopes.append(normal * (np.sign(inward) * sign[chosen])[:, None])
    return _LinearGradients(np.concatenate(owners), np.concatenate(slopes))


def _triple_keys(triples: IntArray, count: int) -> IntArray:
    """A number for each triple (k, 3) of fewer than two million points, the same for any order."""
    a, b, c = np.sort(triples, axis=1).T
    keys: IntArray = (a * count + b) * count + c
    return keys


def _proved_by_stars(
    function: LevelFunction,
    corners: FloatArray,
    index: IntArray,
    slopes: _LinearGradients,
    rows: IntArray,
) -> BoolArray:
    """(k,) whether (c) is proved for tetrahedra `rows` (k,).

    n is computed as by a perceptron: starting with the sum of all unit gradients of F around a
    corner, gradients whose product with n is not positive are added again, a few times.
    """
    vertices = np.unique(index[rows])
    number = np.full(int(index.max(initial=0)) + 1, -1, np.int64)
    number[vertices] = np.arange(len(vertices))
    # Pairs of a corner and a tetrahedron around it; then pairs of a corner and a gradient there.
    tet, corner = np.nonzero(number[index] >= 0)
    star = number[index[tet, corner]]
    entry, column = np.nonzero(number[index[slopes.owner]] >= 0)
    vertex = number[index[slopes.owner[entry], column]]
    units = slopes.slope[entry]
    units = units / np.maximum(np.linalg.norm(units, axis=1), 1e-300)[:, None]
    n = np.zeros((len(vertices), 3))
    np.add.at(n, vertex, units)
    for _ in range(_TRIALS):
        short = (n[vertex] * units).sum(axis=1) <= 0
        if not short.any():
            break
        np.add.at(n, vertex[short], units[short])
    is_proved = np.ones(len(vertices), np.bool_)
    is_proved[vertex[(n[vertex] * units).sum(axis=1) <= 1e-9]] = False
    has_slope = np.bincount(slopes.owner, minlength=len(index)) > 0
    is_proved[star[~has_slope[tet]]] = False
    tried = np.flatnonzero(is_proved[star])
    start = np.zeros(len(tried))
    fine = _proved_regular(function, corners[tet[tried]], start, n[star[tried]], np.ones(3))
    is_proved[star[tried[~fine]]] = False
    return np.asarray(is_proved[number[index[rows]]].all(axis=1), np.bool_)


def _proved_empty(function: LevelFunction, corners: FloatArray) -> BoolArray:
    """(n,) whether f is proved to have no zero in tetrahedra (n, 4, 3), by halving them. As F has
    none and f has no net crossing of a level on their edges, both are between the same two levels:
    (a)."""
    owner, pieces = np.arange(len(corners)), corners
    for _ in range(_HALVINGS + 1):
        center, radius = _balls(pieces)
        undecided = function.clearance(center) <= radius * (1 + 1e-9)
        owner = np.concatenate([owner[undecided], owner[undecided]])
        pieces = _halve_simplices(pieces[undecided])
        if not len(pieces):
            break
    free = np.ones(len(corners), np.bool_)
    free[owner] = False
    return free


def _proved_regular(
    function: LevelFunction,
    corners: FloatArray,
    start: FloatArray,
    slope: FloatArray,
    free: FloatArray,
) -> BoolArray:
    """(n,) whether (a) or (b) is proved on all of simplices (n, k, 3), by halving them.

    start: (n,) F at their first corners. slope: grad F. free: (3,) 1 for the coordinates in which
        walls let points move, else 0.
    """
    owner, first = np.arange(len(corners)), corners[:, 0]
    pieces, proved = corners, np.ones(len(corners), np.bool_)
    half_period = np.inf if function.period is None else 0.499 * function.period
    for halving in range(_HALVINGS + 1):
        if not len(pieces):
            break
        center, radius = _balls(pieces)
        radius = radius * (1 + 1e-9)
        samples, change = function.gradient_bounds(center, radius)
        change = np.minimum(change, _UNKNOWN)
        if (change == _UNKNOWN).all():
            proved[owner] = False
            break
        along = slope[owner] * free
        steep = np.linalg.norm(samples.gradient, axis=1)
        moved = (steep + change) * radius
        rise = (samples.gradient * along).sum(axis=1)
        is_regular = rise > change * np.linalg.norm(along, axis=1) * (1 + 1e-9)
        within = np.abs(samples.value) + moved < half_period
        linear = start[owner, None] + ((pieces - first[owner, None]) * slope[owner, None]).sum(2)
        sign = np.sign(samples.value)
        is_regular |= (np.abs(samples.value) > moved) & (linear * sign[:, None] > 0).all(axis=1)
        if halving == 0:
            proved &= within
        undecided = ~is_regular & proved[owner]
        if halving == _HALVINGS or pieces.shape[1] == 1:
            proved[owner[undecided]] = False
            break
        owner = np.concatenate([owner[undecided], owner[undecided]])
        pieces = _halve_simplices(pieces[undecided])
    return proved


def _halve_simplices(pieces: FloatArray) -> FloatArray:
    """Simplices (2n, k, 3): both halves of each, cut at the middle of its longest edge."""
    pairs = list(itertools.combinations(range(pieces.shape[1]), 2))
    span = [np.linalg.norm(pieces[:, i] - pieces[:, j], axis=1) for i, j in pairs]
    i, j = np.array(pairs)[np.argmax(span, axis=0)].T if len(pieces) else (np.zeros(0, int),) * 2
    rows = np.arange(len(pieces))
    middle = 0.5 * (pieces[rows, i] + pieces[rows, j])
    first, second = pieces.copy(), pieces.copy()
    first[rows, j], second[rows, i] = middle, middle
    return np.concatenate([first, second])


def _regular_on_walls(
    function: LevelFunction,
    corners: FloatArray,
    values: FloatArray,
    slopes: _LinearGradients,
    rows: BoolArray,
    walls: tuple[FloatArray, FloatArray],
) -> BoolArray:
    """(n,) whether (b) is proved for projections, on the faces, edges and corners of tetrahedra
    `rows` (n,) that lie in walls; True for other tetrahedra without a corner there."""
    margin = 1e-9 * (walls[1] - walls[0])
    on = np.stack([np.abs(corners - wall) <= margin for wall in walls], axis=-1)  # (n, 4, 3, 2)
    proved = rows | ~on.any(axis=(1, 2, 3))
    planes = list(itertools.product(range(3), range(2)))
    for count in (1, 2):  # in corners of the box no point moves, and nothing is required
        for chosen in itertools.combinations(planes, count):
            axes = [axis for axis, _ in chosen]
            if len(set(axes)) < count:
                continue
            inside = np.all([on[:, :, axis, side] for axis, side in chosen], axis=0)
            free = np.ones(3)
            free[axes] = 0.0
            number = inside.sum(axis=1)
            for k in range(1, 4):
                entry = np.flatnonzero(((number == k) & rows)[slopes.owner])
                if not len(entry):
                    continue
                owner = slopes.owner[entry]
                which = np.argsort(~inside[owner], axis=1, kind="stable")[:, :k]
                part = np.take_along_axis(corners[owner], which[..., None], axis=1)
                start = np.take_along_axis(values[owner], which[:, :1], axis=1)[:, 0]
                is_regular = _proved_regular(function, part, start, slopes.slope[entry], free)
                proved[owner[~is_regular]] = False
    return proved


def _distances(points: FloatArray, boundary: BoundaryCurve) -> FloatArray:
    """(n,) the distances of points from the curve, too large by at most half of its longest
    edge."""
    import scipy.spatial  # imported here: it takes half a second

    searching: Any = scipy.spatial
    a, b = (boundary.points[boundary.edges[:, k]] for k in (0, 1))
    fraction = np.linspace(0, 1, 9)[:, None, None]
    on: FloatArray = (a + fraction * (b - a)).reshape(-1, 3)
    distances: FloatArray = searching.cKDTree(on).query(points)[0]
    return distances
