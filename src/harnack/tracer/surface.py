"""`Surface`: the level sets of a field f (the points at which f takes given values, the levels), or
the boundary of a solid on which f lies in a range, and the volumes that cut it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypedDict, cast, get_args

import drjit as dr
import numpy as np

from harnack.backend import backend_of
from harnack.backend.tensors import is_tensor, tensor_to_array
from harnack.backend.validation import check_no_derivatives
from harnack.fields.field import check_is_field
from harnack.geometry import VolumeIntersection
from harnack.geometry.volume import check_volume
from harnack.name_suggestions import did_you_mean, is_one_of, suggests_arguments
from harnack.tracer.largest_component import validate_component_cells

if TYPE_CHECKING:
    from harnack.backend import Real
    from harnack.fields.field import Field
    from harnack.geometry import Volume

Side = Literal["surface", "below", "above", "between"]
SIDES: tuple[Side, ...] = get_args(Side)


class SurfaceKeywords(TypedDict, total=False):
    """The keywords of `Surface`. Every function of the library that takes a surface (`trace`,
    `render`, `mesh`, ...) takes them beside a field that is given without a `Surface`."""

    level: Any
    clip: Volume | None
    section: Volume | None
    side: Side | None
    largest: bool | int


@suggests_arguments
@dataclass(frozen=True, init=False)
class Surface:
    """The points at which a field f takes a level, or the boundary of the solid on one side of it.

    These functions take a `Surface` in place of a field: `trace`, `crossings`, `render`, `animate`,
    `view`, `page`, `mesh`, `signed_distance`, `curvature`. Their keywords that are named as the
    parameters here are shorthand: `trace(field, ..., level=2.0)` traces `Surface(field, 2.0)`.

    field: the function f.
    level: a number or several, which may be Dr.Jit numbers; None for the field's default. For an
        angle-valued field levels are taken modulo its period. The attribute `levels` is a tuple.
    clip: a volume. The surface is the part of the level set in this volume and in the field's own
        domain.
    section: another volume, which cuts the surface open. If a solid is cut, the faces of the cut
        may have a material of their own.
    side: "surface" for the level set itself; "below", "above" or "between" for the boundary of the
        closed solid on which f <= level, f >= level, or f is between two levels, with faces where a
        volume cuts it. None means "below" for a `Solid` that is meshed, or whose inside a picture
        shows, and "surface" otherwise.
    largest: True for the largest connected component alone. Components are told apart by cells that
        are proved empty: 128 cells along the longest side of the box, or the given number. The
        largest component, within domain and clip, is the one with the largest sum of projected
        areas along x, y and z. Meshes tell components apart by their triangles.

    Raises:
        TypeError: `field` is no field, or another argument has a wrong type.
        ValueError: a level that is not finite or that the field cannot have; an unknown side, or a
            number of levels that does not suit the side.
    """

    field: Field
    levels: tuple[Real, ...]
    clip: Volume | None
    section: Volume | None
    side: Side | None
    largest: int

    def __init__(
        self,
        field: Field,
        level: Any = None,
        *,
        clip: Volume | None = None,
        section: Volume | None = None,
        side: Side | None = None,
        largest: bool | int = False,
    ) -> None:
        # All arguments are checked, so that no later call meets a wrong one.
        check_is_field(field)
        levels = _as_levels(field.default_level if level is None else level)
        for number in levels:
            if not math.isfinite(level_number(number)):
                raise ValueError(f"level must be finite, not {level_number(number)}")
        check_volume(clip, "clip")
        check_volume(section, "section")
        values: dict[str, Any] = {
            "field": field, "levels": _in_order(levels, _check_side(side, levels)), "clip": clip,
            "section": section, "side": side, "largest": validate_component_cells(largest),
        }  # fmt: skip
        for name, value in values.items():
            object.__setattr__(self, name, value)  # the dataclass is frozen
        field.validate_levels(self.level_values)
        if field.traits.has_jumps and field.period is not None:
            raise ValueError("a field with jumps must be real-valued: its period must be None")
        if self.largest and (field.traits.has_jumps or field.traits.has_patches):
            raise ValueError(
                f"largest=... needs one continuous function, and this {type(field).__name__} "
                f"{'jumps' if field.traits.has_jumps else 'has one for each patch'}"
            )

    def replace(self, **changes: Any) -> Surface:
        """Return this surface with some arguments of its constructor changed. changes: new values
        of arguments, by name. Raises the errors of the constructor."""
        arguments: dict[str, Any] = {"field": self.field, "level": self.levels, **self.keywords}
        arguments |= changes
        return Surface(**arguments)

    @property
    def keywords(self) -> dict[str, Any]:
        """The keyword arguments of this surface but for `level`, by name."""
        return {
            "clip": self.clip, "section": self.section, "side": self.side, "largest": self.largest,
        }  # fmt: skip

    @property
    def level_values(self) -> tuple[float, ...]:
        """The levels as Python numbers."""
        return tuple(level_number(level) for level in self.levels)

    @property
    def clip_volume(self) -> Volume | None:
        """The intersection of clip and section; None if there is neither."""
        return intersection_of([self.clip, self.section])

    @property
    def solid_range(self) -> tuple[float, float] | None:
        """The interval (low, high) of the values of f on the closed solid; None if the surface is
        the level set itself."""
        return side_range(self.side, self.level_values)


def side_range(side: Side | None, levels: Sequence[float]) -> tuple[float, float] | None:
    """Return the interval (low, high) of the values of f on the closed solid that `side` describes;
    one end may be infinite. It is None if `side` means the level set itself.

    levels: one level, or two for "between".
    """
    if side is None or side == "surface":
        return None
    low = -math.inf if side == "below" else levels[0]
    return low, math.inf if side == "above" else levels[-1]


def intersection_of(volumes: Sequence[Volume | None]) -> Volume | None:
    """Return the intersection of volumes. Entries that are None stand for all of space, and so does
    the result None. A volume that occurs twice counts once."""
    distinct = list(dict.fromkeys(volume for volume in volumes if volume is not None))
    if not distinct:
        return None
    return distinct[0] if len(distinct) == 1 else VolumeIntersection(tuple(distinct))


def level_number(level: Any) -> float:
    """Return a level, which may be a Dr.Jit number, as a Python float. Raises TypeError for a level
    that is no number, and ValueError for a Dr.Jit array of several."""
    if dr.is_array_v(type(level)):
        if dr.depth_v(level) != 1 or dr.width(level) != 1:
            raise ValueError(
                "a level is one number, and not an array of several: give these as a list or a "
                "tensor, [0.1, 0.2]"
            )
        return float(dr.detach(level)[0])
    return as_number(level, "level must be a number, or several, such as 0.5 or 2 * math.pi")


def as_number(number: Any, message: str) -> float:
    """Return a number as a Python float. Raises TypeError, with a text that begins with `message`,
    for anything else; also for texts, truth values, and numbers with derivatives enabled."""
    check_no_derivatives("a level or setting that is no Dr.Jit number", number)
    try:
        # float() would accept texts and truth values; "nothing" makes it raise ValueError.
        return float("nothing" if isinstance(number, str | bool | np.bool_) else number)
    except (TypeError, ValueError):
        raise TypeError(f"{message}, not {number!r}") from None


def _check_side(side: Any, levels: Sequence[Any]) -> Side | None:
    """Return the option `side` if it is valid; None is valid, and stands for the default. Raises
    ValueError if the side is unknown, or if the number of levels does not suit it."""
    if side is not None and not is_one_of(side, SIDES):
        names = ", ".join(f'"{name}"' for name in SIDES)
        raise ValueError(f"side must be one of {names}, not {side!r}{did_you_mean(side, SIDES)}")
    # The number of levels that the side needs; any number suits a level set.
    count = 2 if side == "between" else 1 if side in ("below", "above") else len(levels)
    if len(levels) != count:
        raise ValueError(
            f'side="{side}" is the solid '
            + (
                "on one side of one level"
                if count == 1
                else "between two levels, level=(low, high)"
            )
            + f", and {len(levels)} are given: {', '.join(f'{level_number(x):g}' for x in levels)}"
        )
    return side


def _in_order(levels: tuple[Any, ...], side: Side | None) -> tuple[Any, ...]:
    """Return the levels, unchanged. Raises ValueError if `side` is "between" and they are not in
    ascending order."""
    if side == "between" and not level_number(levels[0]) < level_number(levels[1]):
        low, high = map(level_number, levels)
        raise ValueError(f'side="between" needs level=(low, high), low < high, not {(low, high)}')
    return levels


def _as_levels(level: Any) -> tuple[Any, ...]:
    """Return the levels of a surface as a tuple of numbers. level: a number or several, which may
    be Dr.Jit numbers or a tensor."""
    if is_tensor(level):
        numbers = tensor_to_array(level, "level")
        backend = backend_of(numbers)
        # Each level as an array of one lane, which keeps its derivative.
        indices = map(backend.UInt32, range(dr.width(numbers)))
        return tuple(dr.gather(backend.Float, numbers, index) for index in indices)
    is_numpy_row = isinstance(level, np.ndarray) and np.ndim(cast("Any", level)) == 1
    if is_numpy_row or (isinstance(level, Sequence) and not isinstance(level, str)):
        entries: list[Any] = [*level]
        if not entries:
            raise ValueError("level: give at least one")
        # A tensor among the entries may hold several levels.
        parts = [_as_levels(entry) if is_tensor(entry) else (entry,) for entry in entries]
        return tuple(number for part in parts for number in part)
    return (cast("Any", level),)
