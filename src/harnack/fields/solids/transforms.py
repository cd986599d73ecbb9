"""Affine maps of solids: solids that are moved, rotated, scaled or sheared. An affine map takes a
point u to M u + b, with a matrix M (3, 3) and a vector b (3,). The preimage of a point p is the
point M^-1 (p - b), which the map takes to p. A similarity is a map that multiplies all lengths by
the same factor. The function f of the image of a solid, at p, is the function of the solid at the
preimage of p, times a factor."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.arithmetic import Jet, cos, norm, sin
from harnack.backend.elementary import max_norm, safe_norm
from harnack.backend.validation import (
    as_real,
    as_triple,
    check_no_derivatives,
)
from harnack.enclosures import Promise
from harnack.enclosures.extremum import ScaledEnclosure
from harnack.enclosures.samples import Ray, RaySample, Sample
from harnack.fields.attached_numbers import attached, own_formula
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.formula import with_device_numbers
from harnack.fields.formula_evaluator import (
    FormulaEvaluator,
    FormulaFunction,
    as_jet,
    hessian_error,
)
from harnack.fields.number_table import (
    NumberReader,
    NumberTable,
    detached,
    is_attached_number,
    plain_numbers,
)
from harnack.fields.parameters import Parametrized
from harnack.fields.solids.solid import (
    EvaluatorOfInner,
    Solid,
    SolidOfField,
    SpaceMap,
    axis_index,
    formula_of,
    without_levels,
)
from harnack.geometry import Ball, Box, ConvexHull

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real, Vec3
    from harnack.geometry import Volume


@dataclass(frozen=True)
class AffineMap(SpaceMap, Parametrized):
    """The affine map u -> matrix u + translation_vector, in double precision, which can be applied
    to solids.

    matrix: (3, 3), row by row, not singular.
    translation_vector: (3,).
    value_factor: the factor by which the function of a solid is multiplied. For a similarity (a map
        that multiplies all lengths by the same factor) it is that factor, so that a distance stays
        a distance; for other maps it is 1. For a composition of maps it is the product of their
        factors.
    attached: the numbers with derivatives that the map was made of; None if there are none.
    """

    matrix: tuple[tuple[float, ...], ...]
    translation_vector: tuple[float, ...]
    value_factor: float
    attached: _AttachedNumbers | None = dataclasses.field(default=None, repr=False, compare=False)

    @classmethod
    def of_arrays(cls, matrix: npt.ArrayLike, offset: npt.ArrayLike = (0.0, 0.0, 0.0)) -> AffineMap:
        """The map u -> matrix u + offset.

        Raises:
            ValueError: arrays of other shapes than (3, 3) and (3,), numbers that are not finite, or
                a singular matrix.
        """
        m, b = np.asarray(matrix, dtype=np.float64), np.asarray(offset, dtype=np.float64)
        if m.shape != (3, 3) or b.shape != (3,):
            raise ValueError(
                f"a map needs a matrix (3, 3) and an offset (3,), not {m.shape}, {b.shape}"
            )
        if not (np.isfinite(m).all() and np.isfinite(b).all()):
            raise ValueError("matrix and offset must be finite")
        # A map whose smallest singular value is relatively tiny counts as singular.
        sizes = np.linalg.svd(m, compute_uv=False)
        if not sizes[-1] > 1e-12 * sizes[0]:
            raise ValueError(
                f"the matrix is singular (singular values {sizes[0]:g} to {sizes[-1]:g}): it would "
                "flatten the solid"
            )
        # Functions of solids are multiplied by the factor of lengths; by 1 if there is none.
        rows = tuple(tuple(float(number) for number in row) for row in m)
        return cls(rows, tuple(float(number) for number in b), _length_factor(m) or 1.0)

    @classmethod
    def of_matrix(cls, matrix: npt.ArrayLike) -> AffineMap:
        """The linear map with a matrix (3, 3); or the affine map with a matrix (3, 4), whose last
        column is the translation, or (4, 4), whose last row must be (0, 0, 0, 1).

        Raises:
            ValueError: as `of_arrays`, or another last row.
        """
        if is_attached_number(matrix, "a map of space"):
            own = _AttachedNumbers({"of": matrix}, _inverse_of_matrix)
            return replace(cls.of_matrix(own.values["of"]), attached=own)
        m = np.asarray(detached(matrix), dtype=np.float64)
        if m.shape == (4, 4):
            if not np.array_equal(m[3], (0.0, 0.0, 0.0, 1.0)):
                raise ValueError(f"the last row of a (4, 4) map must be (0, 0, 0, 1), not {m[3]}")
            m = m[:3]
        if m.shape == (3, 4):
            return cls.of_arrays(m[:, :3], m[:, 3])
        return cls.of_arrays(m)

    @classmethod
    def translation(cls, offset: Sequence[float]) -> AffineMap:
        """The translation u -> u + offset."""
        if is_attached_number(offset, "an offset"):
            plain = cls.of_arrays(np.eye(3), as_triple(detached(offset), "offset"))
            return replace(
                plain, attached=_AttachedNumbers({"moved": offset}, _inverse_translation)
            )
        offset = detached(offset)
        if np.shape(offset) != (3,):
            raise ValueError(f"offset (3,): give a vector (x, y, z), not {offset!r}")
        return cls.of_arrays(np.eye(3), np.asarray(offset, dtype=np.float64))

    @classmethod
    def of_steps(cls, steps: Sequence[float], period: Any, offset: Sequence[float]) -> AffineMap:
        """The translation by `offset`, so many steps of a period with derivatives along each of its
        vectors (`Solid.repeated`)."""
        own = _AttachedNumbers({"period": period}, functools.partial(_inverse_of_steps, steps))
        return replace(cls.of_arrays(np.eye(3), offset), attached=own)

    @classmethod
    def reflection(cls, unit: FloatArray, distance: float) -> AffineMap:
        """The reflection at the plane n . x = distance with the unit vector n."""
        return cls.of_arrays(np.eye(3) - 2 * np.outer(unit, unit), 2 * distance * unit)

    def with_mirror(self, normal: Any, offset: Any) -> AffineMap:
        """This reflection with numbers that have derivatives. normal: (3,) of any length."""
        own = _AttachedNumbers({"normal": normal, "mirror": offset}, _inverse_reflection)
        return replace(self, attached=own)

    @classmethod
    def rotation(cls, degrees: float, axis: str | Sequence[float]) -> AffineMap:
        """The rotation about an axis through the origin by an angle in degrees, counter-clockwise
        as seen from the positive end of the axis. The matrix is computed by Rodrigues' formula.

        axis: "x", "y", "z" or a vector (3,).
        """
        is_attached = is_attached_number((degrees, axis), "a rotation")
        is_name = isinstance(axis, str)
        vector = np.eye(3)[axis_index(axis)] if is_name else plain_numbers(axis)
        length = np.linalg.norm(vector) if vector.shape == (3,) else 0.0
        if not (np.isfinite(length) and length > 0):
            raise ValueError(
                "axis must be a vector (3,) that is not zero, or one of x, y, z, not "
                f'{axis!r}: write rotated(degrees, axis), such as rotated(30, "x")'
            )
        # Rodrigues' formula: I + sin(angle) k + (1 - cos(angle)) k^2, with k the matrix of the
        # cross product with the axis.
        plain_degrees = as_real(degrees, "the angle of a rotation")
        angle = math.radians(plain_degrees)
        k = np.cross(np.eye(3), vector / length)  # k v = unit x v
        turn = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * (k @ k)
        if not is_attached:
            return cls.of_arrays(turn)
        arguments = {"degrees": degrees, "axis": vector if is_name else axis}
        own = _AttachedNumbers(arguments, _inverse_rotation)
        return replace(cls.of_arrays(turn), attached=own)

    @classmethod
    def scaling(cls, factors: float | Sequence[float]) -> AffineMap:
        """The scaling u -> factors u, by one positive factor, or by one for each axis."""
        if is_attached_number(factors, "a scaling"):
            own = _AttachedNumbers({"scaled": factors}, _inverse_scaling)
            return replace(cls.scaling(cast("Any", np.squeeze(own.values["scaled"]))), attached=own)
        sizes = np.asarray(detached(factors), dtype=np.float64)
        # Any other shape becomes NaN, which is refused below.
        sizes = np.broadcast_to(sizes if sizes.shape in ((), (3,)) else np.nan, (3,))
        if not (np.isfinite(sizes).all() and (sizes > 0).all()):
            raise ValueError(f"factors must be positive numbers, one or three, not {factors!r}")
        return cls.of_arrays(np.diag(sizes))

    def constructor_arguments(self) -> dict[str, Any]:
        """The arguments of `of_arrays`."""
        arguments: dict[str, Any] = {"matrix": self.matrix, "offset": self.translation_vector}
        own = self.attached
        return arguments if own is None else {**arguments, **own.arguments}

    @property
    def alike_key(self) -> tuple[Any, ...] | None:
        """What maps have in common that are computed alike of their numbers; None for those that
        are computed in another way than all others."""
        own = self.attached
        if own is None:
            return ("affine",)
        if isinstance(own.inverse, functools.partial):
            return None
        return (own.inverse, *own.arguments, *map(np.shape, own.values.values()))

    def replace(self, **changes: Any) -> AffineMap:
        """The map of another matrix or offset, by `of_arrays`. The factor of values changes as that
        of the matrices does."""
        check_no_derivatives("an AffineMap", changes, self.constructor_arguments())
        old = AffineMap.of_arrays(self.matrix, self.translation_vector)
        new = AffineMap.of_arrays(**(self.constructor_arguments() | changes))
        return replace(new, value_factor=self.value_factor / old.value_factor * new.value_factor)

    def apply(self, solid: Solid) -> Solid:
        """The image of a solid under this map. If the solid is itself the image of another under an
        affine map, the two maps are composed to one."""
        is_plain = self.attached is None
        if isinstance(solid, TransformedSolid) and is_plain and solid.map.attached is None:
            m, b = np.array(self.matrix), np.array(self.translation_vector)
            inner = solid.map
            total = AffineMap.of_arrays(
                m @ np.array(inner.matrix), m @ np.array(inner.translation_vector) + b
            )
            return TransformedSolid(
                solid.field, replace(total, value_factor=self.value_factor * inner.value_factor)
            )
        return TransformedSolid(solid, self)

    @property
    def is_identity(self) -> bool:
        """Whether the map leaves all points where they are."""
        identity = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        return (
            self.attached is None and self.matrix == identity and not any(self.translation_vector)
        )

    @property
    def inverse(self) -> FloatArray:
        """The inverse of the matrix."""
        return np.linalg.inv(np.array(self.matrix))

    @property
    def similarity(self) -> float | None:
        """The factor by which the map multiplies all lengths; None if it multiplies them by
        different factors."""
        return _length_factor(np.array(self.matrix))

    def volume(self, volume: Volume | None) -> Volume | None:
        """A volume that contains the image of `volume` under the map: a ball for a ball and a
        similarity; else the image of its box, which is a box if the map takes coordinate axes to
        such, and a convex hull if not. None if `volume` is None or unbounded. It is enlarged a
        little for rounding."""
        if volume is None:
            return None
        m, b = np.array(self.matrix), np.array(self.translation_vector)
        factor = self.similarity
        if isinstance(volume, Ball) and factor is not None:
            center = m @ np.array(volume.center) + b
            pad = 1e-12 * (np.abs(center).max() + factor * volume.radius)
            return Ball(
                (float(center[0]), float(center[1]), float(center[2])), factor * volume.radius + pad
            )
        lower, upper = volume.bounds()
        if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
            return None
        # The image of a box is the convex hull of the images of its corners.
        corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True)), axis=-1).reshape(-1, 3)
        image = corners @ m.T + b
        if ((m != 0).sum(axis=0) == 1).all():
            slack = 1e-12 * float(np.abs(image).max())
            return Box(tuple(image.min(axis=0) - slack), tuple(image.max(axis=0) + slack))
        return ConvexHull.from_points(image).padded(1e-12 * float(np.abs(image).max()))


def _length_factor(m: FloatArray) -> float | None:
    """The factor by which the linear map with the matrix m (3, 3) multiplies all lengths; None if
    it multiplies them by different factors. If there is such a factor, m^T m is factor^2 times the
    identity matrix, and |det m| is factor^3."""
    factor = abs(float(np.linalg.det(m))) ** (1 / 3)
    deviation = np.abs(m.T @ m - factor**2 * np.eye(3)).max()
    return factor if deviation <= 1e-14 * factor**2 else None


@dataclass(frozen=True, eq=False)
class TransformedSolid(SolidOfField):
    """The image of a solid, the inner solid, under an affine map u -> M u + b. f at p is the inner
    solid's function at the preimage M^-1 (p - b), times the map's `value_factor`. Along a ray, the
    inner solid is sampled along the straight line of the preimages.

    Proof. The ray o + t d is the image of the straight line M^-1 (o - b) + t M^-1 d, along which
    the inner solid is sampled. A length on the ray is |M^-1 d| times as large on that line
    (`ScaledEnclosure`). The coordinates on the line are rounded by a few units in the last place of
    the sum of the absolute values of their terms; this enters the error of the value.

    inverse_map: the inverse of the map, in Python numbers.
    """

    traits = dataclasses.replace(SolidOfField.traits, differentiable_arguments=("field", "map"))

    field: Solid
    map: AffineMap
    inverse_map: _InverseMap = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Set the attributes that follow from the inner solid and from the map: the domain, the
        Lipschitz constant, and the settings for the tracer.

        Raises:
            ValueError: the domain of the inner solid has no bounds.
        """
        self._copy_settings()
        # The domain is mapped; a domain without bounds cannot be.
        domain = self.map.volume(self.field.domain)
        if self.field.domain is not None and domain is None:
            raise ValueError(
                f"the domain {self.field.domain} of the solid has no bounds and cannot be mapped: "
                "cut the field by a volume that has"
            )
        object.__setattr__(self, "domain", domain)
        numbers = _InverseMap.of(self.map)
        object.__setattr__(self, "inverse_map", numbers)
        # Preimages are at most `stretch` times as far apart as the points, so slopes grow by that
        # factor.
        constant = self.field.lipschitz
        lipschitz = None if constant is None else constant * numbers.stretch * numbers.factor
        object.__setattr__(self, "lipschitz", lipschitz)
        if (wavelength := self.field.traits.min_wavelength) is not None:
            traits = dataclasses.replace(self.traits, min_wavelength=wavelength / numbers.stretch)
            object.__setattr__(self, "traits", traits)

    def with_read_numbers(self, numbers: NumberReader) -> TransformedSolid:
        """The copy whose formula has the attached numbers of the inner solid and of the map."""
        other = copy.copy(self)
        object.__setattr__(other, "field", attached(self.field, numbers))
        own, plain = self.map.attached, self.inverse_map
        if own is not None:
            plain = own.inverse(plain, own, numbers)
        elif not isinstance(numbers, NumberTable):
            plain = plain.read_by(numbers)
        object.__setattr__(other, "inverse_map", plain)
        return other

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        inner_level = level / self.map.value_factor
        return self.map.volume(self.field.sublevel_extent(inner_level, above=above))

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        return _TransformedSolidEvaluator(
            self.field.evaluator(backend, without_levels(plan)),
            self.inverse_map.on_backend(backend),
            is_similarity=self.map.similarity is not None,
        )

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return _formula_of_image(own_formula(self.field), self.inverse_map, x, y, z)


