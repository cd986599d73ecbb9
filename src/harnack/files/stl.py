"""Reading .stl files, binary and ascii."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from harnack.backend import FloatArray
from harnack.files.file_format import Contents, Place, Places, check_finite, triangle_list
from harnack.files.text_tables import Lines, content_lines, excerpt, read_table
from harnack.geometry.singular import weld_vertices

_HEADER = 84
# Of UTF-8, before the text of some programs.
_MARK = b"\xef\xbb\xbf"
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_KEYWORDS = (b"solid", b"facet", b"outer", b"vertex", b"endloop", b"endfacet", b"endsolid")


def read_stl(path: Path, data: bytes) -> Contents:
    """The triangles of an .stl file, corners at the same position made one vertex.

    Raises:
        FileFormatError: truncated, malformed, a coordinate that is not finite, no triangles.
    """
    corners = _binary(path, data) if _is_binary(data) else _text(path, data)
    if not len(corners):
        raise Place(path).error("it holds no triangles")
    check_finite(corners.reshape(-1, 9), Places(path, "triangle", range(len(corners) // 3)))
    distinct, index = np.unique(weld_vertices(corners), return_inverse=True)
    return Contents(path, corners[distinct], None, triangle_list(path, index.reshape(-1, 3)))


def _is_binary(data: bytes) -> bool:
    """Many binary files begin with "solid" as well, so their length decides first."""
    if len(data) >= _HEADER and len(data) == _HEADER + _count(data) * _FACET.itemsize:
        return True
    return data.removeprefix(_MARK).lstrip()[:5].lower() != b"solid" or b"\0" in data


def _count(data: bytes) -> int:
    return int.from_bytes(data[_HEADER - 4 : _HEADER], "little")


def _binary(path: Path, data: bytes) -> FloatArray:
    if len(data) < _HEADER:
        raise Place(path).error(
            f"{len(data)} bytes are too few for an .stl file: it begins with 'solid' or with a "
            f"header of {_HEADER} bytes"
        )
    count, held = _count(data), (len(data) - _HEADER) // _FACET.itemsize
    if count > held:
        raise Place(path).error(
            f"its header promises {count:,} triangles, but there is room for {held:,}: the file is "
            "truncated, or no .stl file"
        )
    if held > count:
        raise Place(path).error(
            f"its header promises {count:,} triangles, but {held - count:,} more follow: the count "
            "is wrong, or several files were joined"
        )
    facets = np.frombuffer(data, _FACET, count, _HEADER)
    return facets["corners"].reshape(-1, 3).astype(np.float64)


def _text(path: Path, data: bytes) -> FloatArray:
    lines = content_lines(path, data)
    words = [line.split(None, 1)[0].lower() for line in lines.text]
    for k, word in enumerate(words):
        if word not in _KEYWORDS:
            raise lines.places[k].error(f"{excerpt(word)} is no .stl statement")
    if words[-1] != b"endsolid":
        raise lines.places[len(words) - 1].error("the file ends before 'endsolid': it is truncated")
    at = [k for k, word in enumerate(words) if word == b"vertex"]
    facets = words.count(b"facet")
    begins = [k for k, word in enumerate(words) if word == b"facet"]
    of_facets = np.histogram(at, [*begins, len(words)])[0] if begins else np.zeros(0, int)
    if len(at) != 3 * facets or (of_facets != 3).any():
        raise Place(path).error(f"{len(at):,} vertices in {facets:,} facets: each needs three")
    rows = [lines.text[k][len("vertex") :] for k in at]
    return read_table(Lines(rows, Places(path, "line", [lines.places.numbers[k] for k in at])), 3)
