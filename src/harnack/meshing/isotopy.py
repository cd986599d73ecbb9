"""Proves on which tetrahedra a mesh has the topology of the level set {f = 0}. Here f is the field
minus its level, and the mesh is made by marching tetrahedra: it consists of the triangles in which
F = 0, where F is the function that is linear on each tetrahedron and equals f at its corners. Two
surfaces are isotopic if one can be deformed into the other without tearing or crossing. The curve
is the boundary curve at which the level set ends; walls are the faces of the box in which it is
meshed, if it may end there.

Let H_t = (1-t) F + t f for 0 <= t <= 1. F|T is F on the tetrahedron T, so grad F|T is a constant
vector.

Theorem. If each tetrahedron T satisfies (a), (b) or (c), the zero sets of f and F are isotopic:
(a) neither f nor F has a zero in T, and both have the same sign there;
(b) grad f(x) . grad F|T > 0 for all x in T;
(c) each corner v of T has a vector n with n . grad F|S > 0 and n . grad f(x) > 0 for all x in S,
    for all tetrahedra S around v that do not satisfy (a).

Proof. Let H_t(x) = 0 for some t. Then x lies in no tetrahedron of kind (a). We show that there is a
vector n with n . grad f(x) > 0 and n . grad F|T > 0 for all T that contain x. If all of these are
of kind (b), it is n = grad f(x). Otherwise x lies in a tetrahedron of kind (c), and so in the
relative interior of a simplex (a face, an edge or a corner of it, or all of it). Each corner of
this simplex has such an n, and all T that contain x are around each of these corners. H_t is
Lipschitz, and its generalized gradient by Clarke at x is the convex hull of (1-t) grad F|T + t grad
f(x) over these T. It does not contain 0, because all of its elements have positive products with n.
By Clarke's implicit function theorem the zero set of H in (x, t) is near there the graph of a
Lipschitz function over t and the plane orthogonal to n. The vector fields n/(n . n), patched by a
partition of unity, still have positive products with all these gradients. Following them as t goes
from 0 to 1 moves the zero set of F onto the zero set of f (Thom's argument, for Lipschitz
functions). On a wall, x moves within the wall. So for each face, edge or corner of a tetrahedron
that lies in walls, (b) is also required of the projections of the gradients onto these walls.

Four corners on the level set. F is 0 on such a T, and `marching_tetrahedra` gives all of T to one
side of the level set. If two of the faces of T are in the mesh, set F to +epsilon or -epsilon at
the middle of the edge that the other two faces share. Then T becomes two tetrahedra, and on each of
them grad F is a normal of one of the two faces in the mesh. Elsewhere F changes by no more than
epsilon, which (b) and (c) allow as they are strict inequalities, and the zero set is the mesh. So
(b) and (c) are required of both normals. If T has another number of faces in the mesh, nothing is
proved on it.

Angles. The lift of an angle-valued f is a continuous real-valued function that equals f modulo the
period. The check of (b) includes that the lift stays within half a period of the level on T. Then
the wrapped values at the corners are the values of this lift, and all is as for real values.

The check. The field proves a bound D (`Field.gradient_change_bound`): |grad f(y) - grad f(c)| <= D
for all y in the ball around T with center c and radius R. So (b) holds if grad f(c) . grad F > D
|grad F|, and f has no zero in T if |f(c)| > (|grad f(c)| + D) R. If neither holds, T is halved at
its longest edge, a few times: grad F is the same in both halves, and (a) or (b) may hold in each.

Near the curve nothing is proved. The proof is about the first triangles, before they are refined.
It is checked that the refined triangles do not meet (`self_intersection.intersecting_faces`) and
that they face along the gradient. It is not checked that they were moved without meeting on the
way.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.neighborhoods import kd_tree
from harnack.meshing.delaunay_points import BoundaryCurve, TetrahedronPoints
from harnack.meshing.level_function import LevelFunction

__all__ = ["IsotopyCoverage", "isotopy_of"]

Walls = tuple[FloatArray, FloatArray] | None
_HALVINGS = 5
_MAX_PERCEPTRON_ROUNDS = 20
_NO_BOUND = 1e200
# The number of tetrahedra on which it is tried first whether the gradient's change is bounded.
_MAX_TRIED = 100
# The distance, in cells, beyond which tetrahedra are far from the curve.
_FAR_FROM_CURVE = 1.5


@dataclass(frozen=True)
class IsotopyCoverage:
    """On which fraction of the tetrahedra a mesh is proved to have the topology of the level set.
    Only tetrahedra count that may hold a point of the level set, or that hold a point of the mesh.

    proved: the fraction of these tetrahedra on which condition (a), (b) or (c) of the module's
        theorem is proved. If it is 1, the mesh and the level set are isotopic (one can be deformed
        into the other).
    proved_off_curve: the same fraction among the tetrahedra farther than 1.5 cells from the
        boundary curve.
    count: the number of these tetrahedra. For fields that do not bound the change of their gradient
        only tetrahedra that hold a point of the mesh are counted.
    unproved_off_curve: (k, 4) the corners of the tetrahedra farther than 1.5 cells from the curve
        on which nothing is proved.
    """

    proved: float
    proved_off_curve: float
    count: int
    unproved_off_curve: IntArray

    def shares(self) -> dict[str, float]:
        """The fractions `proved` and `proved_off_curve`, by the names that they have in the
        metadata of a mesh."""
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
    """Find out on which tetrahedra a mesh is proved to have the topology of the level set {f = 0}.

    function: f.
    points: the corners of the tetrahedra, with samples of f.
    tetrahedra: (m, 4) for each tetrahedron, the indices of its corners.
    is_cut: (m,) whether a tetrahedron holds a point of the mesh.
    faces: (k, 3) the triangles of the mesh; its first vertices are the points of the tetrahedra.
    boundary: the curve at which the level set ends.
    spacing: the size of cells, a length.
    walls: the lower and the upper corner (3,) of the box, on whose faces the surface may end; None
        if it does not end there.
    """
    corners = points.points[tetrahedra]
    if not _has_bounds(function, corners[is_cut]):  # nothing is proved, anywhere
        return IsotopyCoverage(0.0, 0.0, int(is_cut.sum()), tetrahedra[is_cut])
    # Tetrahedra that count: those that the mesh meets, and those not proved to satisfy (a).
    uncut = np.flatnonzero(~is_cut)
    is_counted = is_cut.copy()
    is_counted[uncut[~_proved_empty(function, corners[uncut])]] = True
    index, corners = tetrahedra[is_counted], corners[is_counted]
    values = points.samples.value[index]
    values[points.is_on_level[index]] = 0.0
    slopes = _linear_gradients(function, corners, index, values, faces)
    has_curve_point = (index < len(boundary.points)).any(axis=1)
    # A gradient of F is needed; then (a) or (b), for all of its gradients.
    proved = np.bincount(slopes.owner, minlength=len(index)) > 0
    proved &= ~has_curve_point
    rows = np.flatnonzero(proved[slopes.owner])
    # With F at the first corners, and its gradient; points may move along all axes (ones).
    is_regular = _proved_regular(
        function, corners[slopes.owner[rows]], values[slopes.owner[rows], 0],
        slopes.slope[rows], np.ones(3),
    )  # fmt: skip
    proved[slopes.owner[rows[~is_regular]]] = False
    # The requirement on walls, of (b) only.
    on_walls = np.ones(len(index), np.bool_)
    if walls is not None:
        on_walls = _regular_on_walls(function, corners, values, slopes, proved, walls)
    is_far = np.ones(len(index), np.bool_)
    if len(boundary.edges):
        is_far = _distances(corners.mean(axis=1), boundary) > _FAR_FROM_CURVE * spacing
    needs_condition_c = ~proved & ~has_curve_point & is_far
    # Condition (c) for the tetrahedra on which neither was proved.
    proved[needs_condition_c] = _proved_by_stars(
        function, corners, index, slopes, np.flatnonzero(needs_condition_c)
    )
    proved &= on_walls
    return IsotopyCoverage(
        _share(proved), _share(proved[is_far]), len(index), index[is_far & ~proved]
    )


def _has_bounds(function: LevelFunction, corners: FloatArray) -> bool:
    """Whether the field gives a finite bound of the change of its gradient, so that something can
    be proved. About a hundred of the tetrahedra with corners (n, 4, 3) are tried; it is enough that
    one has a bound.

    function: f - level for a field f; it is 0 on the level set.
    """
    tried = corners[:: max(1, len(corners) // _MAX_TRIED)]
    center, radius = _balls(tried)
    # [1]: the bounds, after the samples.
    return not len(tried) or bool((function.gradient_bounds(center, radius)[1] < _NO_BOUND).any())


def _share(proved: BoolArray) -> float:
    """The fraction of True entries of a mask; 1 for an empty mask."""
    return float(proved.mean()) if len(proved) else 1.0


def _balls(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Balls that contain simplices with corners (n, k, 3). Returns their centers (n, 3), which are
    the means of the corners, and their radii (n,)."""
    center = corners.mean(axis=1)
    return center, np.linalg.norm(corners - center[:, None], axis=2).max(axis=1)


