"""How much of a mesh in tetrahedra is proved to have the topology of the level set.

Let f be the function less its level, F its interpolation at the corners of the tetrahedra, linear
on each, whose zero set are the triangles of `marching`, and H_t = (1-t) F + t f, 0 <= t <= 1.

Theorem. If each tetrahedron T satisfies (a) or (b), the zero sets of f and F are isotopic:
(a) neither f nor F has a zero in T, and both have the same sign there;
(b) grad f(x) . grad F|T > 0 for all x in T.

Proof. Let H_t(x) = 0 for some t. By (a), x is in tetrahedra of kind (b) alone. Put n = grad f(x),
which is not 0. H_t is Lipschitz, and Clarke's generalised gradient of it at x is the convex hull of
(1-t) grad F|T + t n over all T that hold x; each of these has a positive product with n. So 0 is not
in it: by Clarke's implicit function theorem the zero set of H in (x, t) is near there the graph of
a Lipschitz function over n's orthogonal plane and t. Vector fields n/(n.n), patched by a partition
of unity, still have positive products with all these gradients, and following them as t goes from
0 to 1 moves the zero set of F onto that of f (Thom's argument, for Lipschitz functions). On a wall
of the box, where the surface ends, x moves within the wall: there (b) is asked of the gradients'
projections onto it, for each face, edge or corner of a tetrahedron that lies in walls.

An angle. Where f's lift stays within half a period of the level on T, which is a part of the check
of (b), the wrapped values at the corners are that lift's, and all is as for a number.

The check. |grad f(y) - grad f(c)| <= D for all y in the ball around T with centre c and radius R,
by the field's own promise (`Field.slope_change`). So (b) holds if grad f(c) . grad F > D |grad F|,
and f has no zero in T if |f(c)| > (|grad f(c)| + D) R. If neither holds T is halved, across its
longest edge, a few times: grad F is the same in both halves, and (a) or (b) may hold in each.

Beside the curve nothing is proved. It is about the first triangles, before these are refined. Of
what follows, that the triangles do not meet (`intersections`) and face along the gradient is
checked, and not that they were moved without meeting on the way.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.points import Boundary, PointSet
from harnack.meshing.samples import LevelFunction
from harnack.meshing.tetrahedra import IntArray, Tetrahedra

__all__ = ["Isotopy", "isotopy_of"]

Walls = tuple[FloatArray, FloatArray] | None
_HALVINGS = 6
# What is far from the curve is farther than this many cells.
_FAR = 1.5


@dataclass(frozen=True)
class Isotopy:
    """Shares of the tetrahedra that may hold a point of the level set, or hold one of the mesh.

    proved: of all, those where (b) is proved. proved_far: of those farther than 1.5 cells from the
        curve. If `proved` is 1, mesh and level set are isotopic.
    count: how many there are.
    """

    proved: float
    proved_far: float
    count: int


def isotopy_of(
    function: LevelFunction,
    points: PointSet,
    tets: Tetrahedra,
    is_cut: BoolArray,
    boundary: Boundary,
    spacing: float,
    walls: Walls,
) -> Isotopy:
    """What is proved about the mesh of these tetrahedra.

    is_cut: (m,) whether a tetrahedron holds a point of the mesh.
    """
    corners = points.points[tets.corners]
    centre, radius = _balls(corners)
    open_ = np.flatnonzero(is_cut | (function.clearance(centre) <= radius * (1 + 1e-9)))
    corners, centre = corners[open_], centre[open_]
    values = points.samples.value[tets.corners[open_]]
    values[points.is_on[tets.corners[open_]]] = 0.0
    slope, is_sound = _slopes(corners, values)
    beside = (tets.corners[open_] < len(boundary.points)).any(axis=1)
    proved = is_sound & ~beside
    rows = np.flatnonzero(proved)
    proved[rows] = _regular(function, corners[rows], values[rows, 0], slope[rows], np.ones(3))
    if walls is not None:
        proved &= _regular_on_walls(function, corners, values, slope, proved, walls)
    far = np.ones(len(open_), np.bool_)
    if len(boundary.edges):
        far = _distances(centre, boundary) > _FAR * spacing
    return Isotopy(_share(proved), _share(proved[far]), len(open_))


def _share(proved: BoolArray) -> float:
    return float(proved.mean()) if len(proved) else 1.0


def _balls(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres (n, 3) and radii (n,) of balls around simplices (n, k, 3)."""
    centre = corners.mean(axis=1)
    return centre, np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)