@dataclass(frozen=True, eq=False)
class _AttachedNumbers:
    """Numbers that an affine map was made of, some of which have derivatives.

    arguments: the numbers, by names.
    inverse: makes the inverse map of them, from that without derivatives.
    values: the numbers without derivatives.
    """

    arguments: dict[str, Any]
    inverse: Callable[[_InverseMap, _AttachedNumbers, NumberReader], _InverseMap]
    values: dict[str, FloatArray] = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        values = {name: plain_numbers(value) for name, value in self.arguments.items()}
        object.__setattr__(self, "values", values)

    def read(self, name: str, numbers: NumberReader) -> tuple[Any, ...]:
        """The numbers of an argument, as a reader gives them."""
        return numbers.vector(self.arguments[name], self.values[name].ravel().tolist())


def _inverse_translation(
    plain: _InverseMap, own: _AttachedNumbers, numbers: NumberReader
) -> _InverseMap:
    return replace(plain, translation_vector=own.read("moved", numbers))


def _inverse_rotation(
    plain: _InverseMap, own: _AttachedNumbers, numbers: NumberReader
) -> _InverseMap:
    """The inverse of a rotation: I - sin(angle) k + (1 - cos(angle)) k^2, where k is the matrix of
    the cross product with the unit vector u along the axis, and k^2 = u u^T - I."""
    angle = own.read("degrees", numbers)[0] * (math.pi / 180)
    vector = own.read("axis", numbers)
    length = norm(*vector)
    u = [component / length for component in vector]
    sine, versine = sin(angle), 1 - cos(angle)
    cross = ((0.0, -u[2], u[1]), (u[2], 0.0, -u[0]), (-u[1], u[0], 0.0))
    rows = tuple(
        tuple(
            (u[i] * u[j] - float(i == j)) * versine - cross[i][j] * sine + float(i == j)
            for j in range(3)
        )
        for i in range(3)
    )
    return replace(plain, rows=rows)


