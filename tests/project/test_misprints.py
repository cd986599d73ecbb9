"""What is wrong as printed in the papers that the library builds on: a counter-example for each.

The table is in docs/misprints.md. Everything here is plain NumPy.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.fields.solids.primitives import lipschitz_of_norms


def test_equation_16_a_union_of_distances_is_a_bound_only_inside() -> None:
    """Unit discs at -1/2 and 1/2: their boundary is sqrt(3)/2 from the middle, and not 1/2."""
    centers = np.array([[-0.5, 0.0], [0.5, 0.0]])
    a = np.linspace(0, 2 * math.pi, 100_001)
    circle = np.stack([np.cos(a), np.sin(a)], 1)
    rim = np.concatenate([circle + c for c in centers])
    outer = rim[np.linalg.norm(rim[:, None] - centers, axis=2).min(1) >= 1 - 1e-9]
    assert np.linalg.norm(outer, axis=1).min() == pytest.approx(math.sqrt(0.75), abs=1e-4)
    assert min(1 - np.linalg.norm(centers, axis=1)) == 0.5


def test_equation_21_convexity_needs_a_convex_function() -> None:
    """f = 1 - exp(-d) is a distance bound of a ball, but lies below its tangents."""

    def f(t: Any) -> Any:  # along a ray towards the unit sphere from a distance of 3
        return 1 - np.exp(-(3.0 - t))

    slope = -math.exp(-3.0)
    step = f(0.0) / -slope  # where the tangent reaches 0
    assert step > 3.0  # past the surface

    def quadric(t: Any) -> Any:
        return (4.0 - t) ** 2 - 1

    t = np.linspace(0, 3, 100)
    assert (quadric(t) >= quadric(0.0) - 8 * t - 1e-12).all()


def test_theorem_2_convergence_is_slower_at_double_roots() -> None:
    """f = t^2/4 near 0 from t = 1, with the constant 1/2: t_n is about 2/n."""
    t, errors = 1.0, []
    for _ in range(4000):
        t -= (t * t / 4) / 0.5
        errors.append(t)
    assert errors[3999] * 4000 == pytest.approx(2.0, rel=0.01)
    assert errors[3999] / errors[3998] > 0.999  # no linear rate


def test_equation_22_the_inner_cover_is_where_f_is_minus_the_radius() -> None:
    """Of a sphere, points within r_p of the outside have f > -r_p; f = r_p lies outside."""
    r_p = 0.1
    inner = hk.Sphere(1.0)
    for radius, covered in ((1.0 + r_p, False), (1.0 - r_p, True)):
        value = inner.value([[radius, 0.0, 0.0]], precision="double")[0]
        inside = radius + r_p <= 1.0 + 1e-12  # its whole cone is inside
        assert inside == covered == (value <= -r_p + 1e-12)


def test_equation_29_the_largest_norm_is_of_absolute_values() -> None:
    x, y = -3.0, 1.0
    assert hk.math.norm(x, y, p=math.inf) == 3.0 != max(x, y)
    assert hk.math.norm(x, y, p=200.0) == pytest.approx(3.0, rel=1e-6)


@pytest.mark.parametrize(("p", "q"), [(1.0, 4.0), (4.0, 1.2), (1.2, 1.6)])
def test_equation_31_the_constant_of_pq_norms(p: float, q: float) -> None:
    """Hart's radius comes from the norm at (1, 1, 1)/sqrt(3): other points are steeper."""
    printed = np.linalg.norm([np.linalg.norm([3**-0.5] * 2, p), 3**-0.5], q) if p < 2 else 1.0
    rng = np.random.default_rng(0)
    u = rng.normal(size=(200_000, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    # The norm of a unit vector is its value over a distance of 1 from 0: a slope.
    values = np.linalg.norm(np.stack([np.linalg.norm(u[:, :2], p, axis=1), u[:, 2]], 1), q, axis=1)
    assert values.max() > 1.01 * printed
    assert 0.99 * lipschitz_of_norms(p, q) < values.max() <= lipschitz_of_norms(p, q)


def test_equation_31_powers_just_below_2() -> None:
    """At (1, 1, 0)/sqrt(2) the norm is sqrt(2); for q < 2 points near it are hardly steeper."""
    for q in (1.9995, math.nextafter(2.0, 0.0)):
        assert lipschitz_of_norms(1.0, q) == pytest.approx(2**0.5, rel=1e-15)
    assert lipschitz_of_norms(1.0, 1.0) == pytest.approx(3**0.5, rel=1e-15)
    assert lipschitz_of_norms(4.0, 1.25) == pytest.approx(2**0.3, rel=1e-15)
    assert hk.solids.Superellipsoid((1.0, 1.9995)).lipschitz >= 2**0.5


def test_equation_34_the_normal_is_no_unit_vector() -> None:
    u, v = np.array([1.0, 0.0, 0.0]), np.array([1.0, 1.0, 0.0])
    printed = np.cross(u / np.linalg.norm(u), v / np.linalg.norm(v))
    right = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    assert np.linalg.norm(printed) == pytest.approx(math.sqrt(0.5))
    assert np.linalg.norm(right) == pytest.approx(1.0)


def soft(r: Any, radius: float) -> Any:
    return np.where(r < radius, 2 * (r / radius) ** 3 - 3 * (r / radius) ** 2 + 1, 0)


def test_equation_38_the_constants_of_a_sum_add_up() -> None:
    """Two key points: (2/3) f times the sum of the radii is beyond the surface; f over the sum of
    the constants 3/(2 R) is not."""
    radii, places, threshold = (1.0, 3.0), (0.0, 3.0), 0.5
    x = np.linspace(-1.5, 6.0, 60_001)
    f = threshold - sum(soft(np.abs(x - c), r) for c, r in zip(places, radii, strict=True))
    surface = x[np.flatnonzero(np.diff(np.sign(f)))]
    outside = f > 0
    distance = np.abs(x[:, None] - surface).min(1)
    assert (2 / 3 * f * sum(radii) > distance + 0.1)[outside].any()
    right = f / sum(1.5 / r for r in radii)
    assert (right <= distance + 1e-3)[outside].all()


def test_equation_38_no_sum_over_the_points_that_count_here() -> None:
    """Where no support reaches, the constant of those that count is 0 and any step is allowed; the
    largest rho with rho lambda(rho) <= f, over supports that meet the ball, stops ahead of it."""
    start, radius, threshold = 2.0, 1.0, 0.3
    f = threshold - float(soft(start, radius))
    t = np.linspace(0, start, 20_001)
    surface = t[np.argmax(threshold - soft(start - t, radius) <= 0)]
    constant = np.where(t > start - radius, 1.5 / radius, 0.0)  # of supports that meet the ball
    safe = t[t * constant <= f].max()
    assert constant[0] == 0.0
    assert safe < surface


def test_equation_39_the_slope_of_the_cubic() -> None:
    """C' has r^2/R^3 and r/R^2 with the factor 6; the largest is 3/(2R), in the middle."""
    for radius in (0.5, 2.0):
        r = np.linspace(0, radius, 100_001)
        slope = np.abs(np.gradient(soft(r, radius), r))
        assert slope.max() == pytest.approx(1.5 / radius, rel=1e-4)


def printed_blend(a: Any, b: Any, r_a: float, r_b: float, p: float) -> Any:
    g_a, g_b = np.maximum(1 - a / r_a, 0), np.maximum(1 - b / r_b, 0)
    weight = (g_a * r_a + g_b * r_b) / (g_a + g_b)
    return weight * (1 - g_a**p - g_b**p), weight * (1 - (g_a**p + g_b**p) ** (1 / p))


def test_equation_43_the_root_is_around_the_sum_alone() -> None:
    """On the surface of one solid, far from the other, f must be the value of that one."""
    a, far = np.array([0.3]), np.array([9.0])
    inner, right = printed_blend(a, far, 0.5, 0.5, 2.0)
    assert right[0] == pytest.approx(0.3)
    assert abs(inner[0] ** 0.5 - 0.3) > 0.1


def test_equation_43_two_radii_make_a_jump() -> None:
    """Towards g = 0 the weight is r_a along one side and r_b along the other."""
    tiny = 1e-9
    along_a = printed_blend(np.array(1.0 - tiny), np.array(9.0), 1.0, 0.5, 2.0)[1]
    along_b = printed_blend(np.array(9.0), np.array(0.5 - tiny), 1.0, 0.5, 2.0)[1]
    assert along_a == pytest.approx(1.0, abs=1e-6)
    assert along_b == pytest.approx(0.5, abs=1e-6)


def test_linear_maps_need_singular_values() -> None:
    """A shear has the eigenvalues 1 and the largest singular value 1.618; power iteration of A^T A
    nears it from below, so that no number of rounds is safe."""
    shear = np.array([[1.0, 1.0], [0.0, 1.0]])
    assert np.abs(np.linalg.eigvals(shear)).max() == pytest.approx(1.0)
    largest = np.linalg.norm(shear, 2)
    assert largest == pytest.approx((1 + math.sqrt(5)) / 2)
    v = np.array([1.0, 0.0])
    for _ in range(3):
        v = shear.T @ shear @ v
        v /= np.linalg.norm(v)
        assert np.linalg.norm(shear @ v) < largest


def test_equation_49_the_constant_of_a_taper() -> None:
    """f = x of a plane x/r(z) = 1/2 with r = 1 - z/2: steeper than the least, or largest, 1/r."""
    z = np.linspace(0, 1, 1001)
    r, slope, rho = 1 - z / 2, 0.5, 1.0
    printed = (1 / r).min()
    gradient = np.hypot(1 / r, rho * slope / r)  # at x = rho r: x r'/r^2 = rho r'/r
    assert gradient.max() > 1.2 * printed
    k, m = 1 / r, rho * slope / r
    square = k**2 + m**2 + 1
    right = np.sqrt(0.5 * (square + np.sqrt(square**2 - 4 * k**2)))
    assert (gradient <= right + 1e-12).all()


def test_equation_51_the_constant_of_a_twist() -> None:
    """At rho = 1 and a' = 4 the map has the singular value 4.236; sqrt(4 + (pi/a')^2) is 2.15."""
    for rate in (0.5, 2.0, 4.0):
        jacobian = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, rate], [0.0, 0.0, 1.0]])
        largest = np.linalg.norm(jacobian, 2)
        assert largest == pytest.approx((rate + math.sqrt(rate**2 + 4)) / 2)
    assert largest > 1.9 * math.sqrt(4 + (math.pi / 4.0) ** 2)


