"""Bisection of rays with interval pruning, the baseline of the published tables.

An interval of the ray is examined as a whole. Where the enclosure proves it free, the next interval
follows; where not, the part that is proved free at the front (and, of bands, at the end) is cut off
and the rest halved. The ends of pending intervals are on a stack, each with the length to which the
ray is free behind it.
"""

from __future__ import annotations

import time
from typing import Any

import drjit as dr

from harnack.backend.arrays import Backend
from harnack.enclosures import Enclosure, Levels, SlopeRange
from harnack.literature.formula_enclosures import BandEnclosure

_DEPTH, _MOST = 48, 2000


def bisect(
    backend: Backend, field: Any, kind: type[Enclosure], rays: tuple[Any, Any, Any], width: float
) -> tuple[Any, Any, float]:
    """Lengths at which rays hit f = 0 (infinite where they do not), evaluations, and core seconds.

    rays: origins, unit directions and lengths. width: an interval this short that is not proved
        free is a hit.
    """
    o, d, end = rays
    prepared = field.evaluator(backend)
    levels = Levels((dr.opaque(backend.Float, 0.0),))
    real, count = backend.Float, backend.UInt32

    def free_ends(start: Any, stop: Any) -> tuple[Any, Any]:
        """The length to which the interval is free from its start, and that from which it is free
        to its end."""
        p = dr.fma(backend.Array3f(start), d, o)
        sample = prepared.evaluate(p)
        length = stop - start
        slope = dr.dot(sample.gradient, d)
        bounds: Any = kind.from_restriction(
            prepared.restrict(p, d), SlopeRange(slope, slope), length
        )
        gaps = levels.gaps(sample.value).reduced_by(sample.value_error)
        front = bounds.free_length(gaps)
        back = length
        if isinstance(bounds, BandEnclosure):
            # Lines that fall into the gap at the end: the lengths from which they are inside.
            up = (gaps.above - bounds.offsets.upper) / bounds.slopes.upper
            down = -(gaps.below + bounds.offsets.lower) / bounds.slopes.lower
            above = (bounds.offsets.upper >= gaps.above) & (bounds.slopes.upper < 0) & (up < length)
            below = (
                (-bounds.offsets.lower >= gaps.below) & (bounds.slopes.lower > 0) & (down < length)
            )
            upper = dr.select(above, up, dr.select(gaps.above == dr.inf, 0, length))
            lower = dr.select(below, down, dr.select(gaps.below == dr.inf, 0, length))
            back = dr.clip(dr.maximum(upper, lower) * (1 + 1e-6), 0, length)
            back = dr.select(dr.isfinite(back) & (back > front), back, length)
        return front, back

    def body(start: Any, top: Any, evals: Any, t_hit: Any, active: Any, ends: Any, on: Any) -> Any:
        stop = ends.read(top, active=active)
        resumed = on.read(top, active=active)
        front, back = free_ends(start, stop)
        evals = evals + 1
        free = front >= stop - start
        short = ~free & (stop - start < width)
        t_hit = dr.select(short, start, t_hit)
        after = dr.select(free, resumed, start + front)
        last = start + back
        splits = active & ~free & ~short
        middle = 0.5 * (after + last)
        upper = dr.minimum(top + 1, _DEPTH - 1)
        ends.write(last, top, active=splits)
        ends.write(middle, upper, active=splits)
        on.write(middle, upper, active=splits)
        done = short | (free & (top == 0)) | (evals >= _MOST)
        top = dr.select(free, top - 1, upper)
        return after, dr.select(done, count(0), top), evals, t_hit, active & ~done, ends, on

    core = time.process_time()
    n = dr.width(o)
    ends, on = dr.alloc_local(real, _DEPTH), dr.alloc_local(real, _DEPTH)
    ends.write(real(end), count(0))
    on.write(real(end), count(0))
    state = (
        dr.zeros(real, n), dr.zeros(count, n), dr.zeros(count, n),
        dr.full(real, dr.inf, n), dr.full(backend.Bool, True, n), ends, on,
    )  # fmt: skip
    result = dr.while_loop(state, lambda *values: values[4], body, label="bisection")
    evals, t_hit = result[2], result[3]
    dr.eval(evals, t_hit)
    dr.sync_thread()
    return t_hit, evals, time.process_time() - core