@dataclass(frozen=True)
class _LinearGradients:
    """The gradients, on tetrahedra, of the function F that is linear on each tetrahedron and equals
    f at the corners. A tetrahedron with all corners on the level set has two gradients or none (see
    the module); any other one has one, or none if it has no volume.

    owner: (k,) for each gradient, the index of its tetrahedron.
    slope: (k, 3) the gradients.
    """

    owner: IntArray
    slope: FloatArray


def _linear_gradients(
    function: LevelFunction,
    corners: FloatArray,
    index: IntArray,
    values: FloatArray,
    faces: IntArray,
) -> _LinearGradients:
    """Compute the gradients of F on m tetrahedra, where F is linear on each tetrahedron and has the
    values `values` (m, 4) at its corners.

    A tetrahedron without a volume has no gradient. If all four corners are on the level set, F is 0
    there. Then, if exactly two of its faces are in the mesh, F is changed a little inside of it, so
    that it has two gradients, which are normals of these two faces (see "Four corners on the level
    set" in the module). Otherwise it has no gradient.

    function: f.
    corners, index: (m, 4, 3), (m, 4) the corners of the tetrahedra and the indices of these points.
    faces: (j, 3) the triangles of the mesh. In them a corner of a tetrahedron has the same index as
        in `index`; the mesh's other vertices have larger indices.

    Where F is not 0, the result is grad F. Where it was changed, only the direction is right.
    """
    edges = corners[:, 1:] - corners[:, :1]
    size = np.linalg.norm(edges, axis=2).max(axis=1)
    # By more than rounding.
    has_volume = np.abs(np.linalg.det(edges)) > 1e-9 * size**3
    # At points on the level set F is exactly 0.
    on_level = (values == 0).all(axis=1)
    rows = np.flatnonzero(has_volume & ~on_level)
    # With d the edges from the first corner, grad F . d is the difference of the values at their
    # ends.
    rise = values[rows, 1:] - values[rows, :1]
    slope: FloatArray = np.linalg.solve(edges[rows], rise[..., None])[..., 0].astype(np.float64)
    owners, slopes = [rows], [slope]
    # From here on, the tetrahedra whose four corners are on the level set.
    rows = np.flatnonzero(has_volume & on_level)
    point_count = int(index.max(initial=0)) + 1
    # Only triangles of the mesh whose vertices are all corners of tetrahedra can be their faces.
    mesh_keys = _triple_keys(faces[(faces < point_count).all(axis=1)], point_count)
    faces_of_tetrahedron = np.array([np.delete(np.arange(4), k) for k in range(4)])
    in_mesh = np.stack(
        [
            np.isin(_triple_keys(index[rows][:, face], point_count), mesh_keys)
            for face in faces_of_tetrahedron
        ],
        axis=1,
    )
    # `marching_tetrahedra` assigns the inside of such a tetrahedron to one side of the level set:
    # to the side f > 0 if f is positive at the center.
    sign = np.sign(function.values(corners[rows].mean(axis=1)))
    has_two = in_mesh.sum(axis=1) == 2
    for k, face in enumerate(faces_of_tetrahedron):
        chosen = np.flatnonzero(has_two & in_mesh[:, k])
        a, b, c = (corners[rows[chosen], corner] for corner in face)
        normal = np.cross(b - a, c - a)
        # Corner k is opposite to the face; the gradient points to it if f > 0 inside.
        inward = ((corners[rows[chosen], k] - a) * normal).sum(axis=1)
        owners.append(rows[chosen])
        slopes.append(normal * (np.sign(inward) * sign[chosen])[:, None])
    return _LinearGradients(np.concatenate(owners), np.concatenate(slopes))