def test_equation_53_dimension_of_fractal_noise() -> None:
    """With amplitudes 2^(-beta i) at frequencies 2^i, differences at a lag h grow like h^beta, the
    Hurst exponent, so that surfaces have D = 3 - beta: 2.5 and not 3.25 here."""
    beta, octaves = 0.5, 14
    rng = np.random.default_rng(1)
    phases = rng.uniform(0, 2 * math.pi, (200, octaves))

    def f(x: Any) -> Any:
        i = np.arange(octaves)
        return (2.0 ** (-beta * i) * np.sin(2.0**i * x[..., None] + phases)).sum(-1)

    x = rng.uniform(0, 100, 200)
    lags = 2.0 ** -np.arange(2.0, 10.0)
    rise = np.array([np.sqrt(np.mean((f(x + h) - f(x)) ** 2)) for h in lags])
    hurst = np.polyfit(np.log(lags), np.log(rise), 1)[0]
    assert hurst == pytest.approx(beta, abs=0.08)
    assert abs((3 - hurst) - (2 + (3 - beta) / 2)) > 0.5


def test_the_usual_estimate_of_julia_sets_is_no_bound() -> None:
    """|z| log|z| / (2 |z'|) of z^2 - 1: from points outside it is larger than the distance to a
    point of the filled Julia set, 0 for one."""
    for start in (1.9, 3.0, 10.0, 50.0):
        z, slope = complex(start), 1.0
        while abs(z) < 1e8:
            slope = 2 * abs(z) * slope
            z = z * z - 1
        estimate = abs(z) * math.log(abs(z)) / (2 * slope)
        golden = (1 + math.sqrt(5)) / 2  # the rightmost point of the filled set
        if start >= 10:
            assert estimate > start - golden


