"""Rewrites unions and intersections of solids so that each surface occurs once, by taking common
operands out of unions. A pair (solid, level) stands for the set {solid <= level}, the points where
the solid's function is at most the level. The factors of a set are the sets of which it is the
intersection; an operand is one of the solids that a union or an intersection combines.

In (P - Q) | (P & W), a hollow part with a lattice inside, the surface of P occurs twice, once with
rounded vertices where W cuts it, and the two copies would intersect. The equivalent P - (Q - W)
contains P once, and its operands share no surface.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from typing import TypeAlias

from harnack.fields import Solid
from harnack.fields.solids.booleans import BooleanSolid, Complement, OffsetSolid
from harnack.fields.solids.from_field import BandSolid, SublevelSolid
from harnack.fields.solids.transforms import TransformedSolid

__all__ = ["drop_cancelled_operands", "factor_common_operands", "flatten_csg"]

SolidAtLevel: TypeAlias = tuple[Solid, float]
"""A solid and a level. They stand for the set of points where the solid's function is at most the
level."""


def factor_common_operands(union: BooleanSolid, level: float) -> Solid | None:
    """Take operands that several intersections of a union have in common out of the union: (A & B)
    | (A & C) becomes A & (B | C). The operand that occurs most often decides which intersections
    are rewritten. Returns a solid with the function f such that {f <= 0} is {union <= level}; None
    if no two of the intersections have a common operand."""
    # For each operand of the union, the sets of which it is the intersection, by their keys.
    terms = [{_key(*factor): factor for factor in _factors(part, level)} for part in union.parts]
    common_key, times = Counter(key for term in terms for key in term).most_common(1)[0]
    if times < 2:
        return None
    sharing = [term for term in terms if common_key in term]
    other_terms = [_intersection(term.values()) for term in terms if common_key not in term]
    # All operands that occur in each of these intersections are taken out together.
    shared = {key for key in sharing[0] if all(key in term for term in sharing)}
    common = [_with_level_zero(*factor) for key, factor in sharing[0].items() if key in shared]
    remainders = [[factor for key, factor in term.items() if key not in shared] for term in sharing]
    # If one of them has no further operand, (A) | (A & C) is A.
    if all(remainders):
        common.append(_union([_intersection(remainder) for remainder in remainders]))
    intersection = BooleanSolid(tuple(common), is_union=False)
    return _union([intersection, *other_terms]) if other_terms else intersection


def flatten_csg(solid: BooleanSolid) -> BooleanSolid:
    """Merge nested operations of the same kind: unions in a union, or intersections in an
    intersection. Then everything that is cut away from a solid is cut away in one operation."""
    parts: list[Solid] = []
    for operand in solid.parts:
        if isinstance(operand, BooleanSolid) and operand.is_union == solid.is_union:
            parts += flatten_csg(operand).parts
        else:
            parts.append(operand)
    return BooleanSolid(tuple(parts), solid.is_union)


def drop_cancelled_operands(solid: BooleanSolid, level: float) -> BooleanSolid | None:
    """Drop operands of unions that the intersection around them cuts away again: (A | C) - C
    becomes A - C, since C and its complement have only their boundary in common. Returns the new
    intersection; None if no operand of a union is left, so that the intersection is empty. If
    `solid` itself is a union, it is returned as it is.

    level: the set {solid <= level} is to be meshed.
    """
    if solid.is_union:
        return solid
    # The sets that the intersection cuts away, by their keys.
    cut = {_key(term.field, -level) for term in solid.parts if isinstance(term, Complement)}
    parts: list[Solid] = []
    for term in solid.parts:
        if isinstance(term, BooleanSolid) and term.is_union:
            rest = [part for part in flatten_csg(term).parts if _key(part, level) not in cut]
            if not rest:
                return None
            if len(rest) < len(flatten_csg(term).parts):
                term = rest[0] if len(rest) == 1 else BooleanSolid(tuple(rest), is_union=True)
        parts.append(term)
    return BooleanSolid(tuple(parts), is_union=False)


def _factors(solid: Solid, level: float) -> list[SolidAtLevel]:
    """The factors of the set {solid <= level}: pairs of a solid and its own level, whose sets have
    {solid <= level} as their intersection. If the solid is no intersection, the list has one
    factor, the solid itself."""
    if isinstance(solid, BooleanSolid) and not solid.is_union:
        return [factor for part in solid.parts for factor in _factors(part, level)]
    if isinstance(solid, OffsetSolid):
        return _factors(solid.field, level + solid.distance)
    if isinstance(solid, SublevelSolid) and isinstance(solid.field, Solid):
        return _factors(solid.field, level)
    if isinstance(solid, TransformedSolid):
        scale = solid.map.value_factor
        return [_image(factor, solid, at) for factor, at in _factors(solid.field, level / scale)]
    # The wall low <= g <= high of a solid's function g: g <= high, and -g <= -low.
    if isinstance(solid, BandSolid) and isinstance(solid.field, Solid):
        half = solid.half_width + level
        if half > 0:
            low, high = solid.level - half, solid.level + half
            return [*_factors(solid.field, high), (Complement(solid.field), -low)]
    return [(solid, level)]


def _image(solid: Solid, placed: TransformedSolid, level: float) -> SolidAtLevel:
    """The image of the set {solid <= level} under the affine map of the solid `placed`; returned as
    a solid and its level. The image of a complement is the complement of the image."""
    if isinstance(solid, Complement):
        return Complement(
            TransformedSolid(solid.field, placed.map)
        ), level * placed.map.value_factor
    return TransformedSolid(solid, placed.map), level * placed.map.value_factor


def _key(solid: Solid, level: float) -> Hashable:
    """A key by which sets {solid <= level} are compared. Two sets with equal keys are made of the
    same field object and consist of the same points; sets with different keys may still be
    equal."""
    if isinstance(solid, Complement):
        return "complement", _key(solid.field, -level)
    if isinstance(solid, OffsetSolid):
        return _key(solid.field, level + solid.distance)
    if isinstance(solid, TransformedSolid):
        field_key = _key(solid.field, level / solid.map.value_factor)
        return field_key, solid.map.matrix, solid.map.translation_vector
    return id(solid), level


def _with_level_zero(solid: Solid, level: float) -> Solid:
    """A solid whose function f makes {f <= 0} the same set as {solid <= level}."""
    if level == 0:
        return solid
    if isinstance(solid, Complement):
        return Complement(OffsetSolid(solid.field, -level))
    return OffsetSolid(solid, level)


def _intersection(factors: Iterable[SolidAtLevel]) -> Solid:
    """A solid for the intersection of the sets of all factors (pairs of a solid and its level); its
    level is 0. If there is a single factor, its solid is not put into an intersection."""
    parts = tuple(_with_level_zero(*factor) for factor in factors)
    return parts[0] if len(parts) == 1 else BooleanSolid(parts, is_union=False)


def _union(parts: Sequence[Solid]) -> Solid:
    """The union of solids. If one of them is a complement, it is written as the complement of an
    intersection, A | ~B = ~(~A & B), so that no solid has to be cut away from all of space."""
    if any(isinstance(operand, Complement) for operand in parts):
        return Complement(BooleanSolid(tuple(~operand for operand in parts), is_union=False))
    return BooleanSolid(tuple(parts), is_union=True)
