"""Patterns: unions of copies of a solid, in rows, around an axis, mirrored, or at given places. A
copy is the image of the solid under an affine map."""

from __future__ import annotations

import itertools
import operator
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from harnack.backend.validation import as_finite, as_real_array, check_finite
from harnack.fields.number_table import NumberSlice, detached, is_attached_number
from harnack.fields.solids.booleans import union
from harnack.fields.solids.solid import axis_index
from harnack.fields.solids.transforms import AffineMap

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy.typing as npt

    from harnack.backend import FloatArray
    from harnack.fields.solids.solid import Solid


def union_of_images(solid: Solid, maps: Iterable[AffineMap]) -> Solid:
    """The union of the images of a solid under maps. The maps are at least one."""
    return union(
        solid if change.is_identity else solid.map_operands(change.apply) for change in maps
    )


def maps_of(transforms: npt.ArrayLike) -> list[AffineMap]:
    """The maps of `Solid.arranged`.

    Raises:
        ValueError: another shape, no map, numbers that are not finite, or a singular matrix.
    """
    name = "the transforms of an arrangement"
    is_attached = is_attached_number(transforms, name)
    plain: Any = detached(transforms)
    array = np.array(as_real_array(plain, name), dtype=np.float64)
    shape = array.shape
    is_vectors = len(shape) == 2 and shape[1] == 3
    is_matrices = len(shape) == 3 and shape[1:] in ((3, 3), (3, 4), (4, 4))
    if not (is_vectors or is_matrices):
        raise ValueError(
            f"{name} must be translations of shape (n, 3) or matrices of shape (n, 3, 3), "
            f"(n, 3, 4) or (n, 4, 4), not {shape}"
        )
    if not len(array):
        raise ValueError(f"{name} are none: give at least one")
    check_finite(array.reshape(len(array), -1), "transform {}", ValueError, "it must be finite")
    entries: list[Any] = array.tolist() if is_vectors else list(array)
    if is_attached:
        entries = _entries_of(transforms, array)
    make = AffineMap.translation if is_vectors else AffineMap.of_matrix
    return [make(entry) for entry in entries]


def _entries_of(values: Any, plain: FloatArray) -> list[Any]:
    """The entries of a list or of a Dr.Jit tensor (n, ...) with derivatives. plain: its values."""
    if isinstance(values, tuple | list):
        return [*cast("Any", values)]
    return [NumberSlice(values, entry, k * entry.size) for k, entry in enumerate(plain)]


def translations_of(period: Any, counts: Any) -> list[AffineMap]:
    """The maps of `Solid.repeated`.

    Raises:
        ValueError: a period of another shape, not finite, or 0 where there are several copies;
            counts that are not positive integers.
    """
    is_attached = is_attached_number(period, "the period")
    vectors = _period_vectors(detached(period))
    numbers = checked_counts(counts)
    for k, (vector, count) in enumerate(zip(vectors, numbers, strict=True)):
        if count > 1 and not vector.any():
            raise ValueError(f"period {k} is 0: {count} copies would be at the same place")
    steps = np.array([*itertools.product(*(range(count) for count in numbers))], np.float64)
    offsets = (steps @ vectors).tolist()
    if not is_attached:
        return [AffineMap.translation(offset) for offset in offsets]
    return [
        AffineMap.of_steps(step, period, offset) if any(step) else AffineMap.translation(offset)
        for step, offset in zip(steps.tolist(), offsets, strict=True)
    ]


def _period_vectors(period: Any) -> FloatArray:
    """The three vectors (3, 3), as rows, of a period: a number, three numbers or three vectors.

    Raises:
        ValueError: another shape, or numbers that are not finite.
    """
    array = np.array(as_real_array(period, "the period"), dtype=np.float64)
    if array.shape not in ((), (3,), (3, 3)):
        raise ValueError(
            f"the period must be a number, three numbers or three vectors (3, 3), not an array of "
            f"shape {array.shape}"
        )
    if not np.isfinite(array).all():
        raise ValueError(f"the period must be finite, not {period!r}")
    return array if array.ndim == 2 else np.diag(np.broadcast_to(array, (3,)))


def checked_counts(counts: Any) -> tuple[int, int, int]:
    """Counts along three directions: one positive integer for all, or three.

    Raises:
        ValueError: other numbers.
    """
    try:
        entries: tuple[Any, ...] = (counts,) * 3 if np.ndim(counts) == 0 else tuple(counts)
        numbers = [operator.index(entry) for entry in entries]
    except (TypeError, ValueError):  # lists of several lengths, such as one with a Dr.Jit array
        numbers = []
    if len(numbers) != 3 or min(numbers) < 1:
        raise ValueError(f"counts must be one or three positive integers, not {counts!r}")
    return numbers[0], numbers[1], numbers[2]


def mirror_image(solid: Solid, normal: str | Sequence[float], offset: float) -> Solid:
    """The mirror image of a solid at the plane n . x = offset, where n is the unit vector along
    `normal` (`Solid.mirrored`)."""
    is_attached = is_attached_number((normal, offset), "a mirror")
    plain: Any = detached(normal)
    unit = _unit_vector(plain)
    distance = as_finite(offset, "the offset of the mirror")
    change = AffineMap.reflection(unit, distance)
    if is_attached:
        change = change.with_mirror(unit if isinstance(normal, str) else normal, offset)
    return solid.map_operands(change.apply)


def _unit_vector(normal: str | Sequence[float]) -> FloatArray:
    """The unit vector along a coordinate axis "x", "y" or "z", or along a vector (3,), not 0.

    Raises:
        ValueError: another name, or no such vector.
    """
    if isinstance(normal, str):
        return np.eye(3)[axis_index(normal)]
    vector = np.asarray(normal, dtype=np.float64)
    length = float(np.linalg.norm(vector)) if vector.shape == (3,) else 0.0
    if not (np.isfinite(length) and length > 0):
        raise ValueError(
            f'the normal of a mirror must be "x", "y", "z" or a vector (3,) that is not zero, not '
            f"{normal!r}"
        )
    return vector / length


def rotations_of(count: Any, axis: str | Sequence[float]) -> list[AffineMap]:
    """The maps of `Solid.around`.

    Raises:
        ValueError: a count that is not a positive integer, or no axis.
    """
    try:
        number = operator.index(count)
    except TypeError:
        number = 0
    if number < 1:
        raise ValueError(
            f"the count of copies around an axis must be a positive integer, not {count!r}"
        )
    return [AffineMap.rotation(360.0 * k / number, axis) for k in range(number)]
