"""Sums over records as jets: what lets blobs be deformed and blended by formulas of others."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, TypeAlias

from harnack.arithmetic import Interval, Jet

if TYPE_CHECKING:
    from harnack.backend import Real
    from harnack.fields.blobs.kernels import Kernel
    from harnack.fields.blobs.sums import ForEach, State

Coordinates: TypeAlias = tuple[Jet, Jet, Jet]
Term: TypeAlias = "Callable[[list[Real]], Jet]"


def summed(term: Term, like: Jet, zero: Real, for_each: ForEach) -> Jet:
    """The sum of a jet for each record, in a loop whose state is the ends of all intervals.

    like: a jet of the same variables. zero: the number 0 on each lane.
    """

    def body(row: list[Real], state: State) -> State:
        total = jet_of(like, iter(state)) + term(row)
        return tuple(leaves(total, zero))

    start = tuple(leaves(like.constant(0.0), zero))
    return jet_of(like, iter(for_each(body, start)))


def blob_term(kernel: Kernel, coordinates: Coordinates) -> Term:
    """The jet of one blob at jets of the coordinates."""
    function = kernel.function()

    def term(row: list[Real]) -> Jet:
        inverse, amplitude = row[6], row[7]
        x, y, z = (((one - row[k]) - row[3 + k]) * inverse for k, one in enumerate(coordinates))
        return (x**2 + y**2 + z**2).apply(function) * amplitude

    return term


def leaves(jet: Jet, zero: Real) -> Iterator[Any]:
    """The ends of all intervals of a jet, as numbers of the backend."""
    for one in (jet.value, *jet.first, *jet.second):
        yield zero + one.low
        yield zero + one.high
    if jet.start is not None:
        yield from leaves(jet.start, zero)


def jet_of(like: Jet, ends: Iterator[Any]) -> Jet:
    """A jet of the same variables as another one, with these ends."""
    value = Interval(next(ends), next(ends))
    first = tuple(Interval(next(ends), next(ends)) for _ in like.first)
    second = tuple(Interval(next(ends), next(ends)) for _ in like.second)
    start = None if like.start is None else jet_of(like.start, ends)
    return Jet(value, first, second, start, like.width)