def _inverse_of_steps(
    steps: Sequence[float], plain: _InverseMap, own: _AttachedNumbers, numbers: NumberReader
) -> _InverseMap:
    """The inverse of a translation by `steps` of a period: a length for all axes, one for each, or
    three vectors."""
    period = own.read("period", numbers)
    if len(period) < 9:
        lengths = period * 3 if len(period) == 1 else period
        vector = tuple(a * s if s else 0.0 for a, s in zip(lengths, steps, strict=True))
    else:
        vector = tuple(_dot([period[3 * i + k] for i in range(3)], steps) for k in range(3))
    return replace(plain, translation_vector=vector)


def _inverse_reflection(
    plain: _InverseMap, own: _AttachedNumbers, numbers: NumberReader
) -> _InverseMap:
    """The inverse of a reflection, which is the reflection itself."""
    normal = own.read("normal", numbers)
    length = norm(*normal)
    u = [component / length for component in normal]
    distance = own.read("mirror", numbers)[0]
    rows = tuple(tuple(u[i] * u[j] * -2.0 + float(i == j) for j in range(3)) for i in range(3))
    return replace(plain, rows=rows, translation_vector=tuple(2.0 * distance * n for n in u))


def _inverse_scaling(
    plain: _InverseMap, own: _AttachedNumbers, numbers: NumberReader
) -> _InverseMap:
    """The inverse of a scaling. With a factor for each axis, the factor of the function is
    constant: 1 or, where all three are equal, that number."""
    scales = own.read("scaled", numbers)
    factor = scales[0] if len(scales) == 1 else plain.factor
    scales = scales * 3 if len(scales) == 1 else scales
    rows = tuple(tuple(1 / scales[i] if i == j else 0.0 for j in range(3)) for i in range(3))
    return replace(plain, rows=rows, factor=factor)