def _triple_keys(triples: IntArray, point_count: int) -> IntArray:
    """An integer (k,) for each triple (k, 3) of indices of points: the same for any order of the
    three indices, and different for different triples.

    point_count: more than the largest index, and less than two million.
    """
    a, b, c = np.sort(triples, axis=1).T
    keys: IntArray = (a * point_count + b) * point_count + c
    return keys


def _proved_by_stars(
    function: LevelFunction,
    corners: FloatArray,
    index: IntArray,
    slopes: _LinearGradients,
    rows: IntArray,
) -> BoolArray:
    """(k,) whether condition (c) of the module's theorem is proved for the tetrahedra with indices
    `rows` (k,): each corner has a vector n with n . grad F > 0 and n . grad f > 0 on all tetrahedra
    around the corner.

    For each corner, the vector n is computed as by a perceptron: it starts as the sum of all unit
    gradients of F around the corner; then the gradients whose product with n is not positive are
    added again, for a few rounds.

    function: f.
    corners, index: (m, 4, 3), (m, 4) the corners of all tetrahedra, and the indices of these
        points.
    slopes: the gradients of F; each has its tetrahedron as `owner`. A tetrahedron may have two
        gradients, or none.
    """
    vertices = np.unique(index[rows])
    vertex_number = np.full(int(index.max(initial=0)) + 1, -1, np.int64)
    vertex_number[vertices] = np.arange(len(vertices))
    # Pairs of a tetrahedron and the column, 0 to 3, of a corner of it among `vertices`; then pairs
    # ("entries") of a gradient and such a column of its tetrahedron.
    tetrahedron, column = np.nonzero(vertex_number[index] >= 0)
    vertex_of_pair = vertex_number[index[tetrahedron, column]]
    entry, column_of_entry = np.nonzero(vertex_number[index[slopes.owner]] >= 0)
    vertex_of_entry = vertex_number[index[slopes.owner[entry], column_of_entry]]
    units = slopes.slope[entry]
    units = units / np.maximum(np.linalg.norm(units, axis=1), 1e-300)[:, None]
    normal = np.zeros((len(vertices), 3))
    np.add.at(normal, vertex_of_entry, units)
    for _ in range(_MAX_PERCEPTRON_ROUNDS):
        is_violated = (normal[vertex_of_entry] * units).sum(axis=1) <= 0
        if not is_violated.any():
            break
        np.add.at(normal, vertex_of_entry[is_violated], units[is_violated])
    # n . grad F > 0, by more than rounding.
    is_proved = np.ones(len(vertices), np.bool_)
    is_proved[vertex_of_entry[(normal[vertex_of_entry] * units).sum(axis=1) <= 1e-9]] = False
    has_slope = np.bincount(slopes.owner, minlength=len(index)) > 0
    # A tetrahedron without a gradient proves nothing at its corners.
    is_proved[vertex_of_pair[~has_slope[tetrahedron]]] = False
    # n . grad f > 0 on each tetrahedron around the corners that are left; n takes the place of grad
    # F. Then no value of F is needed (zeros), and points may move along all axes (ones).
    tried = np.flatnonzero(is_proved[vertex_of_pair])
    no_values = np.zeros(len(tried))
    is_regular = _proved_regular(
        function, corners[tetrahedron[tried]], no_values, normal[vertex_of_pair[tried]], np.ones(3)
    )
    is_proved[vertex_of_pair[tried[~is_regular]]] = False
    return np.asarray(is_proved[vertex_number[index[rows]]].all(axis=1), np.bool_)


