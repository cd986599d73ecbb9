"""Sums of screened dipoles: all of them one by one, or far ones in clusters by a tree.

Expansion. Dipoles m_i at c + d_i, |d_i| <= R, seen from x = c - z, r = |z|: by Taylor in d_i

    w = -sum_i m_i.grad K(z + d_i) = -(T1[D] + T2[D^2] + T3[D^3]/2) K(z) + (rest),

T1 = sum m, T2 = sym sum m d, T3 = sym sum m d d. With psi_k as in `screened_kernel`, D K = -z
psi_1, T2[D^2] K = T2[z,z] psi_2 - tr T2 psi_1, T3[D^3] K = 3 z.tr T3 psi_2 - T3[z,z,z] psi_3.
The Yukawa kernel is not harmonic, so that traces count: 19 numbers instead of 15.

Truncation. The rest of Taylor's formula is an integral of the fourth derivative of K along the way,
at most |K''''| at the distance r - s |d_i|. In that, Q_4(kappa rho) <= Q_4(kappa (r-R)); what is
left of the integral is the rest of the Taylor series of 1/(r - .)^2: with q = |d|/r

    |rest| <= Q_4 |m| (1/(1-q)^2 - 1 - 2q - 3q^2)/r^2 = Q_4 |m| |d|^3 (4-3q)/((1-q)^2 r^5),

for kappa = 0 attained by a dipole on the line to x that points along it. (4-3q)/(1-q)^2 grows with
q, so R/r serves for all. For the gradient, likewise from 2/(r - .)^3,

    Q_5 |m| |d|^3 (20 - 30q + 12q^2)/((1-q)^3 r^6),

and for second derivatives from 6/(r - .)^4,

    Q_6 |m| |d|^3 (120 - 270q + 216q^2 - 60q^3)/((1-q)^4 r^7).
"""

from __future__ import annotations

import abc
import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.extrema import fmax, fmin
from harnack.backend.records import Records
from harnack.fields.clouds.dipole_records import hierarchy_of, in_slots, padding_row
from harnack.fields.clouds.screened_kernel import (
    LONGEST,
    ScreenedSums,
    Source,
    Tail,
    cluster_parts,
    combine,
    seen_dipole,
)
from harnack.fields.multipoles.cluster_walk import SeenCluster, walk_clusters
from harnack.fields.sums import rounding_of_sum
from harnack.tree import Hierarchy, pack

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harnack.backend import Backend, Mask, Real, Vec3


# Dipoles a trip of the plain sum, by experiment.
_CHUNK = 4
# A cluster is never taken as a whole nearer than this many radii.
_LEAST = 1.5


class ScreenedDipoles(abc.ABC):
    """Dipoles on a backend.

    kappa: one over the length. rounding: of sums of so many terms, as `ScreenedSums.plus` takes it.
    """

    def __init__(self, backend: Backend, rows: FloatArray, kappa: float) -> None:
        self.backend = backend
        self.kappa = dr.opaque(backend.Float, kappa)
        self.rounding = rounding_of_sum(backend, len(rows), 12)

    @abc.abstractmethod
    def sums(self, x: Vec3, closer: Real, derivatives: int) -> ScreenedSums:
        """Value, derivatives and bounds at x; clusters are taken as a whole from `closer` times
        the `accepting_distance` on. derivatives: as for `FieldSums.zero`."""

    def _with_dipole(
        self, row: list[Real], x: Vec3, derivatives: int, state: tuple[Any, ...]
    ) -> tuple[Any, ...]:
        dipole = seen_dipole(row, x, self.kappa, derivatives)
        return ScreenedSums.of(state).plus(dipole, self.rounding, True).parts()


