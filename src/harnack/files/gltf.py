"""Reading .glb and .gltf scenes through trimesh, after their headers were checked. A "scene" is a
tree of nodes; each has a transform, and may draw a mesh. A "buffer" is a block of bytes, an
"accessor" describes an array in it (type and length), and a "primitive" is a part of a mesh that
draws triangles, points or lines. `place` is the file, for error messages.

A glTF file is a JSON header and buffers of bytes. The header says which bytes to read, and a
hostile header can ask for more memory than there is; so it is compared with the sizes of the
buffers first.
"""

from __future__ import annotations

import json
import math
from io import BytesIO
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.files.file_geometry import (
    MAX_BYTES,
    FileGeometry,
    FileLocation,
    errors_of_library,
    joined_meshes,
    placed_mesh,
    read_bytes,
)

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_NODE_DEPTH = 1000
# Extensions by which files move or hide geometry, or store vertices otherwise.
_UNSUPPORTED_EXTENSIONS = (
    "EXT_mesh_gpu_instancing", "KHR_mesh_quantization", "KHR_node_visibility",
    "EXT_meshopt_compression", "KHR_meshopt_compression",
)  # fmt: skip
# Codes of the modes in which a primitive lists triangles: one by one, in strips, in fans.
_TRIANGLES, _FAN = (4, 5), 6
# Extensions that do not change how vertices and indices are stored.
_IGNORED_EXTENSIONS = ("KHR_materials", "KHR_texture", "KHR_lights", "EXT_texture", "KHR_xmp")


def read_gltf(path: Path, data: bytes) -> FileGeometry:
    """Read all triangles of the scene in a .glb or .gltf file, moved to the positions that its
    nodes give them. If it has no triangles, read all its points.

    data: the bytes of the file.

    Raises:
        FileFormatError: the file is truncated, malformed or compressed; it asks for more data than
            it holds; a file that it refers to is missing; or it has neither triangles nor points.
    """
    import trimesh  # here, since it takes half a second

    place = FileLocation(path)
    header = _header(place, data)
    with errors_of_library(place, "glTF"):
        files = _buffer_files(path, header)
        _check_header(place, header, len(data) + sum(map(len, files.values())))
        scene: Any = trimesh.load(
            BytesIO(data),
            file_type=path.suffix.lower()[1:],
            resolver=files,
            force="scene",
            process=False,
            skip_materials=True,
        )
        return _contents(place, scene)


def _header(place: FileLocation, data: bytes) -> dict[str, Any]:
    """Return the JSON header of a .gltf file, or of a .glb file, from the bytes `data` of the file.

    Raises:
        FileFormatError: another format or version, a truncated file, or no JSON object.
    """
    text = data
    if place.path.suffix.lower() == ".glb":
        # Twenty bytes precede the JSON header.
        if len(data) < 20 or data[:4] != b"glTF":
            raise place.error("this is no .glb file: it does not begin with 'glTF'")
        # A .glb file begins with "glTF", the version and the file's length; then come the length of
        # the header and its type.
        version, length, size = (int.from_bytes(data[k : k + 4], "little") for k in (4, 8, 12))
        if version != 2:
            raise place.error(f"version {version} of glTF is not read, only 2")
        if length > len(data) or size > len(data) - 20:
            raise place.error(
                f"its header promises {max(length, size + 20):,} bytes, but the file has "
                f"{len(data):,}: it is truncated"
            )
        # The header begins behind the first 20 bytes.
        text = data[20 : 20 + size]
    try:
        header: Any = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise place.error(f"its header is no JSON ({str(error)[:80]})") from None
    if not isinstance(header, dict):
        raise place.error("its header is no JSON object")
    return cast("dict[str, Any]", header)


def _buffer_files(path: Path, header: dict[str, Any]) -> dict[str, bytes]:
    """Read the separate files in which a scene stores its buffers. Returns their contents by the
    names that the header gives them. path: of the scene's file.

    Raises:
        FileFormatError: a buffer is not a file in the scene's folder or below, or they are too
            large.
    """
    files: dict[str, bytes] = {}
    for buffer in header.get("buffers", []):
        uri: Any = buffer.get("uri")
        if uri is None or uri.startswith("data:") or uri in files:
            continue
        name = Path(unquote(uri))
        # A hostile file could name any file of this machine.
        if name.is_absolute() or ".." in name.parts or ":" in uri:
            raise FileLocation(path).error(f"its buffer {uri[:80]!r} is not a file beside it")
        files[uri] = read_bytes(path.parent / name)
        if sum(map(len, files.values())) > MAX_BYTES:
            raise FileLocation(path).error(
                f"its buffers are too large: at most {MAX_BYTES:,} bytes"
            )
    return files


def _check_header(place: FileLocation, header: dict[str, Any], size: int) -> None:
    """Raise a FileFormatError if a header needs extensions or features that are not supported, or
    asks for more data than the file has. A malformed header may raise an error of any type.

    size: the number of bytes of the file and its buffers.
    """
    for name in header.get("extensionsRequired", []):
        if not str(name).startswith(_IGNORED_EXTENSIONS):
            raise place.error(f"it needs the extension {name}, which is not read: save it without")
    for name in header.get("extensionsUsed", []):
        if name in _UNSUPPORTED_EXTENSIONS:
            raise place.error(f"it uses the extension {name}, which is not read: save it without")
    _check_supported(place, header)
    views, accessors = header.get("bufferViews", []), header.get("accessors", [])
    # The bytes of all arrays. Several arrays may share bytes of the file, but not without limit.
    total = 0
    for view in views:
        if _count(view, "byteLength") + _count(view, "byteOffset", 0) > size:
            raise place.error("a buffer view lies outside the file: it is truncated")
        total += view["byteLength"]
    for accessor in accessors:
        element_bytes = _COMPONENT_BYTES[accessor["componentType"]] * _COMPONENTS[accessor["type"]]
        total += _count(accessor, "count") * element_bytes
        _count(accessor, "byteOffset", 0)  # raises the error of a wrong offset
    # Of small files, 64 KiB count as their size.
    if total > 8 * max(size, 1 << 16):
        raise place.error(
            f"its header asks for {total:,} bytes of data, many times those of the file ({size:,})"
        )
    _check_nodes(place, header, _corner_counts(place, header, accessors))


