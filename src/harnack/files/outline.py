"""Outlines for `harnack.Extrusion` and `harnack.SolidOfRevolution`: of text, of SVG files, and
regular polygons. An outline is a list of closed polygons ("loops", arrays (n, 2)) that do not cross
and have the region on their left, as `harnack.geometry.make_outline` returns them. Curves of
letters and SVG paths are replaced by polylines within a stated tolerance.
"""

from __future__ import annotations

import math
import os
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal
from xml.etree.ElementTree import Element, ParseError, TreeBuilder
from xml.parsers import expat

import numpy as np

from harnack.backend import FloatArray
from harnack.backend.validation import as_integer_in_range, as_positive
from harnack.files.file_geometry import FileFormatError
from harnack.geometry.beziers import flatten_bezier
from harnack.geometry.outline_loops import FillingRule, Outline, make_outline
from harnack.optional_packages import import_optional

__all__ = ["regular_polygon", "svg", "text"]

# The default tolerance, as a fraction of the size of letters, or of a picture.
_RELATIVE_TOLERANCE = 1e-3
_LINE_HEIGHT = 1.2
_MAX_LETTERS = 10_000
_MAX_SIDES = 100_000


def regular_polygon(sides: int, radius: float) -> Outline:
    """Return the regular polygon with this number of sides, at least 3. Its corners have the
    distance `radius` from the origin, and the first one is on the x axis. For example,
    `Extrusion(regular_polygon(6, 5.0), height)` is a hexagonal prism.

    Raises:
        ValueError: fewer sides, or a radius that is not positive.
    """
    count = as_integer_in_range(sides, "the number of sides of a polygon", 3, _MAX_SIDES)
    angle = 2 * math.pi * np.arange(count) / count
    corners = np.column_stack([np.cos(angle), np.sin(angle)])
    return make_outline(as_positive(radius, "the radius of a polygon") * corners)


def _import_package(module: str) -> Any:
    """Import a module of an optional package (matplotlib, for text, or svgpathtools, for SVG
    paths). Raises a ModuleNotFoundError that says how to install it."""
    package = module.partition(".")[0]
    return import_optional(module, f'this outline needs {package}: pip install "harnack[outlines]"')


# Text.


def text(
    words: str,
    size: float = 1.0,
    *,
    font: str | os.PathLike[str] | None = None,
    align: Literal["left", "center", "right"] = "left",
    tolerance: float | None = None,
) -> Outline:
    """Return the outline of text. Its first line starts at the origin and runs along x, with y
    upwards.

    words: one or more lines, set by matplotlib (`pip install harnack[outlines]`).
    size: of the font, in units of length: about the height from the lowest to the highest point of
        a line. Lines are 1.2 sizes apart.
    font: a file (.ttf, .otf), or the name of a family that is installed; None for DejaVu Sans,
        which matplotlib brings.
    align: how lines are aligned to the y axis: whether they begin, have their middle or end there.
    tolerance: the largest distance between the polygons and the letters' curves, a length; by
        default a thousandth of the size.

    Raises:
        ValueError: text without a visible letter, or with letters that the font lacks; an unknown
            font.
        ModuleNotFoundError: without matplotlib.
    """
    size = as_positive(size, "the size of text")
    max_error = (
        _RELATIVE_TOLERANCE * size if tolerance is None else as_positive(tolerance, "the tolerance")
    )
    if not isinstance(words, str) or len(words) > _MAX_LETTERS:  # pyright: ignore
        raise ValueError(f"words must be a text of at most {_MAX_LETTERS:,} letters")
    if align not in ("left", "center", "right"):
        raise ValueError(f'align must be "left", "center" or "right", not {align!r}')
    loops: list[FloatArray] = []
    for number, line in enumerate(words.expandtabs(4).splitlines()):
        line_loops = _text_line_loops(line, font, size, max_error)
        if line_loops:
            x = np.concatenate(line_loops)[:, 0]
            left, right = float(x.min()), float(x.max())
            anchor = {"left": 0.0, "center": 0.5 * (left + right), "right": right}[align]
            shift = np.array([-anchor, -number * _LINE_HEIGHT * size])
            loops += [loop + shift for loop in line_loops]
    if not loops:
        raise ValueError(f"there is nothing to see in the text {words!r:.60}")
    return make_outline(loops, "nonzero")


