"""What enclosures prove where numbers are infinite, not numbers, denormal or huge: never too much.

Two oracles that know no proof by name. (1) Double precision has room for the squares and quotients
of all numbers of single precision: the same formula of the same numbers must not prove a longer
step in single than in double, beyond rounding. (2) What is not a number may be anything, so it
proves no longer step than any number in its place.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Callable
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float, Float64

import harnack
from harnack import enclosures, literature
from harnack.arithmetic import Interval
from harnack.backend import choose_backend
from harnack.backend.arrays import upload_floats
from harnack.enclosures import Enclosure, LevelGaps, SlopeRange, any_is_free, longest_free_length
from harnack.enclosures.bounded_laplacian import BoundedLaplacianEnclosure
from harnack.enclosures.enclosure import PathPiece
from harnack.enclosures.extremum import (
    BranchPointEnclosure,
    BranchSample,
    MaximumEnclosure,
    MaximumOperand,
    NearestBranchEnclosure,
    NegatedEnclosure,
    ScaledEnclosure,
)
from harnack.enclosures.free_radius import HarmonicBallEnclosure
from harnack.enclosures.parabola import (
    ConvexityEnclosure,
    LipschitzEnclosure,
    ParabolaEnclosure,
    SphereArcEnclosure,
)
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.fields.blobs.blobs import DelayedEnclosure  # pyright: ignore[reportPrivateUsage]
from harnack.fields.blobs.group_maximum import GroupMaximumEnclosure
from harnack.fields.solids.extrusions import ExtrusionEnclosure
from harnack.fields.solids.from_field import FoldedEnclosure
from harnack.fields.solids.outline_distance import SignedDistanceEnclosure
from harnack.fields.solids.thread import OutsideCylinderEnclosure
from harnack.fields.solids.tube import TangentEnclosure
from harnack.literature import LongestOfEnclosure
from harnack.literature.formula_enclosures import BandEnclosure
from harnack.literature.taylor_forms import SinglePieceEnclosure

SIZES = [0.0, 1e-12, 1e-4, 0.3, 1.0, 7.0, 1e5, 1e12, 1e25, np.inf]
NUMBERS = SIZES + [-one for one in SIZES]

SIGNS = [1.0, -1.0]

Draw = Callable[[list[float]], Any]


def sizes(draw: Draw) -> Any:
    return draw(SIZES)


def slopes(draw: Draw) -> SlopeRange:
    one, other = draw(NUMBERS), draw(NUMBERS)
    return SlopeRange(dr.minimum(one, other), dr.maximum(one, other))


def rising(draw: Draw, count: int) -> list[Any]:
    made = [draw(SIZES[1:])]
    for _ in range(count - 1):
        made.append(dr.maximum(made[-1], draw(SIZES[1:])))
    return made


def parts(draw: Draw, count: int) -> tuple[PathPiece, ...]:
    made: list[PathPiece] = []
    for length in rising(draw, count):
        bend = slopes(draw)
        made.append(PathPiece(length, slopes(draw), bend.lower, bend.upper))
    return tuple(made)


def ball(kind: Any, draw: Draw) -> list[Enclosure]:
    made: list[Enclosure] = []
    for dimension in (2, 3, 4):
        for below, above in ((True, True), (True, False), (False, True)):
            if kind.applies_to(dimension, below, above):
                ends = (sizes(draw) if one else None for one in (below, above))
                made.append(kind(sizes(draw), *ends, dimension, slopes(draw)))
    return made


def tube(draw: Draw) -> TangentEnclosure:
    """Tangents of which the least counts, at knots of which the last may be infinite."""
    length = draw([1e-12, 1e-4, 1.0, 1e12])
    knots = (*(k * length for k in (0.125, 0.25, 0.5)), draw([1e13, 1e25, np.inf]))
    fall, delay = draw([-1.0, -0.3, 1e-12, 1.0, np.nan]), sizes(draw)
    lows = tuple(dr.minimum(0.5 * k, fall * k + delay) for k in knots)
    return TangentEnclosure(sizes(draw), draw([-1.0, -0.3, 0.0, 1e-12, 1.0]), knots, lows)


def signed(draw: Draw) -> SignedDistanceEnclosure:
    size = tube(draw)
    return SignedDistanceEnclosure(size.distance * draw(SIGNS), size)


def extruded(kind: Any, draw: Draw) -> Any:
    """f is the larger of both distances, or more."""
    side, height, half = signed(draw), draw(NUMBERS), sizes(draw)
    least = dr.maximum(side.value, dr.abs(height) - half)
    value = least + sizes(draw)
    error = sizes(draw) + 1e-6 * (dr.abs(value) + dr.abs(side.value) + dr.abs(height) + half)
    return kind(value, error, side, height, half, draw([-1.0, -0.3, 0.0, 1.0]))


def beside(kind: Any, draw: Draw) -> Any:
    """The direction's part across the axis is at most 1, and at least its part away from there."""
    r, slope = sizes(draw), draw([-1.0, -0.3, 0.0, 1.0])
    square = dr.maximum(slope * slope, draw([0.0, 1e-12, 0.3, 1.0]))
    return kind(sizes(draw), sizes(draw), r, r * slope, square, sizes(draw), 1 + sizes(draw))


