"""Multipole moments of dipoles about a point, and about another one.

The potential of dipoles a_i n_i at y_i = c + d_i is, seen from x = c + r,

    f(x) = sum_i a_i n_i.(y_i - x)/|y_i - x|^3 = -sum_i a_i n_i.grad_y 1/|x - y_i|
         = -sum_{l>=1} sum_m conj(M_lm) I_lm(r),      M_lm = sum_i a_i n_i.grad R_lm(d_i)

with solid harmonics R_lm = r^l P_lm(cos t) e^(im p)/(l+m)! and I_lm = (l-m)! P_lm e^(im p)/r^(l+1)
(no Condon-Shortley phase; R_l,-m = (-1)^m conj R_lm). 1/|x-y| = sum conj(R_lm(y)) I_lm(x),
R_lm(a+b) = sum R_l'm'(a) R_l-l',m-m'(b), d/dz R_lm = R_l-1,m, (d/dx + i d/dy) R_lm = -R_l-1,m+1,
(d/dx - i d/dy) R_lm = R_l-1,m-1. All of these are held by tests.

A complex number is a pair here, of numbers or arrays of any kind, NumPy's and Dr.Jit's alike.
"""

# Harmonics have degree l.
# ruff: noqa: E741

from __future__ import annotations

from typing import Any

Pair = tuple[Any, Any]
Pairs = dict[tuple[int, int], Pair]

# The largest l for which moments are computed.
KNOWN = 5
# What is kept of them: for all 1 <= l <= KNOWN and 0 <= m <= l.
KEYS = tuple((l, m) for l in range(1, KNOWN + 1) for m in range(l + 1))


def regular(x: Any, y: Any, z: Any, order: int) -> Pairs:
    """R_lm for l <= order and 0 <= m <= l; the imaginary part is the number 0 if m = 0."""
    r2 = x * x + y * y + z * z
    out: Pairs = {(0, 0): (0 * x + 1, 0.0)}
    for m in range(order + 1):
        if m:
            u, v = x * (1 / (2 * m)), y * (1 / (2 * m))
            re, im = out[m - 1, m - 1]
            out[m, m] = (re * u, re * v) if m == 1 else (re * u - im * v, re * v + im * u)
        for l in range(m + 1, order + 1):
            scale = 1 / ((l + m) * (l - m))
            along, back = (scale * (2 * l - 1)) * z, scale * r2
            re, im = out[l - 1, m]
            re, im = along * re, along * im if m else 0.0
            if l - 2 >= m:
                last = out[l - 2, m]
                re, im = re - back * last[0], im - back * last[1] if m else 0.0
            out[l, m] = re, im
    return out


def of_dipole(harmonics: Pairs, nx: Any, ny: Any, nz: Any) -> Pairs:
    """M_lm of a dipole n, its area in its length, at d, of which R_lm(d) are given for l < KNOWN.

    Or of one that is spread out, from the means of R_lm.
    """
    r, x, y = _either_sign(harmonics), 0.5 * nx, 0.5 * ny
    out: Pairs = {}
    for l, m in KEYS:
        re, im = (nz * part for part in r[l - 1, m]) if m < l else (0.0, 0.0)
        if abs(m + 1) < l:  # less (x - iy) R_l-1,m+1
            a, b = r[l - 1, m + 1]
            re, im = re - (x * a + y * b), im - (x * b - y * a)
        if abs(m - 1) < l:  # plus (x + iy) R_l-1,m-1
            a, b = r[l - 1, m - 1]
            re, im = re + (x * a - y * b), im + (x * b + y * a)
        out[l, m] = re, im if m else 0.0
    return out


def moved(moments: Pairs, x: Any, y: Any, z: Any) -> Pairs:
    """Moments about c of dipoles whose moments about c + (x, y, z) are given."""
    r, given = _either_sign(regular(x, y, z, KNOWN - 1)), _either_sign(moments)
    out: Pairs = {}
    for l, m in KEYS:
        re, im = moments[l, m]
        for k in range(1, l):
            for j in range(max(-k, m - l + k), min(k, m + l - k) + 1):
                (a, b), (u, v) = given[k, j], r[l - k, m - j]
                re = re + (a * u - b * v)
                if m:
                    im = im + (a * v + b * u)
        out[l, m] = re, im
    return out


def _either_sign(values: Pairs) -> Pairs:
    """R_lm or M_lm with those of m < 0 as well."""
    turned = {
        (l, -m): (re, -im) if m % 2 == 0 else (-re, im) for (l, m), (re, im) in values.items() if m
    }
    return values | turned