def _text_line_loops(line: str, font: Any, size: float, max_error: float) -> list[FloatArray]:
    """Return the closed polygons (n, 2) that outline the letters of a line of text.

    font: the name of a font file (.ttf, .otf) or of an installed family; None for the default.
    size: the size of the font, in units of length.
    max_error: the largest distance between a polygon and the curve of a letter, a length.

    Raises:
        ValueError: an unknown font, or a letter that it lacks.
    """
    manager = _import_package("matplotlib.font_manager")
    if font is not None and Path(font).suffix.lower() in (".ttf", ".otf", ".ttc"):
        if not Path(font).is_file():
            raise ValueError(f"there is no font file {os.fspath(font)}")
        properties = manager.FontProperties(fname=os.fspath(font))
    else:
        properties = manager.FontProperties(family="DejaVu Sans" if font is None else str(font))
    try:
        face = _import_package("matplotlib.ft2font").FT2Font(
            manager.findfont(properties, fallback_to_default=False)
        )
    except ValueError:
        raise ValueError(
            f"no font of the family {font!r} is installed: give the path of a .ttf or .otf file"
        ) from None
    except RuntimeError as wrong:
        raise ValueError(f"{font} is no font: {wrong}") from None
    for letter in line:
        if not face.get_char_index(ord(letter)):
            raise ValueError(
                f"the font {face.family_name} has no letter {letter!r}: choose another by font="
            )
    text_to_path = _import_package("matplotlib.textpath").TextToPath()
    points, codes = text_to_path.get_text_path(properties, line, ismath=False)
    # matplotlib makes letters of its own font size.
    scale = size / text_to_path.FONT_SCALE
    positions = np.asarray(points, dtype=np.float64).reshape(-1, 2) * scale
    return _path_to_loops(positions, [int(code) for code in codes], max_error)


# Codes of matplotlib's paths; and the number of points of each code that draws a line or a curve.
_MOVE_CODE, _CLOSE_CODE = 1, 79
_POINTS_OF_CODE = {2: 1, 3: 2, 4: 3}


def _path_to_loops(points: FloatArray, codes: list[int], max_error: float) -> list[FloatArray]:
    """Return the closed polygons (n, 2) of a path of matplotlib, with its curves replaced by
    polylines.

    points, codes: (k, 2), (k,) the path's points, and matplotlib's code for the role of each: the
        start of a polygon, its end, or a point of a line or of a curve.
    max_error: the largest distance of a polyline from its curve, a length.
    """
    loop_pieces: list[list[FloatArray]] = []
    k = 0
    while k < len(codes):
        code = codes[k]
        if code == _MOVE_CODE:
            loop_pieces.append([points[k : k + 1]])
        if code in (_MOVE_CODE, _CLOSE_CODE):
            k += 1
            continue
        count = _POINTS_OF_CODE[code]
        # A line or a curve begins at the last point so far. `flatten_bezier` returns the points of
        # a polyline without the first one, and a bound of its error.
        controls = np.concatenate([loop_pieces[-1][-1][-1:], points[k : k + count]])
        loop_pieces[-1].append(
            flatten_bezier(controls, max_error)[0] if count > 1 else controls[1:]
        )
        k += count
    return _drop_degenerate_loops([np.concatenate(pieces) for pieces in loop_pieces])


def _drop_degenerate_loops(loops: list[FloatArray]) -> list[FloatArray]:
    """Return the loops (n, 2) that have at least three different points. Loops with fewer points
    enclose no area."""
    return [loop for loop in loops if len(np.unique(loop, axis=0)) > 2]


# SVG.

_MAX_SVG_BYTES, _MAX_SVG_ELEMENTS, _MAX_SVG_DEPTH = 32 * 2**20, 200_000, 200
# Elements that are not drawn, nor are the elements in them; and elements that are drawn but not
# supported here.
_HIDDEN = (
    "defs", "symbol", "clipPath", "mask", "marker", "pattern", "linearGradient", "radialGradient",
    "filter", "metadata", "title", "desc", "script", "namedview", "style",
)  # fmt: skip
_UNSUPPORTED_TAGS = ("use", "text", "image", "foreignObject", "switch")
_SHAPES = ("path", "rect", "circle", "ellipse", "polygon", "polyline")
# Words of a style sheet that may change what is filled.
_FILL_CHANGING_RULES = re.compile(r"none|evenodd|transform|hidden|@import|clip|mask", re.IGNORECASE)