def cone(kind: Any, draw: Draw) -> Any:
    constant = sizes(draw)
    return kind(SlopeRange(-constant, constant), 0.0, 0.0, sizes(draw))


def parabola(kind: Any, draw: Draw) -> Any:
    bend = slopes(draw)
    return kind(slopes(draw), bend.lower, bend.upper, sizes(draw))


def band(kind: Any, draw: Draw) -> Any:
    offsets = slopes(draw)
    return kind(Interval(offsets.lower, offsets.upper), slopes(draw), sizes(draw))


def nearest(kind: Any, draw: Draw) -> Any:
    sheets = tuple(BranchSample(slopes(draw), draw(NUMBERS)) for _ in range(2))
    return kind(sheets, sheets[0], sizes(draw), draw(SIGNS) > 0, sizes(draw), sizes(draw))


def cusp(kind: Any, draw: Draw) -> Any:
    one = [draw(NUMBERS) if k in (0, 1, 2) else sizes(draw) for k in range(9)]
    return kind(*one, draw(SIGNS) > 0)


def greatest(kind: Any, draw: Draw) -> Any:
    inner = (parabola(ParabolaEnclosure, draw), tube(draw))
    return kind(tuple(MaximumOperand(low := sizes(draw), low, (one,)) for one in inner))


# How enclosures of a class are made, and of those derived from it that are not listed themselves.
MAKERS: dict[type[Enclosure], Callable[[Any, Draw], Any]] = {
    ParabolaEnclosure: parabola,
    LipschitzEnclosure: cone,
    HarmonicBallEnclosure: ball,
    PiecewiseTaylorEnclosure: lambda kind, draw: kind(slopes(draw), parts(draw, 3)),
    SinglePieceEnclosure: lambda kind, draw: kind(slopes(draw), parts(draw, 1)),
    LongestOfEnclosure: lambda kind, draw: kind(
        (parabola(ParabolaEnclosure, draw), cone(LipschitzEnclosure, draw))
    ),
    BandEnclosure: band,
    ConvexityEnclosure: lambda kind, draw: kind(slopes(draw)),
    BoundedLaplacianEnclosure: lambda kind, draw: kind(
        sizes(draw), sizes(draw), sizes(draw), draw(NUMBERS), sizes(draw), slopes(draw)
    ),
    SphereArcEnclosure: lambda kind, draw: kind(
        slopes(draw), sizes(draw), draw(NUMBERS), 1 + sizes(draw)
    ),
    NearestBranchEnclosure: nearest,
    BranchPointEnclosure: cusp,
    MaximumEnclosure: greatest,
    NegatedEnclosure: lambda kind, draw: kind(tube(draw)),
    ScaledEnclosure: lambda kind, draw: kind(
        parabola(ParabolaEnclosure, draw), sizes(draw), sizes(draw)
    ),
    FoldedEnclosure: lambda kind, draw: kind(parabola(ParabolaEnclosure, draw), draw(NUMBERS), 1.0),
    SignedDistanceEnclosure: lambda _, draw: signed(draw),
    ExtrusionEnclosure: extruded,
    OutsideCylinderEnclosure: beside,
    TangentEnclosure: lambda _, draw: tube(draw),
    DelayedEnclosure: lambda kind, draw: kind(sizes(draw), parabola(ParabolaEnclosure, draw)),
}
# It asks the others, group by group, and holds no numbers of its own but those of a kernel.
ASKS_OTHERS = {GroupMaximumEnclosure}