def _slopes(corners: FloatArray, values: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Gradients (n, 3) of the linear functions on tetrahedra, and whether these are not flat and
    the gradients not 0."""
    sides = corners[:, 1:] - corners[:, :1]
    volume = np.linalg.det(sides)
    size = np.linalg.norm(sides, axis=2).max(axis=1)
    sound = np.abs(volume) > 1e-9 * size**3
    slope = np.zeros((len(corners), 3))
    rise = values[sound, 1:] - values[sound, :1]
    slope[sound] = np.linalg.solve(sides[sound], rise[..., None])[..., 0]
    return slope, sound & (np.abs(slope).max(axis=1) > 0)


def _regular(
    function: LevelFunction,
    corners: FloatArray,
    start: FloatArray,
    slope: FloatArray,
    free: FloatArray,
) -> BoolArray:
    """(n,) whether (a) or (b) is proved all over simplices (n, k, 3), by halving them.

    start: (n,) F at their first corners. slope: grad F. free: (3,) 1 for the coordinates in which
        walls let points move, else 0.
    """
    owner, first = np.arange(len(corners)), corners[:, 0]
    pieces, proved = corners, np.ones(len(corners), np.bool_)
    half_period = np.inf if function.period is None else 0.499 * function.period
    for halving in range(_HALVINGS + 1):
        if not len(pieces):
            break
        centre, radius = _balls(pieces)
        radius = radius * (1 + 1e-9)
        samples, change = function.slopes(centre, radius)
        along = slope[owner] * free
        steep = np.linalg.norm(samples.gradient, axis=1)
        moved = (steep + change) * radius
        rise = (samples.gradient * along).sum(axis=1)
        good = rise > change * np.linalg.norm(along, axis=1) * (1 + 1e-9)
        within = np.abs(samples.value) + moved < half_period
        linear = start[owner, None] + ((pieces - first[owner, None]) * slope[owner, None]).sum(2)
        sign = np.sign(samples.value)
        good |= (np.abs(samples.value) > moved) & (linear * sign[:, None] > 0).all(axis=1)
        if halving == 0:
            proved &= within
        bad = ~good & proved[owner]
        if halving == _HALVINGS or pieces.shape[1] == 1:
            proved[owner[bad]] = False
            break
        owner = np.concatenate([owner[bad], owner[bad]])
        pieces = _halved(pieces[bad])
    return proved


def _halved(pieces: FloatArray) -> FloatArray:
    """Simplices (2n, k, 3): both halves of each, cut at the middle of its longest edge."""
    pairs = list(itertools.combinations(range(pieces.shape[1]), 2))
    span = [np.linalg.norm(pieces[:, i] - pieces[:, j], axis=1) for i, j in pairs]
    i, j = np.array(pairs)[np.argmax(span, axis=0)].T if len(pieces) else (np.zeros(0, int),) * 2
    rows = np.arange(len(pieces))
    middle = 0.5 * (pieces[rows, i] + pieces[rows, j])
    one, other = pieces.copy(), pieces.copy()
    one[rows, j], other[rows, i] = middle, middle
    return np.concatenate([one, other])


def _regular_on_walls(
    function: LevelFunction,
    corners: FloatArray,
    values: FloatArray,
    slope: FloatArray,
    rows: BoolArray,
    walls: tuple[FloatArray, FloatArray],
) -> BoolArray:
    """(n,) whether (b) is proved for projections, on what of each tetrahedron lies in walls."""
    slack = 1e-9 * (walls[1] - walls[0])
    on = np.stack([np.abs(corners - wall) <= slack for wall in walls], axis=-1)  # (n, 4, 3, 2)
    proved = np.ones(len(corners), np.bool_)
    planes = list(itertools.product(range(3), range(2)))
    for count in (1, 2):  # in corners of the box no point moves, and there is nothing to ask
        for some in itertools.combinations(planes, count):
            axes = [axis for axis, _ in some]
            if len(set(axes)) < count:
                continue
            inside = np.all([on[:, :, axis, side] for axis, side in some], axis=0)
            free = np.ones(3)
            free[axes] = 0.0
            number = inside.sum(axis=1)
            for k in range(1, 4):
                chosen = np.flatnonzero((number == k) & rows)
                if not len(chosen):
                    continue
                which = np.argsort(~inside[chosen], axis=1, kind="stable")[:, :k]
                part = np.take_along_axis(corners[chosen], which[..., None], axis=1)
                start = np.take_along_axis(values[chosen], which[:, :1], axis=1)[:, 0]
                proved[chosen] &= _regular(function, part, start, slope[chosen], free)
    return proved


def _distances(points: FloatArray, boundary: Boundary) -> FloatArray:
    """(n,) from points to the curve, at most by half its longest edge too large."""
    import scipy.spatial  # here: half a second that few need

    a, b = (boundary.points[boundary.edges[:, k]] for k in (0, 1))
    share = np.linspace(0, 1, 9)[:, None, None]
    on: FloatArray = (a + share * (b - a)).reshape(-1, 3)
    tree = scipy.spatial.cKDTree(on)
    found: FloatArray = tree.query(points)[0]
    return found


_ = IntArray