def _check_supported(place: FileLocation, header: dict[str, Any]) -> None:
    """Raise a FileFormatError if a scene has features that are not supported: vertices that are
    moved by skins or morph targets, fans of triangles, or points or lines beside triangles."""
    nodes: list[Any] = header.get("nodes", [])
    meshes: list[Any] = header.get("meshes", [])
    if any("skin" in node for node in nodes):
        raise place.error("its vertices are moved by a skin: apply it, and save the mesh as it is")
    primitives = [item for mesh in meshes for item in mesh["primitives"]]
    weights = [weight for item in (*nodes, *meshes) for weight in item.get("weights", [])]
    if any(weights) and any("targets" in item for item in primitives):
        raise place.error(
            "its vertices are moved by morph targets: apply them, and save the mesh as it is"
        )
    modes = {item.get("mode", _TRIANGLES[0]) for item in primitives}
    if _FAN in modes:
        raise place.error("triangles in fans are not read: save them one by one")
    if modes & {*_TRIANGLES} and modes - {*_TRIANGLES}:
        raise place.error("it draws points or lines beside triangles: save one kind alone")


def _corner_counts(place: FileLocation, header: dict[str, Any], accessors: list[Any]) -> list[int]:
    """Return the number of triangle corners that each mesh in the header of a scene lists.
    accessors: the header's descriptions of arrays, which contain their lengths.

    Raises:
        FileFormatError: vertices or indices are compressed or sparse.
    """
    corner_counts: list[int] = []
    for mesh in header.get("meshes", []):
        total = 0
        for primitive in mesh["primitives"]:
            accessor_ids = [primitive["attributes"]["POSITION"]]
            accessor_ids += [primitive["indices"]] if "indices" in primitive else []
            for accessor_id in accessor_ids:
                accessor = accessors[accessor_id]
                if "bufferView" not in accessor or "sparse" in accessor:
                    raise place.error("compressed or sparse vertices are not read: save it plainly")
            # The indices list the corners; without indices, the vertices do.
            total += accessors[accessor_ids[-1]]["count"]
        corner_counts.append(total)
    return corner_counts


def _check_nodes(place: FileLocation, header: dict[str, Any], corner_counts: list[int]) -> None:
    """Raise a FileFormatError if the nodes of a scene do not form trees, if the trees are too deep,
    or if the meshes at all nodes together have too many corners.

    corner_counts: the number of corners of each mesh.
    """
    nodes: list[Any] = header.get("nodes", [])
    children = {k: node.get("children", []) for k, node in enumerate(nodes)}
    descendants = [child for child_list in children.values() for child in child_list]
    roots = [root for scene in header.get("scenes", []) for root in set(scene.get("nodes", []))]
    if len(descendants) != len(set(descendants)) or set(descendants) & set(roots):
        raise place.error("a node of its scene hangs below two others")
    # Go down the trees level by level.
    generation, depth = set(roots), 0
    while generation:
        generation, depth = {child for node in generation for child in children[node]}, depth + 1
        if depth > _MAX_NODE_DEPTH:
            raise place.error(f"its scene is nested more than {_MAX_NODE_DEPTH} nodes deep")
    mesh_ids: list[int] = [node["mesh"] for node in nodes if "mesh" in node]
    total = sum(corner_counts[mesh] for mesh in mesh_ids)
    # The limit for bytes serves as a limit for corners.
    if total > MAX_BYTES:
        raise place.error(f"its scene draws {total:,} corners: at most {MAX_BYTES:,} are read")


def _count(entry: dict[str, Any], key: str, default: int | None = None) -> int:
    """Return the nonnegative integer entry[key] of a header, or `default` if the key is missing.
    Raises a ValueError if it is not a nonnegative integer."""
    value = entry.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{key} is {value!r}")
    return value


def _contents(place: FileLocation, scene: Any) -> FileGeometry:
    """Return the triangles of a trimesh scene in world coordinates; if there are none, its points.

    Raises:
        FileFormatError: an index out of range; neither triangles nor points.
    """
    meshes: list[tuple[FloatArray, IntArray]] = []
    points: list[FloatArray] = []
    for node in scene.graph.nodes_geometry:
        world_from_node, name = scene.graph[node]
        geometry = scene.geometry[name]
        positions, corners = placed_mesh(geometry, world_from_node)
        if not math.isfinite(float(np.abs(positions).max(initial=0.0))):
            raise place.error("coordinates must be finite")
        if not hasattr(geometry, "faces"):
            # Lines have entities; the other geometries are points.
            points += [] if hasattr(geometry, "entities") else [positions]
            continue
        if corners.size and (corners.min() < 0 or corners.max() >= len(positions)):
            raise place.error(
                f"vertex {corners.max()} of mesh {name[:40]!r} is out of range: it has "
                f"{len(positions):,} vertices"
            )
        meshes.append((positions, corners))
    if any(len(corners) for _, corners in meshes):
        return joined_meshes(place.path, meshes)
    if points:
        return FileGeometry(place.path, np.concatenate(points))
    raise place.error("its scene has neither triangles nor points")
