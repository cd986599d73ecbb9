"""Unions whose parts have parts in common: these are taken out, so that none is made twice.

A hollow part with a lattice inside is (P less Q) | (P & W): the surface of P would be that of both
operands. Cut by the lattice its triangles have corners that are rounded, so they would lie in the
other operand's triangles but for rounding, and pass through them. As P less (Q less W) it is the
same solid, P is there once, and what is put together has no surfaces in common.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from typing import TypeAlias

from harnack.fields import Solid
from harnack.fields.solids.booleans import Combined, Complement, Offset
from harnack.fields.solids.from_field import Near, Region
from harnack.fields.solids.transforms import AffineImage

__all__ = ["common_parts_taken_out", "flat", "without_cut_parts"]

Factor: TypeAlias = tuple[Solid, float]
"""A solid's function and a level: the points where it is at most that."""


def common_parts_taken_out(union: Combined, level: float) -> Solid | None:
    """The points where a union is at most `level`, as those where another solid is at most 0:
    (A & B) | (A & C) as A & (B | C); None if no two parts have anything in common."""
    terms = [{_key(*one): one for one in _factors(part, level)} for part in union.parts]
    most, times = Counter(key for term in terms for key in term).most_common(1)[0]
    if times < 2:
        return None
    sharing = [term for term in terms if most in term]
    others = [_intersection(term.values()) for term in terms if most not in term]
    shared = {key for key in sharing[0] if all(key in term for term in sharing)}
    common = [_placed(*one) for key, one in sharing[0].items() if key in shared]
    rests = [[one for key, one in term.items() if key not in shared] for term in sharing]
    if all(rests):
        common.append(_union([_intersection(rest) for rest in rests]))
    made = Combined(tuple(common), is_union=False)
    return _union([made, *others]) if others else made


def flat(solid: Combined) -> Combined:
    """With the parts of unions in a union, or of intersections in an intersection, as its own: all
    that is cut away from a part is cut away at once."""
    parts: list[Solid] = []
    for one in solid.parts:
        if isinstance(one, Combined) and one.is_union == solid.is_union:
            parts += flat(one).parts
        else:
            parts.append(one)
    return Combined(tuple(parts), solid.is_union)


def without_cut_parts(solid: Combined, level: float) -> Combined | None:
    """(A | C) less C as A less C, of an intersection's own parts: C has nothing but its boundary in
    common with its complement. None if nothing is left; a union as it is."""
    if solid.is_union:
        return solid
    cut = {_key(one.inner, -level) for one in solid.parts if isinstance(one, Complement)}
    parts: list[Solid] = []
    for one in solid.parts:
        if isinstance(one, Combined) and one.is_union:
            kept = [part for part in flat(one).parts if _key(part, level) not in cut]
            if not kept:
                return None
            if len(kept) < len(flat(one).parts):
                one = kept[0] if len(kept) == 1 else Combined(tuple(kept), is_union=True)
        parts.append(one)
    return Combined(tuple(parts), is_union=False)


def _factors(solid: Solid, level: float) -> list[Factor]:
    """Those whose intersection is where a solid is at most a level."""
    if isinstance(solid, Combined) and not solid.is_union:
        return [one for part in solid.parts for one in _factors(part, level)]
    if isinstance(solid, Offset):
        return _factors(solid.inner, level + solid.distance)
    if isinstance(solid, Region) and isinstance(solid.inner, Solid):
        return _factors(solid.inner, level)
    if isinstance(solid, AffineImage):
        factor = solid.map.factor
        return [_image(one, solid, at) for one, at in _factors(solid.inner, level / factor)]
    if isinstance(solid, Near) and isinstance(solid.inner, Solid):
        half = solid.half_width + level
        if half > 0:
            low, high = solid.level - half, solid.level + half
            return [*_factors(solid.inner, high), (Complement(solid.inner), -low)]
    return [(solid, level)]


def _image(solid: Solid, of: AffineImage, level: float) -> Factor:
    if isinstance(solid, Complement):
        return Complement(AffineImage(solid.inner, of.map)), level * of.map.factor
    return AffineImage(solid, of.map), level * of.map.factor


def _key(solid: Solid, level: float) -> Hashable:
    """Equal of the same points, of the same field."""
    if isinstance(solid, Complement):
        return "complement", _key(solid.inner, -level)
    if isinstance(solid, Offset):
        return _key(solid.inner, level + solid.distance)
    if isinstance(solid, AffineImage):
        own = _key(solid.inner, level / solid.map.factor)
        return own, solid.map.matrix, solid.map.offset
    return id(solid), level


def _placed(solid: Solid, level: float) -> Solid:
    """With the level 0."""
    if level == 0:
        return solid
    if isinstance(solid, Complement):
        return Complement(Offset(solid.inner, -level))
    return Offset(solid, level)


def _intersection(factors: Iterable[Factor]) -> Solid:
    parts = tuple(_placed(*factor) for factor in factors)
    return parts[0] if len(parts) == 1 else Combined(parts, is_union=False)


def _union(parts: Sequence[Solid]) -> Solid:
    """If there are complements, that of an intersection: what is cut away need not be made of all
    of space."""
    if any(isinstance(one, Complement) for one in parts):
        return Complement(Combined(tuple(~one for one in parts), is_union=False))
    return Combined(tuple(parts), is_union=True)