def svg(
    path: str | os.PathLike[str], *, scale: float = 1.0, tolerance: float | None = None
) -> Outline:
    """Return the outline of the filled shapes of an SVG file, with y upwards. It is read by
    svgpathtools (`pip install harnack[outlines]`).

    path: of a file with paths, rectangles, circles, ellipses and polygons, in groups and with
        transforms. The outline is that of the union of all filled shapes. Strokes have no outline
        here: a shape with fill="none" is left out.
    scale: the length of the file's unit (a unit of its `viewBox`).
    tolerance: the largest distance between the polygons and the curves, in units of length; by
        default a thousandth of the picture's size.

    Raises:
        FileFormatError (a ValueError): not an SVG file; a file with contents that are not
        supported: text (turn it into paths), images, copies of other elements (`use`), clips and
        masks, style sheets that change fills, entities; or a file that is too large or too deeply
        nested.
        ModuleNotFoundError: svgpathtools is not installed.
        OSError: the file cannot be read.
    """
    scale = as_positive(scale, "the scale of an SVG file")
    if tolerance is not None:
        # In the unit of the file.
        tolerance = as_positive(tolerance, "the tolerance") / scale
    source = Path(path)
    if source.stat().st_size > _MAX_SVG_BYTES:
        raise FileFormatError(f"{source}: an SVG file has at most {_MAX_SVG_BYTES >> 20} MB")
    try:
        root = _parse_svg(source.read_bytes())
        # The root has no transform before it, and inherits no styles.
        shapes = [*_filled_shapes(root, np.eye(3), {})]
        return _outline_of(shapes, scale, tolerance)
    except (ValueError, ArithmeticError, LookupError, ParseError, expat.ExpatError) as wrong:
        raise FileFormatError(f"{source}: {wrong}") from None


def _parse_svg(data: bytes) -> Element:
    """Parse the bytes of an SVG file, and return its root element. Declarations of entities are
    refused: a few entities can stand for billions of letters.

    Raises:
        ValueError: too many elements, too deep nesting, an entity, or another root than <svg>.
    """
    builder = TreeBuilder()
    parser = expat.ParserCreate()
    count = depth = 0

    def start_element(name: str, attributes: dict[str, str]) -> None:
        """Add an element of the XML file to the tree, with its attributes, and with its name
        without the prefix of the namespace. Raises a ValueError if there are too many elements, or
        if they are nested too deeply."""
        nonlocal count, depth
        count, depth = count + 1, depth + 1
        if count > _MAX_SVG_ELEMENTS or depth > _MAX_SVG_DEPTH:
            raise ValueError(
                f"more than {_MAX_SVG_ELEMENTS:,} elements, or {_MAX_SVG_DEPTH} within each other"
            )
        builder.start(name.rpartition(":")[2], attributes)

    def end_element(name: str) -> None:
        """End the current element of the tree."""
        nonlocal depth
        depth -= 1
        builder.end(name.rpartition(":")[2])

    def refuse_entity(*declaration: Any) -> None:
        """Raise a ValueError for the declaration of an entity. declaration: its name comes
        first."""
        raise ValueError(f"it declares the entity {declaration[0]!r}, and entities are not read")

    parser.StartElementHandler, parser.EndElementHandler = start_element, end_element
    parser.CharacterDataHandler = builder.data
    parser.EntityDeclHandler = refuse_entity
    parser.Parse(data, True)  # True: these are all bytes
    root = builder.close()
    if root.tag != "svg":
        raise ValueError(f"its root is <{root.tag}>, and not <svg>")
    return root


def _filled_shapes(
    element: Element, transform: FloatArray, inherited: dict[str, str]
) -> Iterator[tuple[str, FloatArray, FillingRule]]:
    """Yield the filled shapes of an SVG element and of all elements in it. A shape is given by its
    path data (a text), its transform (3, 3) to the picture's coordinates, and its fill rule.

    transform: (3, 3) the transform of the element's parent to the picture's coordinates.
    inherited: the style properties that the parent passes on, by name.

    Raises:
        ValueError: contents that are not supported.
    """
    tag = element.tag
    if tag == "style" and _FILL_CHANGING_RULES.search("".join(element.itertext())):
        raise ValueError("its style sheet may change what is filled: save it with plain attributes")
    if tag in _HIDDEN:
        # (A generator that yields nothing.)
        yield from ()
        return
    styles = {**inherited, **_styles(element)}
    if styles.get("display") == "none":
        return
    if tag in _UNSUPPORTED_TAGS:
        raise ValueError(f"<{tag}> is not read: turn it into paths before the file is saved")
    for name in _CUTTING:
        if styles.pop(name, "none") != "none":
            raise ValueError(f"{name} is not read: cut the shapes before the file is saved")
    if styles.get("transform", "none") != "none" or "transform-origin" in styles:
        raise ValueError("transforms in styles are not read, nor a transform-origin: apply them")
    if "transform" in element.attrib:
        parse_transform = _import_package("svgpathtools.parser").parse_transform
        local_transform: FloatArray = parse_transform(element.attrib["transform"], strict=True)
        transform = transform @ local_transform
    # Shapes that cannot be seen are left out, but the elements in them are looked at.
    is_filled = styles.get("fill") not in ("none", "transparent")
    is_filled &= not _NO_OPACITY.fullmatch(styles.get("fill-opacity", "1"))
    if tag in _SHAPES and is_filled and styles.get("visibility") != "hidden":
        yield (
            _path_data(element),
            transform,
            "even-odd" if styles.get("fill-rule") == "evenodd" else "nonzero",
        )
    for child in element:
        if child.tag == "svg" and {"x", "y", "viewBox"} & child.attrib.keys():
            raise ValueError("an <svg> in another with a place of its own is not read: ungroup it")
        yield from _filled_shapes(
            child, transform, {k: v for k, v in styles.items() if k in _INHERITED}
        )


