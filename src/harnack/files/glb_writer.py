"""Writing .glb files, the binary form of glTF 2.0.

Its standard says that coordinates are meters, that y is up, and that colors of vertices are linear.
So the node of the mesh has a matrix that turns z to y and scales, while vertices keep their own
coordinates, in which a closed mesh is closed after rounding to single precision; and colors are
stored with 16 bits, since linear ones of 8 bits show steps where they are dark. (trimesh writes
bytes of sRGB, and no matrix.)
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.files.mesh_contents import MeshContents, linear_colors

__all__ = ["write_glb"]

# Numbers of the standard: component types, targets of buffers, and the two kinds of chunks.
_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_VERTEX_DATA, _INDEX_DATA = 34962, 34963
_JSON, _BINARY = 0x4E4F534A, 0x004E4942


def write_glb(path: Path, contents: MeshContents, meters: float) -> None:
    """Write a mesh, in which z is up, as a .glb file.

    path: the file to write.
    meters: how many meters the unit of the mesh is long.
    """
    mesh = contents.at_vertices()
    buffer = _Buffer()
    attributes = {
        "POSITION": buffer.add(mesh.positions.astype("<f4"), _FLOAT, "VEC3", has_box=True)
    }
    if mesh.normals is not None:
        attributes["NORMAL"] = buffer.add(mesh.normals.astype("<f4"), _FLOAT, "VEC3")
    is_transparent = False
    if mesh.colors is not None:
        values = np.rint(65535 * linear_colors(mesh.colors)).astype("<u2")
        attributes["COLOR_0"] = buffer.add(values, _UINT16, "VEC4", is_normalized=True)
        is_transparent = bool((mesh.colors[:, 3] < 255).any())
    indices = buffer.add(mesh.faces.astype("<u4").ravel(), _UINT32, "SCALAR", target=_INDEX_DATA)
    s = meters
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "harnack"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        # Column by column: (x, y, z) becomes s (x, z, -y).
        "nodes": [{"mesh": 0, "matrix": [s, 0, 0, 0, 0, 0, -s, 0, 0, s, 0, 0, 0, 0, 0, 1]}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        # Without a material, surfaces would be of metal.
        "materials": [
            {
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.7},
                "doubleSided": not contents.is_closed,
                "alphaMode": "BLEND" if is_transparent else "OPAQUE",
            }
        ],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(buffer.data)
    if size >= 1 << 32:
        raise ValueError(f"{path}: {size:,} bytes are too many for a .glb file: below 4 GiB fit")
    with path.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, size))
        file.write(struct.pack("<II", len(text), _JSON) + text)
        file.write(struct.pack("<II", len(buffer.data), _BINARY))
        file.write(buffer.data)


class _Buffer:
    """The bytes of all arrays of a file, and the entries of its header that describe them."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(
        self,
        array: npt.NDArray[Any],
        component: int,
        kind: str,
        *,
        target: int = _VERTEX_DATA,
        is_normalized: bool = False,
        has_box: bool = False,
    ) -> int:
        """Add an array, and return the number of its accessor.

        component, kind: the type of its numbers, and whether a row is a vector, in the standard's
            terms.
        target: which kind of buffer it is for.
        is_normalized: whether its integers stand for numbers from 0 to 1.
        has_box: whether the accessor names the least and the largest number of each column.
        """
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append({**view, "target": target})
        self.data += array.tobytes()
        self.data += bytes(-len(self.data) % 4)
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1, "componentType": component, "count": len(array),
            "type": kind,
        }  # fmt: skip
        if is_normalized:
            accessor["normalized"] = True
        if has_box:
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1
