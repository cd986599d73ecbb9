"""Writing .3mf files, which slicers read: an archive with a mesh in XML, its unit, and its colors
by the materials extension of the standard. (trimesh writes no colors.)"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from harnack.backend import IntArray
from harnack.files.mesh_contents import Colors, LengthUnit, MeshContents

__all__ = ["write_3mf"]

_UNITS: Mapping[LengthUnit, str] = MappingProxyType(
    {"mm": "millimeter", "cm": "centimeter", "m": "meter", "in": "inch"}
)
_SCHEMAS = "http://schemas.microsoft.com/3dmanufacturing"
_PACKAGES = "http://schemas.openxmlformats.org/package/2006"
_DECLARATION = '<?xml version="1.0" encoding="UTF-8"?>\n'
_MODEL = "3D/3dmodel.model"
_CONTENT_TYPES = (
    f'{_DECLARATION}<Types xmlns="{_PACKAGES}/content-types">'
    '<Default Extension="rels" '
    'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" '
    'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
_RELATIONSHIPS = (
    f'{_DECLARATION}<Relationships xmlns="{_PACKAGES}/relationships">'
    f'<Relationship Id="model" Target="/{_MODEL}" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
)
# The time that is written into archives, so that the same mesh makes the same file.
_TIME = (1980, 1, 1, 0, 0, 0)


def write_3mf(path: Path, contents: MeshContents, unit: LengthUnit) -> None:
    """Write a mesh as a .3mf file, as a single part that is to be printed.

    path: the file to write.
    unit: the unit of its coordinates.
    """
    colors, color_of_corner = _colors(contents)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in (
            ("[Content_Types].xml", _CONTENT_TYPES), ("_rels/.rels", _RELATIONSHIPS),
        ):  # fmt: skip
            archive.writestr(_entry(name), text)
        with archive.open(_entry(_MODEL), "w", force_zip64=True) as file:
            for text in _model(contents, unit, colors, color_of_corner):
                file.write(text.encode())


def _entry(name: str) -> zipfile.ZipInfo:
    """Return the description of a file in an archive."""
    entry = zipfile.ZipInfo(name, _TIME)
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


def _colors(contents: MeshContents) -> tuple[Colors | None, IntArray | None]:
    """Return the distinct colors (k, 4) of a mesh; and for each corner of a face (m, 3) the index
    of its color. None if the mesh has no colors."""
    given = contents.vertex_colors if contents.face_colors is None else contents.face_colors
    if given is None:
        return None, None
    distinct, index = np.unique(given, axis=0, return_inverse=True)
    index = index.ravel()
    if contents.face_colors is None:
        return distinct, index[contents.faces]
    return distinct, np.repeat(index[:, None], 3, axis=1)


def _model(
    contents: MeshContents,
    unit: LengthUnit,
    colors: Colors | None,
    color_of_corner: IntArray | None,
) -> Iterator[str]:
    """Yield the text of the model, piece by piece."""
    yield (
        f'{_DECLARATION}<model unit="{_UNITS[unit]}" xml:lang="en-US" '
        f'xmlns="{_SCHEMAS}/core/2015/02" xmlns:m="{_SCHEMAS}/material/2015/02"><resources>'
    )
    of_object = ""
    if colors is not None:
        yield '<m:colorgroup id="2">'
        yield from (f'<m:color color="#{r:02X}{g:02X}{b:02X}{a:02X}"/>' for r, g, b, a in colors)
        yield "</m:colorgroup>"
        of_object = ' pid="2" pindex="0"'
    yield f'<object id="1" type="model"{of_object}><mesh><vertices>'
    # As few digits as are needed for the very number.
    yield from _joined(
        f'<vertex x="{x!r}" y="{y!r}" z="{z!r}"/>' for x, y, z in contents.vertices.tolist()
    )
    yield "</vertices><triangles>"
    rows = contents.faces.tolist()
    if color_of_corner is None:
        yield from _joined(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in rows)
    else:
        yield from _joined(
            f'<triangle v1="{a}" v2="{b}" v3="{c}" pid="2" p1="{p}" p2="{q}" p3="{r}"/>'
            for (a, b, c), (p, q, r) in zip(rows, color_of_corner.tolist(), strict=True)
        )
    yield '</triangles></mesh></object></resources><build><item objectid="1"/></build></model>'


def _joined(texts: Iterable[str], count: int = 4096) -> Iterator[str]:
    """Yield texts joined, `count` at a time, as writing each of them takes long."""
    pieces: list[str] = []
    for text in texts:
        pieces.append(text)
        if len(pieces) == count:
            yield "".join(pieces)
            pieces.clear()
    yield "".join(pieces)