def hit_by(spheres: Any, origin: Any, direction: Any, *, printed: bool) -> float:
    """Sphere tracing of spheres by Hart's figure 6, as printed, or with the last travel taken off
    every distance and d_min made infinite before the loop over the objects."""
    last = t = 0.0
    known = [0.0] * len(spheres)
    least = math.inf
    for _ in range(3000):
        if not printed:
            least = math.inf
        if not printed:
            known = [one - last for one in known]
        for k, (*center, radius) in enumerate(spheres):
            if printed and known[k] - last > least:
                known[k] -= last
            elif printed or known[k] <= least:
                known[k] = math.dist(origin + t * direction, center) - radius
                least = min(least, known[k])
            if printed:
                last = least
        last = least
        if least < 1e-6 or t > 20:
            break
        t += least
    return t if least < 1e-6 else math.inf


def test_figure_6_of_the_triangle_inequality() -> None:
    rng = np.random.default_rng(2)
    wrong = {True: 0, False: 0}
    for _ in range(150):
        spheres = np.column_stack([rng.uniform(-2, 2, (6, 3)), rng.uniform(0.1, 0.6, 6)])
        origin = np.array([0.0, 0.0, -6.0])
        aim = rng.uniform(-1.5, 1.5, 3) - origin
        direction = aim / np.linalg.norm(aim)
        b = (spheres[:, :3] - origin) @ direction
        gap = spheres[:, 3] ** 2 - (np.sum((spheres[:, :3] - origin) ** 2, axis=1) - b * b)
        exact = np.where(gap > 1e-3, b - np.sqrt(np.maximum(gap, 0)), np.inf).min()
        if (np.abs(gap) <= 1e-3).any():
            continue  # grazes one
        for printed in wrong:
            found = hit_by(spheres, origin, direction, printed=printed)
            wrong[printed] += int(not (found == exact or abs(found - exact) < 1e-3))
    assert wrong[False] == 0
    assert wrong[True] > 5


