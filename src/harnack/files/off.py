"""Reading .off files: vertices and polygons as text."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from harnack.backend import FloatArray
from harnack.files.file_format import Contents, Place, Polygons, check_indices, positions
from harnack.files.text_tables import Lines, as_integer, content_lines, read_floats, read_table
from harnack.backend import IntArray


def read_off(path: Path, data: bytes) -> Contents:
    """Vertices and faces of an .off file. Colors, normals and textures are passed over.

    Raises:
        FileFormatError: no .off file of points in space, truncated, malformed, an index out of
            range, a coordinate that is not finite.
    """
    count, faces_count, lines = _header(path, content_lines(path, data))
    if len(lines) < count + faces_count:
        raise Place(path).error(
            f"its header promises {count:,} vertices and {faces_count:,} faces, but "
            f"{len(lines):,} lines follow: the file is truncated"
        )
    if len(lines) > count + faces_count:
        raise lines.places[count + faces_count].error(
            f"more follows than the {count:,} vertices and {faces_count:,} faces that its header "
            "promises, one a line"
        )
    if not count:
        raise Place(path).error("it holds no vertices")
    vertices = read_table(lines[:count], 3)
    rows = lines[count : count + faces_count]
    # Colors may follow the corners: they need be no integers, and not even numbers.
    numbers, counts = read_floats(rows, convert=_number_or_nan)
    begins = np.cumsum(counts) - counts
    sizes = _integers(rows, numbers[begins], np.arange(len(rows)), np.zeros_like(begins))
    if (wrong := np.flatnonzero((sizes < 1) | (sizes >= counts))).size:
        k = wrong[0]
        raise rows.places[k].error(f"a face of '{sizes[k]}' vertices does not fit on this line")
    owners = np.repeat(np.arange(len(rows)), sizes)
    within = 1 + positions(sizes)
    corners = _integers(rows, numbers[begins[owners] + within], owners, within)
    faces = Polygons(corners, sizes, rows.places)
    check_indices(faces, count)
    return Contents(path, vertices, None, faces)


def _number_or_nan(word: bytes, _: Place) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


def _integers(rows: Lines, numbers: FloatArray, owners: IntArray, within: IntArray) -> IntArray:
    """Numbers as integers. owners, within: which word of which row each is."""
    wrong = np.flatnonzero(~((numbers == np.rint(numbers)) & (np.abs(numbers) < 2.0**53)))
    if wrong.size:
        k = int(owners[wrong[0]])
        as_integer(rows.text[k].split()[int(within[wrong[0]])], rows.places[k])
    return numbers.astype(np.int64)


def _header(path: Path, lines: Lines) -> tuple[int, int, Lines]:
    """Numbers of vertices and faces, and the lines that follow."""
    match = (
        re.match(rb"(ST)?(C)?(N)?(4)?(n)?OFF(?!\S)\s*(.*)", lines.text[0]) if len(lines) else None
    )
    if match is None:
        raise Place(path).error("this is no .off file: it does not begin with 'OFF'")
    if match[4] or match[5]:
        raise Place(path).error("its vertices have other than three coordinates")
    rest = match[6]
    if rest.upper().startswith(b"BINARY"):
        raise Place(path).error("binary .off files are not read: save it as text, or as .ply")
    at = 0 if rest else 1
    if at == len(lines):
        raise Place(path).error("the file ends before the numbers of vertices and faces")
    words = (rest or lines.text[1]).split()
    if len(words) < 2:
        raise lines.places[at].error("numbers of vertices and faces are expected here")
    counts = [as_integer(word, lines.places[at]) for word in words[:2]]
    if min(counts) < 0:
        raise lines.places[at].error("numbers of vertices and faces cannot be negative")
    return counts[0], counts[1], lines[at + 1 :]