def kinds_of(package: ModuleType) -> set[type[Enclosure]]:
    """All that can be made, once the modules of the package are imported."""
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    found: set[type[Enclosure]] = set()
    waiting: list[type[Enclosure]] = [Enclosure]
    while waiting:
        kind = waiting.pop()
        waiting += kind.__subclasses__()
        own = kind.__module__.startswith("harnack.") and kind is not SinglePieceEnclosure
        own &= not kind.__module__.startswith("harnack.testing")
        if own and not inspect.isabstract(kind):
            found.add(kind)
    return found - ASKS_OTHERS


KINDS = sorted(kinds_of(enclosures) | kinds_of(literature), key=lambda kind: kind.__name__)


def test_every_enclosure_is_tried() -> None:
    """Those of fields are imported above."""
    assert kinds_of(harnack) == set(KINDS), "import its module in this file"


class Numbers:
    """The same numbers of a list in both precisions; those of one draw may be replaced."""

    def __init__(self, real: Any, lanes: int, replaced: int = -1, by: float = np.nan) -> None:
        self.real, self.lanes, self.rng = real, lanes, np.random.default_rng(0)
        self.count, self.replaced, self.by, self.lists = 0, replaced, by, []

    def __call__(self, values: list[float]) -> Any:
        drawn = self.rng.choice(np.array(values, np.float32), self.lanes)
        if self.count == self.replaced:
            drawn[:] = self.by
        self.count += 1
        self.lists.append(values)
        return upload_floats(choose_backend("single" if self.real is Float else "double"), drawn)


def answers(kind: type[Enclosure], draw: Numbers) -> tuple[np.ndarray, np.ndarray]:
    """Steps of enclosures of a kind, and whether they cover a length."""
    gaps, length = LevelGaps(sizes(draw), sizes(draw)), sizes(draw)
    make = next(MAKERS[base] for base in kind.__mro__ if base in MAKERS)
    made = make(kind, draw)
    many: list[Any] = made if isinstance(made, list) else [made]
    steps = [np.asarray(longest_free_length((one,), gaps)) for one in many]
    covered = [np.array(any_is_free((one,), gaps, length)) for one in many]
    return np.concatenate(steps), np.concatenate(covered)


@pytest.mark.few(5)
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_no_longer_step_than_in_double_precision(kind: type[Enclosure]) -> None:
    single, _ = answers(kind, Numbers(Float, 60_000))
    double, _ = answers(kind, Numbers(Float64, 60_000))
    assert not np.isnan(single).any()
    longest = np.where(double > 3e38, np.inf, double)  # beyond single precision's end
    too_long = single > longest * (1 + 1e-2) + 1e-30
    assert not too_long.any(), np.flatnonzero(too_long)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_what_is_not_a_number_proves_nothing(kind: type[Enclosure]) -> None:
    first = Numbers(Float, 1500)
    answers(kind, first)
    for k, values in enumerate(first.lists):
        steps, covered = answers(kind, Numbers(Float, 1500, k))
        if values is SIGNS:
            continue
        for value in (one for one in values if abs(one) < 1e9):
            other_steps, other_covered = answers(kind, Numbers(Float, 1500, k, value))
            too_long = steps > 3 * other_steps  # solvers differ by their own inaccuracy
            bad = covered & ~other_covered
            assert not too_long.any(), (k, value)
            assert not bad.any(), (k, value)