def _proved_empty(function: LevelFunction, corners: FloatArray) -> BoolArray:
    """(n,) whether condition (a) of the module's theorem is proved on tetrahedra with corners (n,
    4, 3) that the mesh does not meet: neither f nor its linear interpolation F has a zero there.

    Tetrahedra are halved up to five times, until a ball around each piece is proved to hold no zero
    of f. The mesh is the zero set of F, so F has no zero there. Both functions have the same sign,
    since they agree at the corners.
    """
    owner, pieces = np.arange(len(corners)), corners
    for _ in range(_HALVINGS + 1):
        center, radius = _balls(pieces)
        # The distance from the level set is more than the radius in decided pieces.
        undecided = function.clearance(center) <= radius * (1 + 1e-9)
        owner = np.concatenate([owner[undecided], owner[undecided]])
        pieces = _halved(pieces[undecided])
        if not len(pieces):
            break
    free = np.ones(len(corners), np.bool_)
    free[owner] = False
    return free


def _proved_regular(
    function: LevelFunction,
    corners: FloatArray,
    first_values: FloatArray,
    slope: FloatArray,
    free: FloatArray,
) -> BoolArray:
    """(n,) whether condition (a) or (b) of the module's theorem is proved on all of each simplex: f
    and F have no zero there, or grad f . grad F > 0. Simplices are halved up to five times for
    that.

    function: f.
    corners: (n, k, 3) the corners of the simplices.
    first_values: (n,) the values of F at the first corners of the simplices.
    slope: (n, 3) grad F on each simplex. For condition (c), the vector n of the theorem; then
        `first_values` are 0.
    free: (3,) 1 for coordinates in which points may move, 0 for coordinates that a face of the box
        fixes.
    """
    # `pieces` are the parts that are undecided, and `owner` the simplices that they belong to.
    owner, first_corners = np.arange(len(corners)), corners[:, 0]
    pieces, proved = corners, np.ones(len(corners), np.bool_)
    # (A little less than half, for rounding.)
    half_period = np.inf if function.period is None else 0.499 * function.period
    for halving in range(_HALVINGS + 1):
        if not len(pieces):
            break
        center, radius = _balls(pieces)
        # (1e-9 covers the rounding of the radius.)
        radius = radius * (1 + 1e-9)
        samples, change = function.gradient_bounds(center, radius)
        change = np.minimum(change, _NO_BOUND)
        if (change == _NO_BOUND).all():
            proved[owner] = False
            break
        projected = slope[owner] * free
        gradient_length = np.linalg.norm(samples.gradient, axis=1)
        # A bound of the change of f in the ball.
        moved = (gradient_length + change) * radius
        product = (samples.gradient * projected).sum(axis=1)
        # (b): grad f . grad F exceeds `change` |grad F| at the center, where `change` bounds how
        # much grad f changes in the ball. Then (a): f by its bound in the ball, and F by its values
        # at the corners.
        is_regular = product > change * np.linalg.norm(projected, axis=1) * (1 + 1e-9)
        is_within_half_period = np.abs(samples.value) + moved < half_period
        # F at the corners of the pieces.
        linear = first_values[owner, None] + (
            (pieces - first_corners[owner, None]) * slope[owner, None]
        ).sum(2)
        sign = np.sign(samples.value)
        is_regular |= (np.abs(samples.value) > moved) & (linear * sign[:, None] > 0).all(axis=1)
        # The lift stays within half a period of the level on the whole simplex.
        if halving == 0:
            proved &= is_within_half_period
        undecided = ~is_regular & proved[owner]
        # A single point cannot be halved.
        if halving == _HALVINGS or pieces.shape[1] == 1:
            proved[owner[undecided]] = False
            break
        owner = np.concatenate([owner[undecided], owner[undecided]])
        pieces = _halved(pieces[undecided])
    return proved