_INHERITED = ("fill", "fill-rule", "fill-opacity", "visibility", "display")
_NO_OPACITY = re.compile(r"[+-]?0*\.?0*%?")
_CUTTING = ("clip-path", "mask")


def _styles(element: Element) -> dict[str, str]:
    """Return the style properties of an SVG element, by name, as far as they matter for what is
    filled. They are given by its attributes and by its attribute `style`, which overrides the
    others. A transform is included only if it is in `style`."""
    names = (*_INHERITED, *_CUTTING, "transform-origin")
    styles = {name: element.attrib[name].strip() for name in names if name in element.attrib}
    names = (*names, "transform")
    for entry in element.attrib.get("style", "").split(";"):
        name, _, value = entry.partition(":")
        if name.strip() in names:
            styles[name.strip()] = value.strip()
    return styles


_LENGTHS = {"x", "y", "cx", "cy", "width", "height", "r", "rx", "ry"}


def _path_data(element: Element) -> str:
    """Return the path data (the text of SVG's attribute d) of a shape.

    Raises:
        ValueError: a length with a unit, or a size that is negative or not finite.
    """
    converters = _import_package("svgpathtools.svg_to_paths")
    attrib, tag = {k: v.removesuffix("px") for k, v in element.attrib.items()}, element.tag
    if tag == "path":
        return attrib.get("d", "")
    for name in _LENGTHS & attrib.keys():
        # Letters other than e, which belongs to exponents, are units.
        if re.search(r"[%a-df-z]", attrib[name], re.IGNORECASE):
            raise ValueError(
                f'{name}="{attrib[name]:.20}" of a <{tag}> has a unit: save the file with plain '
                "numbers"
            )
    sizes = {name: float(attrib[name]) for name in ("width", "height", "r", "rx", "ry")
             if name in attrib and tag != "polygon"}  # fmt: skip
    if any(not 0 <= size < math.inf for size in sizes.values()):
        raise ValueError(f"a <{tag}> in it has a size that is negative or not finite")
    if tag == "rect":
        # The radius of rounded corners is at most half of a side.
        for name, counterpart, side in (("rx", "ry", "width"), ("ry", "rx", "height")):
            if name in sizes or counterpart in sizes:
                radius = sizes.get(name, sizes.get(counterpart, 0.0))
                attrib = {**attrib, name: str(min(radius, 0.5 * sizes.get(side, 0.0)))}
        return converters.rect2pathd(attrib)
    if tag in ("circle", "ellipse"):
        return converters.ellipse2pathd(attrib)
    return converters.polygon2pathd(attrib, tag == "polygon")


def _outline_of(
    shapes: list[tuple[str, FloatArray, FillingRule]], scale: float, tolerance: float | None
) -> Outline:
    """Return the outline of the union of filled shapes, with y upwards.

    shapes: for each shape its path data, its transform (3, 3), and its fill rule.
    scale: the length of the file's unit.
    tolerance: the largest distance between polygons and curves, in the file's unit; None for a
        thousandth of the picture's size.

    Raises:
        ValueError: nothing is filled.
    """
    paths: list[tuple[list[Any], FloatArray, FillingRule]] = [
        (_segments(data), matrix, rule) for data, matrix, rule in shapes
    ]
    if tolerance is None:
        # The picture's size is that of the box around the ends of all segments.
        ends = [
            matrix[:2, :2] @ _xy(end) + matrix[:2, 2]
            for segments, matrix, _ in paths for part in segments for end in (part.start, part.end)
        ]  # fmt: skip
        size = float(np.ptp(np.array(ends), axis=0).max()) if ends else 0.0
        if not size > 0:
            raise ValueError("it fills nothing")
        tolerance = _RELATIVE_TOLERANCE * size
    loops: list[FloatArray] = []
    # In SVG, y points downwards.
    flip = np.array([scale, -scale])
    for segments, matrix, rule in paths:
        shape_loops = [part * flip for part in _loops(segments, matrix, tolerance)]
        if shape_loops:
            loops += make_outline(shape_loops, rule)
    if not loops:
        raise ValueError("it fills nothing: strokes have no outline; turn them into paths")
    return make_outline(loops, "nonzero")


