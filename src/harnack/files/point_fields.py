"""The names that programs give to the numbers of a point in files of point clouds: which are its
normal, and which its color."""

from __future__ import annotations

from collections.abc import Callable, Iterable

__all__ = ["find_normals", "find_positions", "unused_notes"]

# Names without "_" and the prefix "scalar_", in small letters: `nx` of most programs, `normal_x` of
# PCL, `scalar_Nx` of CloudCompare and Metashape, `NormalX` of PDAL.
_NORMALS = (("nx", "ny", "nz"), ("normalx", "normaly", "normalz"))
_COLORS = frozenset({"red", "r", "diffusered", "rgb", "rgba", "colorred"})


def _plain(name: str) -> str:
    """Return a name in small letters, without "_" and without the prefix "scalar_"."""
    return name.lower().removeprefix("scalar_").replace("_", "")


def find_normals(names: Iterable[str]) -> tuple[str, str, str] | None:
    """Return the names, among those of the numbers of a point, of the three components of its
    normal; None if one is missing. Of names that mean the same, such as `nx` and `scalar_Nx`, that
    which is written plainly counts, else the first."""
    by_plain_name = _by_meaning(names, _plain)
    for x, y, z in _NORMALS:
        if x in by_plain_name and y in by_plain_name and z in by_plain_name:
            return by_plain_name[x], by_plain_name[y], by_plain_name[z]
    return None


def find_positions(names: Iterable[str]) -> tuple[str, str, str] | None:
    """Return the names, among those of the numbers of a point, of its coordinates x, y and z, in
    small or capital letters; None if one is missing. Of `x` and `X` the small one counts."""
    by_small_name = _by_meaning(names, str.lower)
    if not all(axis in by_small_name for axis in "xyz"):
        return None
    return by_small_name["x"], by_small_name["y"], by_small_name["z"]


def _by_meaning(names: Iterable[str], meaning: Callable[[str], str]) -> dict[str, str]:
    """Return the names by what they mean: of several with one meaning, the name that equals it or,
    if there is none, the first."""
    result: dict[str, str] = {}
    for name in names:
        key = meaning(name)
        if key == name or key not in result:
            result[key] = name
    return result


def unused_notes(names: Iterable[str]) -> tuple[str, ...]:
    """Return notes about what is not used of the numbers of a point with these names: its color."""
    return ("colors not used",) if any(_plain(name) in _COLORS for name in names) else ()