def _halved(pieces: FloatArray) -> FloatArray:
    """Cut simplices (n, k, 3) at the middle of their longest edges. Returns (2n, k, 3): first one
    half of each, then all other halves."""
    pairs = list(itertools.combinations(range(pieces.shape[1]), 2))
    lengths = [np.linalg.norm(pieces[:, i] - pieces[:, j], axis=1) for i, j in pairs]
    # For each simplex, the positions of the two ends of its longest edge.
    i, j = np.array(pairs)[np.argmax(lengths, axis=0)].T if len(pieces) else (np.zeros(0, int),) * 2
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
    is_tested: BoolArray,
    walls: tuple[FloatArray, FloatArray],
) -> BoolArray:
    """(n,) whether the requirement on walls is proved: where a face, an edge or a corner of a
    tetrahedron lies in walls (faces of the box), grad f . grad F > 0 for the projections of the
    gradients onto these walls. Tetrahedra outside of the mask `is_tested` count as proved if they
    have no corner on a wall, else as not proved.

    function: f.
    corners, values: (n, 4, 3), (n, 4) the corners of the tetrahedra and the values of F there.
    slopes: the gradients of F.
    is_tested: (n,) mask of the tetrahedra to be tested.
    walls: the lower and the upper corner (3,) of the box.
    """
    tolerance = 1e-9 * (walls[1] - walls[0])
    on = np.stack([np.abs(corners - wall) <= tolerance for wall in walls], axis=-1)  # (n, 4, 3, 2)
    proved = is_tested | ~on.any(axis=(1, 2, 3))
    # The six faces of the box: an axis, and 0 for the lower side or 1 for the upper one.
    planes = list(itertools.product(range(3), range(2)))
    for count in (1, 2):  # in corners of the box no point moves, and nothing is required
        for planes_chosen in itertools.combinations(planes, count):
            axes = [axis for axis, _ in planes_chosen]
            if len(set(axes)) < count:  # opposite faces have no point in common
                continue
            in_planes = np.all([on[:, :, axis, side] for axis, side in planes_chosen], axis=0)
            free = np.ones(3)
            free[axes] = 0.0
            corner_count = in_planes.sum(axis=1)
            # The part of a tetrahedron in the walls is a corner, an edge or a face: k corners.
            for k in range(1, 4):
                entry = np.flatnonzero(((corner_count == k) & is_tested)[slopes.owner])
                if not len(entry):
                    continue
                owner = slopes.owner[entry]
                # The positions of the corners in the walls, which come first in this order.
                columns = np.argsort(~in_planes[owner], axis=1, kind="stable")[:, :k]
                part = np.take_along_axis(corners[owner], columns[..., None], axis=1)
                first_values = np.take_along_axis(values[owner], columns[:, :1], axis=1)[:, 0]
                is_regular = _proved_regular(
                    function, part, first_values, slopes.slope[entry], free
                )
                proved[owner[~is_regular]] = False
    return proved


def _distances(points: FloatArray, boundary: BoundaryCurve) -> FloatArray:
    """Distances (n,) of points (n, 3) from the curve `boundary`, measured to nine points of each of
    its edges. They are too large by at most a sixteenth of the longest edge."""
    a, b = (boundary.points[boundary.edges[:, k]] for k in (0, 1))
    # Nine points, an eighth of the edge apart.
    fraction = np.linspace(0, 1, 9)[:, None, None]
    curve_points: FloatArray = (a + fraction * (b - a)).reshape(-1, 3)
    # (`query` returns distances and indices.)
    distances: FloatArray = kd_tree(curve_points).query(points)[0]
    return distances