def _inverse_of_matrix(
    plain: _InverseMap, own: _AttachedNumbers, numbers: NumberReader
) -> _InverseMap:
    """The inverse of a map by its matrix (3, 3), (3, 4) or (4, 4), with Cramer's rule. The factor
    of the function is constant."""
    entries, step = own.read("of", numbers), own.values["of"].shape[1]
    m = [entries[step * k : step * k + step] for k in range(3)]
    # The columns of the inverse are the cross products of rows over the determinant.
    columns = [_cross(m[(k + 1) % 3], m[(k + 2) % 3]) for k in range(3)]
    determinant = _dot(m[0], columns[0])
    rows = tuple(tuple(columns[j][i] / determinant for j in range(3)) for i in range(3))
    vector = tuple(row[3] for row in m) if step == 4 else plain.translation_vector
    return replace(plain, rows=rows, translation_vector=vector)


def _cross(a: Sequence[Any], b: Sequence[Any]) -> tuple[Any, Any, Any]:
    """The cross product of two vectors."""
    x, y, z = (a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3] for i in range(3))
    return x, y, z


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    """The scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _formula_of_image(
    formula: FormulaFunction, numbers: _InverseMap, x: Any, y: Any, z: Any
) -> Any:
    """The function of the image of a solid under an affine map.

    formula: the function of the solid.
    numbers: the inverse of the map.
    x, y, z: the coordinates, numbers of any arithmetic.
    """
    return formula(*numbers.local(x, y, z)) * numbers.factor


@dataclass(frozen=True, eq=False)
class _TransformedSolidEvaluator(EvaluatorOfInner):
    """The evaluator of a `TransformedSolid`, from that of the inner solid.

    numbers: the inverse map, on the backend.
    is_similarity: whether the map multiplies all lengths by the same factor.
    """

    numbers: _InverseMap
    is_similarity: bool

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates that are numbers of any arithmetic."""
        return _formula_of_image(formula_of(self.inner), self.numbers, x, y, z)

    def evaluate(self, p: Vec3) -> Sample:
        local = type(p)(*self.numbers.local(p.x, p.y, p.z))
        return self._image_sample(self.inner.evaluate(local), self._term_bound(p, 0.0))

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian of f at p: of M^-T H M^-1 times the map's `value_factor`,
        where H is the Hessian of the inner solid at the preimage of p."""
        numbers = self.numbers
        rows = self.inner.hessian(type(p)(*numbers.local(p.x, p.y, p.z)))
        # `pull_back` multiplies a vector by M^-T. Applied to each row of H it gives the rows of H
        # M^-1; applied to the columns of that, M^-T H M^-1, which is symmetric.
        columns = [numbers.pull_back(row) for row in rows]
        product = [numbers.pull_back(type(p)(*(columns[j][k] for j in range(3)))) for k in range(3)]
        x, y, z = (vector * numbers.factor for vector in product)
        return x, y, z

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """Two error bounds at p, of the gradient and of the Hessian. For an inner solid with a
        formula they follow from the ranges of the formula. For any other inner solid they are its
        own bounds at the preimage of p, scaled; these leave out the effect of the preimage's
        rounding on the derivatives, since no bound of that effect is known.

        sample: the sample of f at p; not used.
        """
        del sample
        numbers = self.numbers
        local = type(p)(*numbers.local(p.x, p.y, p.z))
        first, second = self.inner.derivative_errors(local, self.inner.evaluate(local))
        # The gradient is multiplied by M^-T and the factor, the Hessian by M^-T twice.
        first = first * numbers.stretch * numbers.factor
        if not isinstance(self.inner, FormulaEvaluator):
            return first, second * numbers.stretch * numbers.stretch * numbers.factor
        coordinates = Jet.at_point(p, order=2)
        jet = as_jet(self.formula(*coordinates), coordinates[0], self.inner.name)
        # The gradient of the inner solid need not be the middle of its range
        # (`FormulaEvaluator._with_one_sided_gradient`). So the half widths of the ranges are added
        # to its error.
        # p.x tells `hessian_error` the type of the result.
        return first + sum(rate.radius for rate in jet.first_derivatives), hessian_error(jet, p.x)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the point of a ray with parameter t, with enclosures (proved bounds of the
        change of f along the ray) in front of the point and behind it. It is made from the ray
        sample of the inner solid on the line of the preimages.

        path: the ray.
        ahead, back: the lengths in front of and behind the point up to which enclosures are useful.
        """
        numbers, vector = self.numbers, cast("Any", type(path.origin))
        o, d = path.origin, path.direction
        direction = vector(*numbers.local_direction(d.x, d.y, d.z))
        # The preimage moves by this length for each unit of length on the ray. The inner ray, the
        # line of the preimages, is given a unit direction; so lengths on the ray are multiplied by
        # the speed to become lengths on the inner ray.
        speed = safe_norm(direction)
        inner_ray = Ray(vector(*numbers.local(o.x, o.y, o.z)), direction / speed, path.proofs)
        ray_sample = self.inner.sample_ray(inner_ray, t * speed, ahead * speed, back * speed)
        sample = self._image_sample(ray_sample.sample, self._term_bound(o, t))

        def stretched(enclosures: tuple[Any, ...]) -> tuple[Any, ...]:
            """Return the enclosures along the ray, from the given enclosures along the line of the
            preimages: one for each."""
            return tuple(
                ScaledEnclosure(enclosure, speed, numbers.factor) for enclosure in enclosures
            )

        slope = ray_sample.slope * speed * numbers.factor
        forward, backward = stretched(ray_sample.forward), stretched(ray_sample.backward)
        error = (
            None
            if ray_sample.slope_error is None
            else ray_sample.slope_error * speed * numbers.factor
        )
        # `reach_growth` is a ratio of lengths, which the map does not change.
        return RaySample(sample, forward, backward, slope, ray_sample.reach_growth, error)

    def _term_bound(self, p: Vec3, t: Real) -> Real:
        """A bound of the absolute values of the terms in the sums that are the coordinates of the
        preimage of p + t d, for any unit direction d. The rounding error of the preimage is
        proportional to it."""
        numbers = self.numbers
        # By Cauchy-Schwarz: no row of M^-1 is longer than the stretch, and a vector is at most
        # sqrt(3) times as long as its largest component.
        return numbers.stretch * (max_norm(p) + numbers.offset_size + t) * math.sqrt(3)

    def _image_sample(self, sample: Sample, term_bound: Real) -> Sample:
        """The sample of the image at a point, from the sample of the inner solid at the preimage of
        the point.

        term_bound: a bound of the terms in the preimage's coordinates (`_term_bound`), for the
            rounding error.
        """
        numbers = self.numbers
        epsilon = 2 * float(dr.epsilon(type(sample.value)))  # the machine epsilon
        # The change of the inner function by the rounding of the preimage.
        rounding = 8 * epsilon * term_bound * safe_norm(sample.gradient)
        factor, stretch = numbers.factor, numbers.stretch

        def image_of_promise(promise: Promise) -> Promise:
            """A proved bound of the image's function near the point, from a proved bound of the
            inner solid's function. If the map is no similarity, harmonic functions do not stay
            harmonic; so a bound that holds for harmonic functions is weakened first."""
            if not self.is_similarity:
                promise = promise.weakened_for_linear_maps(sample.value)
            return promise.scaled(factor).linearly_mapped(stretch)

        # By the chain rule gradients are multiplied by M^-T.
        return sample.map_promises(
            image_of_promise,
            value=sample.value * factor,
            gradient=numbers.pull_back(sample.gradient) * factor,
            value_error=(sample.value_error + rounding) * factor,
            gradient_error=sample.gradient_error * factor * stretch,
            shading_normal=None,
            truncation_error=sample.truncation_error * factor,
            ray_promises=(),
        )