def test_algorithm_1_of_forward_inclusion_needs_an_absolute_value() -> None:
    """f = -1 - t has no root, yet `eval < eps` registers one at every step; |eval| < eps none."""
    values = -1.0 - np.linspace(0, 5, 50)
    assert (values < 1e-3).all()
    assert not (np.abs(values) < 1e-3).any()
    # Equation 4: the step f/L is negative from the negative side, and goes back.
    assert values[0] / 1.0 < 0 < abs(values[0]) / 1.0


def test_figure_11_of_forward_inclusion_needs_a_square() -> None:
    """Kernels (1 - d^2/(r sigma)^2) are the same at all scales and 0 at the edge of the support."""
    for scale in (1.0, 3.0):
        r, sigma, d = 1.5 * scale, 1.2, 1.5 * 1.2 * scale
        assert 1 - d**2 / (r**2 * sigma**2) == pytest.approx(0.0)
        assert abs(1 - d / (r**2 * sigma**2)) > 0.1


def test_figure_9_of_forward_inclusion_stretches_no_falling_bounds() -> None:
    """F = 0 up to s = 1 and 1 - s behind it. The line through its ends on [1, 2] bounds it there;
    stretched to start at 0 it does not. Raised to max(0, .) it does."""
    s = np.linspace(0, 2, 201)
    f = np.where(s < 1, 0.0, 1 - s)
    stretched = -0.5 * s
    assert (f > stretched + 1e-12).any()
    assert (f <= np.maximum(stretched, 0)).all()
