"""Blends: how two or more distances are joined, with a sharp or with a rounded edge."""

from __future__ import annotations

from typing import Any

from harnack.arithmetic.jet import Jet
from harnack.arithmetic.norms import maximum, minimum, norm


def blend_union(a: Any, b: Any, radius: Any, power: float = 2.0) -> Any:
    """The union of {a <= 0} and {b <= 0}, its inner edge filled by a superellipse.

    radius: from where on, in values of a and b, the other surface is felt. power: at least 1; with
    2 the edge is a circular arc where the surfaces meet at right angles, larger ones are sharper.

    With g_a = max(0, 1 - a/r) it is r (1 - |(g_a, g_b)|_p); Hart (1996, equation 43) prints the
    root around everything. Where both a and b are at least r it is their minimum. Between the two
    it is continuous: where the smaller one is r, both are r.

    Proof of its Lipschitz constant. If those of a and b are at most 1, the gradient is
    sum_k u_k^(p-1) grad k with u = g/|g|_p, and u_a^(p-1) + u_b^(p-1) is at most 2^(1/p), by
    Hoelder's inequality, with equality at a = b: so 2^(1/p) holds, and is attained where the
    gradients are equal. Where they are orthogonal and p >= 2, it is 1. With two radii, as Hart has
    it, the function is not continuous at g = 0, and there is no constant at all.
    """
    g_a, g_b = (maximum(1.0 - one / radius, 0.0) for one in (a, b))
    near = (1.0 - norm(g_a, g_b, p=power)) * radius
    least = minimum(a, b)
    both = near + maximum(least - radius, 0.0)
    if not isinstance(least, Jet) or not isinstance(both, Jet):
        return both
    # Where it is known which one it is, the kinks of the other do not matter.
    far = least - radius
    both = near.selected(far.value.high < 0, both)
    return least.selected(far.value.low > 0, both)


def blend_intersection(a: Any, b: Any, radius: Any, power: float = 2.0) -> Any:
    """The intersection of {a <= 0} and {b <= 0}, its outer edge rounded: see `blend_union`."""
    return -blend_union(-a, -b, radius, power)


def corner(*sides: Any) -> Any:
    """The signed distance of the set where all sides are <= 0, if these are signed distances with
    gradients at right angles to each other.

    Proof. Outside, the nearest point is found in each of the directions by itself: the distance is
    the norm of the positive ones (Pythagoras); inside, the nearest side decides.
    """
    most = maximum(*sides)
    outside = norm(*(maximum(one, 0.0) for one in sides))
    both = outside + minimum(most, 0.0)
    if not isinstance(both, Jet):
        return both
    both = outside.selected(most.value.low > 0, both)
    return most.selected(most.value.high < 0, both)