@dataclass(frozen=True)
class _InverseMap:
    """The inverse of an affine map u -> M u + b, in the form that kernels use: it takes a point p
    to its preimage M^-1 (p - b).

    rows: the rows of M^-1.
    translation_vector: b.
    stretch: the largest singular value of M^-1, rounded up: a bound of how much the inverse map
        stretches lengths.
    factor: the factor by which the function f of a solid is multiplied.
    offset_size: the largest absolute value of a component of b.
    """

    rows: tuple[tuple[Any, ...], ...]
    translation_vector: tuple[Any, ...]
    stretch: Any
    factor: Any
    offset_size: Any

    @classmethod
    def of(cls, change: AffineMap) -> _InverseMap:
        """The inverse of the affine map `change`, in Python numbers."""
        inverse = change.inverse
        # The first singular value is the largest.
        stretch = float(np.linalg.svd(inverse, compute_uv=False)[0]) * (1 + 1e-6)
        # The last number, the largest component of the translation, is for the rounding.
        return cls(
            tuple(tuple(float(number) for number in row) for row in inverse),
            change.translation_vector,
            stretch,
            change.value_factor,
            float(np.abs(change.translation_vector).max()),
        )

    def on_backend(self, backend: Backend) -> _InverseMap:
        """The same map with the entries of its matrix and its vector as kernel parameters of the
        backend (numbers that a compiled kernel reads when it runs). Entries that are 0 or 1 stay
        Python numbers: then their terms or products are left out of the kernel, which saves most of
        the work."""
        parameters = with_device_numbers(self, backend)
        # The three rows and, as a fourth, the translation.
        rows = tuple(
            tuple(a if a in (0.0, 1.0) else b for a, b in zip(old, new, strict=True))
            for old, new in zip(
                (*self.rows, self.translation_vector),
                (*parameters.rows, parameters.translation_vector),
                strict=True,
            )
        )
        return replace(parameters, rows=rows[:3], translation_vector=rows[3])

    def read_by(self, numbers: NumberReader) -> _InverseMap:
        """The same map with its numbers as a reader gives them."""
        rows = tuple(numbers.vector(None, row) for row in self.rows)
        vector = numbers.vector(None, self.translation_vector)
        factor = numbers.vector(None, [self.factor])[0]
        return replace(self, rows=rows, translation_vector=vector, factor=factor)

    def local(self, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
        """The three coordinates of M^-1 (p - b), the preimage of the point p = (x, y, z).
        Coordinates may be numbers of any arithmetic."""
        a, b, c = (
            coordinate if _is_literal(shift, 0.0) else coordinate - shift
            for coordinate, shift in zip((x, y, z), self.translation_vector, strict=True)
        )
        return self.local_direction(a, b, c)

    def local_direction(self, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
        """The three components of M^-1 d, the preimage of a direction d = (x, y, z)."""
        u, v, w = (_weighted_sum(row, (x, y, z)) for row in self.rows)
        return u, v, w

    def pull_back(self, g: Vec3) -> Vec3:
        """The vector M^-T g. If g is the gradient of a function f, this is the gradient of f(M^-1
        p) by p."""
        columns = (tuple(row[i] for row in self.rows) for i in range(3))
        return type(g)(*(_weighted_sum(column, (g.x, g.y, g.z)) for column in columns))


def _weighted_sum(weights: tuple[Any, ...], terms: tuple[Any, ...]) -> Any:
    """The sum of the terms, each times its weight. A term whose weight is the Python number 0 is
    left out, and so is the multiplication by a weight that is the Python number 1. None if all
    terms are left out."""
    total: Any = None
    for weight, term in zip(weights, terms, strict=True):
        if _is_literal(weight, 0.0):
            continue
        product = term if _is_literal(weight, 1.0) else term * weight
        total = product if total is None else total + product
    return total


def _is_literal(x: Any, number: float) -> bool:
    """Whether x is a Python float that equals `number`; False for a kernel parameter, whose value
    is not known while a kernel is recorded."""
    return isinstance(x, float) and x == number