def _segments(data: str) -> list[Any]:
    """Return the segments (lines, Bezier curves and arcs, objects of svgpathtools) of SVG path
    data.

    Raises:
        ValueError: malformed data, or a number that is not finite.
    """
    parse_path = _import_package("svgpathtools.parser").parse_path
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "Replacing degenerate")  # an arc of radius 0 is a line
        try:
            segments: list[Any] = [*parse_path(data)]
        except AssertionError:
            raise ValueError(
                f"in its path {data!r:.60} an arc ends where it begins: leave it out"
            ) from None
        except (Warning, ArithmeticError, LookupError, ValueError) as wrong:
            raise ValueError(f"its path {data!r:.60} is none: {wrong}") from None
    if not all(np.isfinite([segment.start, segment.end]).all() for segment in segments):
        raise ValueError("a number in it is not finite")
    return segments


def _loops(segments: list[Any], matrix: FloatArray, tolerance: float) -> list[FloatArray]:
    """Return the closed polygons (n, 2) that the segments of an SVG path form, moved by the
    transform `matrix` (3, 3). A polygon is made of successive segments, each of which begins where
    the one before ends. Curves are replaced by polylines within the distance `tolerance`."""
    loop_pieces: list[list[FloatArray]] = []
    end_point: complex | None = None
    for segment in segments:
        # A segment that does not begin where the last one ends begins a new polygon.
        if end_point is None or segment.start != end_point:
            loop_pieces.append([_transform_points(matrix, [segment.start])])
        end_point = segment.end
        kind = type(segment).__name__
        if kind == "Arc":
            loop_pieces[-1].append(_arc(segment, matrix, tolerance))
            continue
        # The control points; of a line these are its two ends.
        controls = _transform_points(matrix, [*segment.bpoints()])
        if not np.isfinite(controls).all():
            raise ValueError("a number in it is not finite")
        # All points but the first, which the polygon has already.
        loop_pieces[-1].append(
            flatten_bezier(controls, tolerance)[0] if len(controls) > 2 else controls[1:]
        )
    # The pieces of each polygon are joined to one array.
    return _drop_degenerate_loops([np.concatenate(segment) for segment in loop_pieces])


def _arc(arc: Any, matrix: FloatArray, tolerance: float) -> FloatArray:
    """Approximate an elliptic arc, moved by the transform `matrix` (3, 3), by a polyline within
    `tolerance`. Returns the points (n, 2) of the polyline without the first one.

    The number of chords, at least 2, follows from a bound of their error: if an arc of the angle a
    and the larger radius r is divided into n chords, they are within r (a/n)^2/8 of it. The
    transform stretches r at most by its matrix norm.

    Raises:
        ValueError: the arc has more than 100,000 chords.
    """
    angle = math.radians(abs(float(arc.delta)))
    max_radius = max(abs(arc.radius.real), abs(arc.radius.imag))
    max_radius *= float(np.linalg.norm(matrix[:2, :2], 2))
    count = max(2.0, angle * math.sqrt(max_radius / (8 * tolerance)))
    if not count <= _MAX_SIDES:
        raise ValueError("an arc in it has too many segments: allow a larger tolerance")
    t = np.linspace(0.0, 1.0, math.ceil(count) + 1)[1:]
    points = [arc.point(float(parameter)) for parameter in t[:-1]]
    return _transform_points(matrix, [*points, arc.end])


def _transform_points(matrix: FloatArray, points: list[complex]) -> FloatArray:
    """Return points, given as complex numbers x + i y, after the transform `matrix` (3, 3), as an
    array (n, 2)."""
    return np.array([_xy(point) for point in points]) @ matrix[:2, :2].T + matrix[:2, 2]


def _xy(z: complex) -> FloatArray:
    """Return the vector (x, y) of the complex number z = x + i y."""
    return np.array([z.real, z.imag])