class DirectSum(ScreenedDipoles):
    """All dipoles, one by one; no sum could be closer."""

    def __init__(self, backend: Backend, rows: FloatArray, kappa: float) -> None:
        super().__init__(backend, rows, kappa)
        self._records = Records.upload(backend, rows, padding_row(rows[0]), _CHUNK)

    def sums(self, x: Vec3, closer: Real, derivatives: int) -> ScreenedSums:
        del closer

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            return self._with_dipole(row, x, derivatives, state)

        start = ScreenedSums.zero(self.backend, derivatives).parts()
        return ScreenedSums.of(self._records.for_each(add, start, "screened dipoles"))


class TreeSum(ScreenedDipoles):
    """Near dipoles one by one, far ones in clusters. See `accepting_distance` for the accuracy."""

    def __init__(self, backend: Backend, rows: FloatArray, kappa: float, accuracy: float) -> None:
        super().__init__(backend, rows, kappa)
        tree = hierarchy_of(rows[:, :3])
        levels = [columns(level, kappa, accuracy) for level in clusters(tree, rows)]
        self._tree = pack(backend, tree, levels, in_slots(tree, rows))

    def sums(self, x: Vec3, closer: Real, derivatives: int) -> ScreenedSums:
        closer = fmax(self.backend.Float(closer), self.backend.Float(1))

        def near(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            del active
            return self._with_dipole(row, x, derivatives, state)

        def far(node: SeenCluster, state: tuple[Any, ...]) -> tuple[Any, ...]:
            length = dr.sqrt(node.square)
            cluster = seen_cluster(
                node.head, node.payload, -node.r, length, self.kappa, derivatives
            )
            return ScreenedSums.of(state).plus(cluster, self.rounding, node.far).parts()

        start = ScreenedSums.zero(self.backend, derivatives).parts()
        return ScreenedSums.of(walk_clusters(self._tree, x, closer, far, near, start))


def seen_cluster(
    head: Sequence[Real], c: Sequence[Real], z: Vec3, length: Real, kappa: Real, derivatives: int
) -> Source:
    """A node with numbers `columns`, its centre at z, |z| = length, and what is left out."""
    radius, weight = head[4], head[5]
    inverse = dr.rcp(length)
    t = fmin(kappa * length, LONGEST)
    parts = cluster_parts(c, z, inverse)
    terms = combine(parts, z, inverse, t, dr.exp(-t), derivatives)
    nearest = length - radius
    share = dr.rcp(nearest)
    t = fmin(kappa * nearest, LONGEST)
    decay = dr.exp(-t)
    tail = Tail.of(nearest, share, t, decay)
    t4 = t * t * t * t
    fourth = dr.fma(decay * t4, 1 / 24, tail.third)
    fifth = dr.fma(decay * t4 * t, 1 / 120, fourth)
    q = radius * inverse
    common = c[23] * inverse * inverse * inverse * share * share
    error = common * fourth * dr.fma(-3, q, 4)
    slope = common * share * fifth * dr.fma(q, dr.fma(12, q, -30), 20)
    sixth = dr.fma(decay * t4 * t * t, 1 / 720, fifth)
    rest = dr.fma(q, dr.fma(q, dr.fma(-60, q, 216), -270), 120)
    second = common * share * share * sixth * rest
    return Source(terms, weight, tail, error, slope, second)


@dataclass(frozen=True)
class ClusterMoments:
    """The nodes of one level: centre (k, 3), radius, weight, third = sum w |d|^3 (k,) each, and
    T1 (k, 3), T2 (k, 3, 3), T3 (k, 3, 3, 3), symmetric."""

    centre: FloatArray
    radius: FloatArray
    weight: FloatArray
    third: FloatArray
    t1: FloatArray
    t2: FloatArray
    t3: FloatArray


def clusters(tree: Hierarchy, rows: FloatArray) -> list[ClusterMoments]:
    """Moments of all levels, from the leaves to the root.

    T1, T2, T3 move from a child's centre to its parent's, d -> d + s: T2 gains sym(T1 s) and T3
    sym(2 T2 s + T1 s s). The rest is taken from the dipoles themselves.
    """
    slots = in_slots(tree, rows)
    levels: list[ClusterMoments] = []
    for count, arity in zip(tree.counts, (0, *tree.arities), strict=True):
        p, m, w = np.split(slots.reshape(count, -1, slots.shape[2])[..., :7], [3, 6], axis=2)
        weight = w.sum(axis=(1, 2))
        centre = (w * p).sum(axis=1) / np.where(weight > 0, weight, 1)[:, None]
        d = p - centre[:, None]
        length = np.where(w[..., 0] > 0, np.linalg.norm(d, axis=2), 0)
        third = (w[..., 0] * length**3).sum(axis=1)
        if not levels:
            d = np.where(w > 0, d, 0)
            moments = _symmetric(
                m.sum(axis=1),
                np.einsum("ksi,ksj->kij", m, d),
                np.einsum("ksi,ksj,ksl->kijl", m, d, d),
            )
        else:
            moments = _moved(levels[-1], centre, arity)
        levels.append(ClusterMoments(centre, length.max(axis=1), weight, third, *moments))
    return levels


def _moved(
    children: ClusterMoments, centre: FloatArray, arity: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    s = children.centre - np.repeat(centre, arity, axis=0)
    t1, t2, t3 = children.t1, children.t2, children.t3
    first = np.einsum("ki,kj->kij", t1, s)
    second = t3 + np.einsum("kij,kl->kijl", 2 * t2 + first, s)
    sums = [a.reshape(-1, arity, *a.shape[1:]).sum(axis=1) for a in (t1, t2 + first, second)]
    return _symmetric(*sums)


def _symmetric(
    t1: FloatArray, t2: FloatArray, t3: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    orders = itertools.permutations((1, 2, 3))
    total = sum((t3.transpose(0, *order) for order in orders), start=np.zeros_like(t3))
    return t1, 0.5 * (t2 + t2.transpose(0, 2, 1)), total / 6


def coefficients(level: ClusterMoments) -> FloatArray:
    """(k, 23) numbers as `cluster_parts` reads them: T1; tr T2; -T2; -3/2 tr T3; T3/2."""
    t2, t3 = -level.t2, 0.5 * level.t3
    i, j = np.array([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]).T
    a, b, c = np.array(
        [(0, 0, 0), (1, 1, 1), (2, 2, 2), (0, 0, 1), (0, 0, 2), (0, 1, 1), (1, 1, 2), (0, 2, 2),
         (1, 2, 2), (0, 1, 2)]
    ).T  # fmt: skip
    trace2 = np.einsum("kii->k", level.t2)[:, None]
    trace3 = -1.5 * np.einsum("kiij->kj", level.t3)
    return np.concatenate([level.t1, trace2, t2[:, i, j], trace3, t3[:, a, b, c]], axis=1)


def columns(level: ClusterMoments, kappa: float, accuracy: float) -> FloatArray:
    """(k, 30): centre, accepting distance, radius, weight | coefficients, third."""
    accept = accepting_distance(level.radius, kappa, accuracy)
    # Rounding of centre and radius must not let a dipole out.
    head = np.stack([accept, level.radius * (1 + 1e-5) + 1e-6, level.weight], axis=1)
    return np.concatenate([level.centre, head, coefficients(level), level.third[:, None]], axis=1)


def accepting_distance(radius: FloatArray, kappa: float, accuracy: float) -> FloatArray:
    """From where on a cluster is taken as a whole: accuracy R Q_4(kappa (r-R))^(1/5) <= r.

    Clusters of radius R on a surface cost 1/R^2 and err by R^3/r^5 Q_4 an area; the sum of errors
    is smallest at a given cost if R is proportional to r Q_4^(-1/5). Bisection, from the safe side.
    """
    low, high = _LEAST * radius, accuracy * radius
    for _ in range(40):
        r = 0.5 * (low + high)
        t = kappa * (r - radius)
        q4 = np.exp(-t) * (1 + t * (1 + t / 2 * (1 + t / 3 * (1 + t / 4))))
        good = accuracy * radius * q4**0.2 <= r
        low, high = np.where(good, low, r), np.where(good, r, high)
    return high + 1e-5
