"""Samples of light paths: Sobol' points, scrambled after Owen, computed from their index alone.

A sampler with a state must be carried along with each path; these need the path's pixel, the
index of the sample and the dimension, so that paths can be moved to other lanes, and the same path
has the same numbers whatever else is drawn. Each pair of dimensions is the first two of Sobol' in
an order of its own (Burley 2020, Practical Hash-based Owen Scrambling), which stratifies samples of
a pixel as well as multi-jittering does, for any number of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

# Dimensions for camera rays, and for each vertex of a path.
_CAMERA, _VERTEX = 8, 8
# Sobol's second dimension is Pascal's triangle modulo 2, applied by halves.
_PASCAL = ((0xAAAAAAAA, 1), (0xCCCCCCCC, 2), (0xF0F0F0F0, 4), (0xFF00FF00, 8), (0xFFFF0000, 16))
# Multipliers of a permutation of 32 bits in which each depends on those below (Vegdahl 2021), and
# of a hash of 32 bits (Wellons 2018).
_OWEN = (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6)
_HASH = (0x21F0AAAD, 0xD35A2D97)


@dataclass
class SobolSampler:
    """Numbers for paths, with Mitsuba's names of methods. Each call is another dimension.

    pixel, index: UInt32 of each path, what its sample is of and which one it is.
    seed: UInt32. dimension: UInt32, of the next call.
    """

    mi: Any
    pixel: Any
    index: Any
    seed: Any
    dimension: Any

    def at_vertex(self, depth: Any, rows: Any) -> SobolSampler:
        """For some of the paths, at their vertex number `depth` from 0."""
        uint = self.mi.UInt32
        pixel, index = dr.gather(uint, self.pixel, rows), dr.gather(uint, self.index, rows)
        return SobolSampler(self.mi, pixel, index, self.seed, _CAMERA + _VERTEX * uint(depth))

    def next_2d(self, active: Any = True) -> Any:
        """Points in [0, 1)^2."""
        del active
        uint, mi = self.mi.UInt32, self.mi
        key = _hashed(uint, self.pixel + _hashed(uint, self.dimension + _hashed(uint, self.seed)))
        self.dimension = self.dimension + 1
        shuffled = _owen(uint, self.index, key)
        x, y = dr.brev(shuffled), shuffled
        for mask, shift in _PASCAL:
            y = y ^ ((y & uint(mask)) >> shift)
        pair = (
            _owen(uint, x, _hashed(uint, key + 1)),
            _owen(uint, dr.brev(y), _hashed(uint, key + 2)),
        )
        below = 1 - dr.epsilon(mi.Float)
        return mi.Point2f(*(dr.minimum(mi.Float(part) * 2.0**-32, below) for part in pair))

    def next_1d(self, active: Any = True) -> Any:
        """Numbers in [0, 1)."""
        return self.next_2d(active).x


def _hashed(uint: Any, x: Any) -> Any:
    x = uint(x)
    for multiplier, shift in zip(_HASH, (16, 15), strict=True):
        x = (x ^ (x >> shift)) * uint(multiplier)
    return x ^ (x >> 15)


def _owen(uint: Any, x: Any, seed: Any) -> Any:
    """Owen's scrambling: each bit flipped or not as the bits above it say."""
    x = dr.brev(x) + seed
    for multiplier in _OWEN:
        x ^= x * uint(multiplier)
    return dr.brev(x)
