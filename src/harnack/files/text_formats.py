"""Reading geometry files in text formats: .loops, .blobs, .obj, .off and .stl (.stl may also be
binary). Each reader takes the path of a file, for messages, and `data`, the bytes of the file. A
"statement" is a line of an .obj file, whose first word says what it defines. Errors are
FileFormatErrors that name the line."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.files.file_geometry import (
    FileGeometry,
    FileLocation,
    FileLocations,
    PolygonList,
    check_element_count,
    check_finite,
    check_indices,
    have_mixed_sizes,
    triangles_as_polygons,
)
from harnack.files.text_tables import (
    TextLines,
    excerpt,
    parse_vertex_index,
    read_floats,
    read_integers,
    read_table,
    split_content_lines,
)
from harnack.geometry.boundary_edges import weld_vertices
from harnack.geometry.flat_lists import ranks_in_lists


def read_loops_text(path: Path, data: bytes) -> list[tuple[FloatArray, FileLocation]]:
    """Read the bytes `data` of a .loops file, which has a closed curve on each line: the
    coordinates x y z of all its points, one point after the other. `#` begins a comment. Returns
    the curves, arrays (n, 3), and the location of each in the file.

    Raises:
        FileFormatError: a word is not a number, or the number of words of a line is not a multiple
            of 3.
    """
    lines = split_content_lines(path, data)
    if not len(lines):
        raise FileLocation(path).error("there are no loops: write one a line, x y z repeated")
    numbers, counts = read_floats(lines)
    wrong = np.flatnonzero(counts % 3)
    if wrong.size:
        raise lines.locations[wrong[0]].error(
            f"{counts[wrong[0]]} numbers: a loop is x y z repeated, so a multiple of 3"
        )
    # All points, divided where a line ends.
    loops = np.split(numbers.reshape(-1, 3), np.cumsum(counts // 3)[:-1])
    return [(loop, lines.locations[k]) for k, loop in enumerate(loops)]


# Metaballs.

_COLUMNS = "x y z radius [weight [group]]"


@dataclass(frozen=True, eq=False)
class Metaballs:
    """The n blobs (metaballs) of a file: their centers (n, 3), radii (n,) and weights (n,); and the
    number of the group of each blob (n,), or None if the file names no groups.

    summary: a text about the contents of the file.
    """

    centers: FloatArray
    radii: FloatArray
    weights: FloatArray
    groups: IntArray | None
    summary: str


def read_metaballs(path: Path, data: bytes) -> Metaballs:
    """Read the blobs of a .blobs file, a text with a blob on each line. Returns the `Metaballs`.
    `#` begins a comment.

        # x y z radius [weight [group]]
        0.0  0.0  0.0  1.0
        1.2  0.0  0.0  0.8
        0.6  0.5  0.0  0.4  -1   # carves

    The radius is that of the ball that the blob is by itself. The default weight is 1. Blobs of the
    same group flow together, and groups meet in creases; without groups all blobs flow together.
    Lines may have different numbers of columns. Either all lines name a group or none does.

    Raises:
        FileFormatError: the file is empty; an entry is not a finite number; a line has fewer than
            four or more than six columns; a radius is not positive; a group is no integer; or only
            some lines name a group.
    """
    lines = split_content_lines(path, data)
    if not len(lines):
        raise FileLocation(path).error(f"it holds no blobs: write one a line, {_COLUMNS}")
    numbers, counts = read_floats(lines)
    invalid = np.flatnonzero((counts < 4) | (counts > 6))
    if invalid.size:
        raise lines.locations[invalid[0]].error(
            f"a blob has four to six numbers, {_COLUMNS}, not {counts[invalid[0]]}"
        )
    # Columns that a line lacks (weight and group) are 1. The others are filled row by row.
    table = np.ones((len(counts), 6))
    table[np.arange(6) < counts[:, None]] = numbers
    radii, groups = table[:, 3], table[:, 5]
    invalid = np.flatnonzero(~(radii > 0))
    if invalid.size:
        raise lines.locations[invalid[0]].error(
            f"the radius of a blob must be positive, not {radii[invalid[0]]:g}; to carve, give a "
            "negative weight behind it"
        )
    is_grouped = counts == 6
    summary = f"{len(table):,} blobs"
    if not is_grouped.any():
        # (None: the file names no groups.)
        return Metaballs(table[:, :3], radii, table[:, 4], None, f"{summary}, one group")
    if not is_grouped.all():
        raise lines.locations[int(np.argmin(is_grouped))].error(
            "this line names no group and others do: write the sixth number in all lines or in none"
        )
    invalid = np.flatnonzero((groups != np.rint(groups)) | (np.abs(groups) > 2**31))
    if invalid.size:
        raise lines.locations[invalid[0]].error(
            f"a group must be an integer, not {groups[invalid[0]]:g}"
        )
    group_numbers = groups.astype(np.int64)
    summary = f"{summary} in {len(np.unique(group_numbers))} groups"
    return Metaballs(table[:, :3], radii, table[:, 4], group_numbers, summary)


# Wavefront .obj.

# Statements that define further surface: free forms, old faces, other files.
_UNSUPPORTED_OBJ_STATEMENTS = (b"curv", b"curv2", b"surf", b"bzp", b"bsp", b"fo", b"call")


def read_obj(path: Path, data: bytes) -> FileGeometry:
    """Read the bytes `data` of a Wavefront .obj file: its vertices, faces (`f`) and polylines
    (`l`); and for a point cloud the normals, if there are as many normals as vertices.

    If there are statements `p` and neither faces nor polylines, the result has only the vertices
    that they name, with their normals. Groups, materials and textures are ignored. Statements that
    define other surfaces, such as splines, are an error.

    An index may be negative; then it counts back from the last vertex before the statement. It may
    be followed by slashes and the indices of a texture vertex and a normal, which are ignored in
    faces and polylines.

    Raises:
        FileFormatError: a statement is malformed, or an index is out of range.
    """
    lines = split_content_lines(path, data)
    if b"\\" in data:
        lines = _join_continued_lines(lines)
    # For each keyword the texts of its statements, without the keyword, and their line numbers.
    statements: dict[bytes, tuple[list[bytes], list[int]]]
    statements = {keyword: ([], []) for keyword in (b"v", b"vn", b"f", b"l", b"p")}
    for number, line in zip(lines.locations.numbers, lines.text, strict=True):
        keyword = line.split(None, 1)[0]
        if statement := statements.get(keyword):
            statement[0].append(line[len(keyword) :])
            statement[1].append(number)
        # Known keywords in capital letters are refused, too.
        elif keyword in _UNSUPPORTED_OBJ_STATEMENTS or keyword.lower() in statements:
            raise FileLocation(path, f"line {number}").error(
                f"the statement {excerpt(keyword)} is not read: save the surface as 'v' and 'f'"
            )
        elif keyword.isdigit() or not keyword.replace(b"_", b"").isalnum():
            raise FileLocation(path, f"line {number}").error(
                f"{excerpt(keyword)} is no .obj statement"
            )
    rows = {
        k: TextLines(text, FileLocations(path, "line", numbers))
        for k, (text, numbers) in statements.items()
    }
    vertices = read_table(rows[b"v"], 3, too_few_message="a vertex needs three coordinates, not {}")
    # The least numbers of corners are 3 and 2.
    faces = _parse_obj_polygons(rows[b"f"], "'f' needs at least 3 vertices", 3, rows[b"v"])
    polylines = _parse_obj_polygons(rows[b"l"], "'l' needs at least 2 vertices", 2, rows[b"v"])
    # Faces of different sizes are handled one by one, which takes long.
    if have_mixed_sizes(faces):
        check_element_count(FileLocation(path), len(lines))
    # Normals are needed for point clouds only.
    if len(faces) or len(polylines):
        return FileGeometry(path, vertices, None, faces, polylines)
    normals = read_table(rows[b"vn"], 3) if len(rows[b"vn"]) else None
    if len(rows[b"p"]):
        return _parse_obj_points(path, vertices, normals, rows)
    if normals is not None and len(normals) != len(vertices):
        normals = None
    return FileGeometry(path, vertices, normals, faces, polylines)


def _parse_obj_points(
    path: Path, vertices: FloatArray, normals: FloatArray | None, rows: dict[bytes, TextLines]
) -> FileGeometry:
    """Return the vertices that the statements `p` of an .obj file name, as a point cloud, with
    their normals if all of these statements name one.

    vertices: (n, 3) all vertices of the file.
    normals: (k, 3) all its normals, or None.
    rows: the lines of the statements, by their keyword.

    Raises:
        FileFormatError: an index out of range, or normals for only some of the points.
    """
    points = _parse_obj_polygons(rows[b"p"], "'p' needs a vertex", 1, rows[b"v"])
    # A word is vertex/texture/normal; the last two may be missing.
    words = [word.split(b"/") for line in rows[b"p"].text for word in line.split()]
    normal_words = [word[2] for word in words if len(word) == 3 and word[2]]
    if normals is None or not normal_words:
        return FileGeometry(path, vertices[points.corners])
    # Errors name the first of these statements.
    normal_indices = [parse_vertex_index(word, rows[b"p"].locations[0]) for word in normal_words]
    if len(normal_indices) != len(words) or not all(1 <= k <= len(normals) for k in normal_indices):
        raise (
            rows[b"p"]
            .locations[0]
            .error(f"points need normals from 1 to {len(normals):,} each, or none of them one")
        )
    return FileGeometry(path, vertices[points.corners], normals[np.array(normal_indices) - 1])


def _join_continued_lines(lines: TextLines) -> TextLines:
    """Return the same lines, except that a line that ends with a backslash is joined with the next
    one to a single line, which has the number of its first line."""
    pieces: list[list[bytes]] = []
    numbers: list[int] = []
    continued = 0  # the number of the line that continues the last
    for line, number in zip(lines.text, lines.locations.numbers, strict=True):
        if number != continued:
            pieces.append([])
            numbers.append(number)
        pieces[-1].append(line.removesuffix(b"\\"))
        continued = number + 1 if line.endswith(b"\\") else 0
    joined = [(b" ".join(piece).strip(), k) for piece, k in zip(pieces, numbers, strict=True)]
    joined = [(line, k) for line, k in joined if line]
    return TextLines(
        [x for x, _ in joined], FileLocations(lines.locations.path, "line", [k for _, k in joined])
    )


def _parse_obj_polygons(
    lines: TextLines, too_few: str, min_corners: int, vertices: TextLines
) -> PolygonList:
    """Return the faces, polylines or points that statements of an .obj file define, with vertex
    indices from 0.

    lines: the lines of the statements `f`, `l` or `p`, without the keyword.
    too_few: the error message for a statement with fewer corners than `min_corners`.
    vertices: the lines of all vertices. A negative index counts back from the last of these before
        the statement.

    Raises:
        FileFormatError: too few corners, or an index out of range.
    """
    # Texture and normal indices stand behind slashes.
    text = [re.sub(rb"(?<=\S)/\S*", b"", line) if b"/" in line else line for line in lines.text]
    corners, sizes = read_integers(TextLines(text, lines.locations))
    if (short := np.flatnonzero(sizes < min_corners)).size:
        raise lines.locations[short[0]].error(too_few)
    statements = PolygonList(corners, sizes, lines.locations)
    if (zero := np.flatnonzero(corners == 0)).size:
        raise statements.location_of_corner(zero[0]).error(
            "vertices are counted from 1, there is no vertex 0"
        )
    # For each corner, the number of vertices before its statement: negative indices count back from
    # there.
    preceding = np.repeat(
        np.searchsorted(vertices.locations.numbers, lines.locations.numbers), sizes
    )
    if (low := np.flatnonzero(corners < -preceding)).size:
        raise statements.location_of_corner(low[0]).error(
            f"vertex {corners[low[0]]} is out of range: {preceding[low[0]]} vertices precede it"
        )
    # All indices are counted from 0 from here on.
    corners = np.where(corners > 0, corners - 1, corners + preceding)
    polygons = PolygonList(corners, sizes, lines.locations)
    check_indices(polygons, len(vertices), first=1)
    return polygons


# .off, vertices and polygons.


def read_off(path: Path, data: bytes) -> FileGeometry:
    """Read the vertices and faces in the bytes `data` of an .off file. Colors, normals and textures
    are ignored.

    Raises:
        FileFormatError: it is not an .off file of points in space, is truncated or malformed, an
            index is out of range, or a coordinate is not finite.
    """
    count, faces_count, lines = _parse_off_header(path, split_content_lines(path, data))
    if len(lines) < count + faces_count:
        raise FileLocation(path).error(
            f"its header promises {count:,} vertices and {faces_count:,} faces, but "
            f"{len(lines):,} lines follow: the file is truncated"
        )
    if len(lines) > count + faces_count:
        raise lines.locations[count + faces_count].error(
            f"more follows than the {count:,} vertices and {faces_count:,} faces that its header "
            "promises, one a line"
        )
    if not count:
        raise FileLocation(path).error("it holds no vertices")
    vertices = read_table(lines[:count], 3)
    rows = lines[count : count + faces_count]
    # Colors may follow the corners; these need not be integers, and not even numbers.
    numbers, word_counts = read_floats(rows, convert=_number_or_nan)
    begins = np.cumsum(word_counts) - word_counts
    # The first word of a face's line (word 0) is the number of its corners.
    sizes = _integers(rows, numbers[begins], np.arange(len(rows)), np.zeros_like(begins))
    if (wrong := np.flatnonzero((sizes < 1) | (sizes >= word_counts))).size:
        k = wrong[0]
        raise rows.locations[k].error(f"a face of '{sizes[k]}' vertices does not fit on this line")
    row_of_corner = np.repeat(np.arange(len(rows)), sizes)
    word_of_corner = 1 + ranks_in_lists(sizes)
    corners = _integers(
        rows, numbers[begins[row_of_corner] + word_of_corner], row_of_corner, word_of_corner
    )
    faces = PolygonList(corners, sizes, rows.locations)
    check_indices(faces, count)
    # (None: normals are not read.)
    return FileGeometry(path, vertices, None, faces)


def _number_or_nan(word: bytes, _: FileLocation) -> float:
    """Return the number that a word of a text file stands for; NaN if it is not a number."""
    try:
        return float(word)
    except ValueError:
        return math.nan


def _integers(
    rows: TextLines, numbers: FloatArray, row_of: IntArray, word_of: IntArray
) -> IntArray:
    """Convert numbers (k,), which were read from words of lines, to integers.

    rows: the lines.
    row_of, word_of: (k,) for each number, the index of its line, and its position among the words
        of that line, for messages.

    Raises:
        FileFormatError: a number is no integer.
    """
    # Below 2^53, floats hold integers exactly.
    wrong = np.flatnonzero(~((numbers == np.rint(numbers)) & (np.abs(numbers) < 2.0**53)))
    if wrong.size:
        # Parsing the first wrong word alone raises the error that names it.
        k = int(row_of[wrong[0]])
        parse_vertex_index(rows.text[k].split()[int(word_of[wrong[0]])], rows.locations[k])
    return numbers.astype(np.int64)


def _parse_off_header(path: Path, lines: TextLines) -> tuple[int, int, TextLines]:
    """Return the number of vertices and the number of faces that the header of an .off file
    declares, and the lines after the header.

    Raises:
        FileFormatError: it is malformed, or not supported.
    """
    # Letters before OFF announce texture coordinates, colors and normals, which are ignored; "4"
    # and "n" announce another number of coordinates.
    match = (
        re.match(rb"(ST)?(C)?(N)?(4)?(n)?OFF(?!\S)\s*(.*)", lines.text[0]) if len(lines) else None
    )
    if match is None:
        raise FileLocation(path).error("this is no .off file: it does not begin with 'OFF'")
    if match[4] or match[5]:
        raise FileLocation(path).error("its vertices have other than three coordinates")
    rest = match[6]
    if rest.upper().startswith(b"BINARY"):
        raise FileLocation(path).error(
            "binary .off files are not read: save it as text, or as .ply"
        )
    # The numbers stand behind the word OFF or on the next line.
    line_index = 0 if rest else 1
    if line_index == len(lines):
        raise FileLocation(path).error("the file ends before the numbers of vertices and faces")
    words = (rest or lines.text[1]).split()
    if len(words) < 2:
        raise lines.locations[line_index].error("numbers of vertices and faces are expected here")
    counts = [parse_vertex_index(word, lines.locations[line_index]) for word in words[:2]]
    if min(counts) < 0:
        raise lines.locations[line_index].error("numbers of vertices and faces cannot be negative")
    return counts[0], counts[1], lines[line_index + 1 :]


# .stl, binary and ascii.

_STL_HEADER_BYTES = 84
# The byte order mark of UTF-8, before the text of some programs.
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_KEYWORDS = (b"solid", b"facet", b"outer", b"vertex", b"endloop", b"endfacet", b"endsolid")


def read_stl(path: Path, data: bytes) -> FileGeometry:
    """Read the triangles in the bytes `data` of an .stl file, text or binary. Corners at the same
    position become a single vertex.

    Raises:
        FileFormatError: the file is truncated or malformed, a coordinate is not finite, or there
            are no triangles.
    """
    corners = _parse_binary_stl(path, data) if _is_binary(data) else _parse_text_stl(path, data)
    if not len(corners):
        raise FileLocation(path).error("it holds no triangles")
    # One row for each triangle, so that errors name the triangle.
    check_finite(corners.reshape(-1, 9), FileLocations(path, "triangle", range(len(corners) // 3)))
    distinct, index = np.unique(weld_vertices(corners), return_inverse=True)
    return FileGeometry(
        path, corners[distinct], None, triangles_as_polygons(path, index.reshape(-1, 3))
    )


def _is_binary(data: bytes) -> bool:
    """Return whether an .stl file with the bytes `data` is binary. Many binary files begin with the
    word "solid" like text files. So the length is tested first: a binary file has the length that
    follows from the number of triangles in its header."""
    if (
        len(data) >= _STL_HEADER_BYTES
        and len(data) == _STL_HEADER_BYTES + _stl_facet_count(data) * _FACET.itemsize
    ):
        return True
    return data.removeprefix(_BYTE_ORDER_MARK).lstrip()[:5].lower() != b"solid" or b"\0" in data


def _stl_facet_count(data: bytes) -> int:
    """Return the number of triangles that the header of a binary .stl file states."""
    return int.from_bytes(data[_STL_HEADER_BYTES - 4 : _STL_HEADER_BYTES], "little")


def _parse_binary_stl(path: Path, data: bytes) -> FloatArray:
    """Return the corners (3 m, 3) of the m triangles of a binary .stl file. Raises a
    FileFormatError if the file's length does not follow from the number of triangles in its
    header."""
    if len(data) < _STL_HEADER_BYTES:
        raise FileLocation(path).error(
            f"{len(data)} bytes are too few for an .stl file: it begins with 'solid' or with a "
            f"header of {_STL_HEADER_BYTES} bytes"
        )
    count, room = _stl_facet_count(data), (len(data) - _STL_HEADER_BYTES) // _FACET.itemsize
    if count > room:
        raise FileLocation(path).error(
            f"its header promises {count:,} triangles, but there is room for {room:,}: the file is "
            "truncated, or no .stl file"
        )
    if room > count:
        raise FileLocation(path).error(
            f"its header promises {count:,} triangles, but {room - count:,} more follow: the count "
            "is wrong, or several files were joined"
        )
    facets = np.frombuffer(data, _FACET, count, _STL_HEADER_BYTES)
    return facets["corners"].reshape(-1, 3).astype(np.float64)


def _parse_text_stl(path: Path, data: bytes) -> FloatArray:
    """Return the corners (3 m, 3) of the m triangles of a text .stl file.

    Raises:
        FileFormatError: an unknown statement, a truncated file, or a facet without three vertices.
    """
    lines = split_content_lines(path, data)
    keywords = [line.split(None, 1)[0].lower() for line in lines.text]
    for k, word in enumerate(keywords):
        if word not in _KEYWORDS:
            raise lines.locations[k].error(f"{excerpt(word)} is no .stl statement")
    if keywords[-1] != b"endsolid":
        raise lines.locations[len(keywords) - 1].error(
            "the file ends before 'endsolid': it is truncated"
        )
    vertex_lines = [k for k, word in enumerate(keywords) if word == b"vertex"]
    facet_count = keywords.count(b"facet")
    facet_lines = [k for k, word in enumerate(keywords) if word == b"facet"]
    # The number of vertex lines between each facet line and the next.
    vertices_per_facet = (
        np.histogram(vertex_lines, [*facet_lines, len(keywords)])[0]
        if facet_lines
        else np.zeros(0, int)
    )
    if len(vertex_lines) != 3 * facet_count or (vertices_per_facet != 3).any():
        raise FileLocation(path).error(
            f"{len(vertex_lines):,} vertices in {facet_count:,} facets: each needs three"
        )
    rows = [lines.text[k][len("vertex") :] for k in vertex_lines]
    return read_table(
        TextLines(
            rows, FileLocations(path, "line", [lines.locations.numbers[k] for k in vertex_lines])
        ),
        3,
    )
