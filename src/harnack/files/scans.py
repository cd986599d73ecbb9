"""Reading the files of laser scanners: .las and .laz through laspy, .e57 through pye57.

Coordinates of both are often those of maps, such as 500,000 m east and 5,000,000 m north. They are
read in double precision as they are; `field_from_file` moves their origin if it is asked to.
"""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from harnack.backend import FloatArray
from harnack.files.file_geometry import (
    MAX_BYTES,
    FileGeometry,
    FileLocation,
    errors_of_library,
)
from harnack.files.point_fields import find_normals, unused_notes
from harnack.optional_packages import import_optional

__all__ = ["read_e57", "read_las"]

_INSTALL = "pip install 'harnack[scan]'"
# Coordinates of a point in memory.
_POINT_BYTES = 24


# LAS and LAZ.

# The least size of a record of the header, and where the header says how large it is itself, where
# the points begin, and how many records are before them.
_RECORD_BYTES, _SIZES_OFFSET = 54, 94
# How LASzip numbers the way of packing in layers, and the kinds of numbers of a point; and how many
# layers each kind has. Extra bytes have a layer each.
_LAYERED, _EXTRA_BYTES = 3, 14
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}


def read_las(path: Path, data: bytes) -> FileGeometry:
    """Read the points in the bytes `data` of a .las or .laz file, with their normals if these are
    among its additional numbers (`NormalX`, as CloudCompare writes them). Points that are marked as
    withheld, which means deleted, are left out. Colors and classes are ignored.

    Raises:
        FileFormatError: the file is malformed or truncated, has no points, or too many of them.
        ModuleNotFoundError: laspy, or lazrs for compressed points, is not installed.
    """
    place = FileLocation(path)
    laspy = import_optional("laspy", f"{path.suffix} files are read by laspy: {_INSTALL}")
    _check_las_header(place, data)
    with errors_of_library(place, "LAS"):
        # One thread: several would reserve memory by sizes of chunks that nobody has checked.
        backend = laspy.LazBackend.Lazrs
        reader = laspy.open(BytesIO(data), laz_backend=backend, read_evlrs=False)
        header = reader.header
        count, width = int(header.point_count), int(header.point_format.size)
    if not count:
        raise place.error("it holds no points")
    if header.are_points_compressed:
        import_optional("lazrs", f"compressed points are unpacked by lazrs: {_INSTALL}")
        try:
            _check_packed_sizes(data, header)
        except ValueError as error:
            raise place.error(f"its packed points are damaged: {error}") from None
        except struct.error:
            raise place.error("its packed points end too early: the file is truncated") from None
    room = len(data) - int(header.offset_to_point_data)
    if not header.are_points_compressed and count * width > room:
        raise place.error(
            f"its header promises {count:,} points, but there is room for {room // width:,}: the "
            "file is truncated"
        )
    _check_memory(place, count, count * max(width, _POINT_BYTES))
    with errors_of_library(place, "LAS"):
        points: Any = reader.read_points(count)
        if len(points) != count:
            raise place.error(
                f"its header promises {count:,} points, but {len(points):,} are there: the file is "
                "truncated"
            )
        positions = _las_columns(points, ("x", "y", "z"))
        names = [str(name) for name in header.point_format.dimension_names]
        extra_names = [str(name) for name in header.point_format.extra_dimension_names]
        normal_names = find_normals(extra_names)
        normals = None if normal_names is None else _las_columns(points, normal_names)
        is_kept = ~np.asarray(points["withheld"], np.bool_)
    notes = list(unused_notes(names))
    if not np.isfinite(positions).all():
        raise place.error("coordinates must be finite: its scales or offsets are not")
    if not is_kept.all():
        notes.insert(0, f"{count - int(is_kept.sum()):,} withheld ones left out")
        if not is_kept.any():
            raise place.error("all of its points are withheld, which means deleted")
        positions = positions[is_kept]
        normals = None if normals is None else normals[is_kept]
    return FileGeometry(path, positions, normals, notes=tuple(notes))


def _check_packed_sizes(data: bytes, header: Any) -> None:
    """Raise a ValueError if sizes in the packed points of a .laz file are larger than the file:
    lazrs would reserve memory for them.

    The points stand in chunks, behind the position of a table of these. Since LAS 1.4 a chunk is
    its first point, the number of its points, the sizes of its layers, and the layers: the packed
    bytes of one of the numbers of all points.

    header: laspy's header.
    """
    begin = int(header.offset_to_point_data)
    (table,) = struct.unpack_from("<q", data, begin)
    if table == -1:  # written to a stream: the position stands at the end
        (table,) = struct.unpack_from("<q", data, len(data) - 8)
    position = begin + 8
    _, chunks = struct.unpack_from("<II", data, table)
    if not position <= table < len(data) or chunks > int(header.point_count) + 1:
        raise ValueError("the table of their chunks is wrong")
    records = header.vlrs.get("LasZipVlr")
    if not records:
        raise ValueError("the record that says how they are packed is missing")
    record = records[0].record_data
    (compressor,), (count,) = struct.unpack_from("<H", record), struct.unpack_from("<H", record, 32)
    if compressor != _LAYERED:
        return
    kinds = [struct.unpack_from("<HH", record, 34 + 6 * k) for k in range(count)]
    point_size = sum(size for _, size in kinds)
    layers = sum(size if kind == _EXTRA_BYTES else _LAYERS.get(kind, 0) for kind, size in kinds)
    while position < table:
        sizes = struct.unpack_from(f"<{layers}I", data, position + point_size + 4)
        position += point_size + 4 + 4 * layers + sum(sizes)
    if position != table:
        raise ValueError("the sizes of their chunks are wrong")


def _las_columns(points: Any, names: tuple[str, str, str]) -> FloatArray:
    """Return the vectors (n, 3) whose components are the numbers with these names of the points
    that laspy read."""
    return np.stack([np.asarray(points[name], np.float64) for name in names], axis=1)


def _check_las_header(place: FileLocation, data: bytes) -> None:
    """Raise a FileFormatError if data are not those of a LAS file, or if its header declares more
    records than there is room for, each of which would be read."""
    if not data.startswith(b"LASF"):
        raise place.error("this is no LAS file: it does not begin with 'LASF'")
    if len(data) < _SIZES_OFFSET + 10:
        raise place.error("the file ends within its header: it is truncated")
    size, begin, records = struct.unpack_from("<HII", data, _SIZES_OFFSET)
    if begin > len(data):
        raise place.error(
            f"its points begin at byte {begin:,}, and it has {len(data):,}: the file is truncated"
        )
    if size + records * _RECORD_BYTES > begin:
        raise place.error(f"its header declares {records:,} records, for which there is no room")


def _check_memory(place: FileLocation, points: int, size: int) -> None:
    """Raise a FileFormatError if that many points would take more than the limit for files of bytes
    of memory, which a compressed file could. size: how many they take."""
    if size > MAX_BYTES:
        raise place.error(
            f"its {points:,} points have {size:,} bytes when unpacked: at most {MAX_BYTES:,} are "
            "read; let a program for point clouds leave out some of them"
        )


# E57.

_PAGE, _CHECKSUM = 1024, 4
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


def read_e57(path: Path, data: bytes) -> FileGeometry:
    """Read the points of all scans in an .e57 file, each scan moved to its pose (the place of the
    scanner, and how it was turned). Points that are marked as invalid are left out. Normals, colors
    and pictures are ignored.

    path: the file, which is read again.
    data: its bytes, for checks.

    Raises:
        FileFormatError: the file is malformed or truncated, has no points, or too many of them.
        ModuleNotFoundError: pye57 is not installed.
    """
    place = FileLocation(path)
    pye57 = import_optional("pye57", f".e57 files are read by pye57: {_INSTALL}")
    _check_e57_header(place, data)
    scans: list[FloatArray] = []
    names: set[str] = set()
    invalid = without_rotation = 0
    with errors_of_library(place, "E57"), pye57.E57(str(path)) as file:
        headers = [file.get_header(k) for k in range(file.scan_count)]
        count = sum(int(header.point_count) for header in headers)
        _check_memory(place, count, count * _POINT_BYTES)
        for k, header in enumerate(headers):
            if not header.point_count:
                continue
            points = _valid_points(place, file, header, f"scan {k + 1}")
            invalid += int(header.point_count) - len(points)
            rotation, translation, is_turned = _pose(place, header, f"scan {k + 1}")
            without_rotation += not is_turned
            scans.append(points @ rotation.T + translation)
            names.update(header.point_fields)
    if not sum(map(len, scans)):
        raise place.error("it holds no valid points")
    notes = [f"of {len(headers)} scans at their poses"] if len(headers) > 1 else []
    if invalid:
        notes.append(f"{invalid:,} invalid ones left out")
    if without_rotation:
        notes.append(f"{without_rotation} scans with a rotation of length 0, not turned")
    notes += ["normals not used"] if any(name.startswith("nor:") for name in names) else []
    return FileGeometry(path, np.concatenate(scans), notes=(*notes, *unused_notes(sorted(names))))


def _valid_points(place: FileLocation, file: Any, header: Any, scan: str) -> FloatArray:
    """Return the valid points (n, 3) of a scan in the scanner's own coordinates.

    file, header: pye57's objects for the file and for the scan.
    scan: what the scan is called in messages.

    Raises:
        FileFormatError: the scan has neither Cartesian nor spherical coordinates.
    """
    names = set(header.point_fields)
    if names.issuperset(_CARTESIAN):
        axes, state = _CARTESIAN, "cartesianInvalidState"
    elif names.issuperset(_SPHERICAL):
        axes, state = _SPHERICAL, "sphericalInvalidState"
    else:
        raise place.error(f"{scan} has neither Cartesian nor spherical coordinates")
    has_state = state in names
    columns, buffers = file.make_buffers([*axes, *([state] if has_state else [])],
                                         header.point_count)  # fmt: skip
    read = int(header.points.reader(buffers).read())
    if read != header.point_count:
        raise place.error(f"{scan} declares {header.point_count:,} points, and has {read:,}")
    x, y, z = (np.asarray(columns[name], np.float64) for name in axes)
    if axes is _SPHERICAL:
        distance, azimuth, elevation = x, y, z
        x = distance * np.cos(elevation) * np.cos(azimuth)
        y = distance * np.cos(elevation) * np.sin(azimuth)
        z = distance * np.sin(elevation)
    points = np.stack([x, y, z], axis=1)
    is_valid = np.isfinite(points).all(axis=1)
    if has_state:
        is_valid &= np.asarray(columns[state]) == 0
    return points[is_valid]


def _pose(place: FileLocation, header: Any, scan: str) -> tuple[FloatArray, FloatArray, bool]:
    """Return the rotation (3, 3) and the translation (3,) that move a scan to its pose; and False
    if the file's rotation has the length 0, as some programs write it, and stands for none.

    header: pye57's object for the scan.
    scan: what the scan is called in messages.

    Raises:
        FileFormatError: the numbers of the pose are not finite.
    """
    if not header.has_pose():
        return np.eye(3), np.zeros(3), True
    # Where one of them is missing, pye57 returns that of no motion.
    quaternion = np.asarray(header.rotation, np.float64)
    translation = np.asarray(header.translation, np.float64)
    if not (np.isfinite(quaternion).all() and np.isfinite(translation).all()):
        raise place.error(f"the pose of {scan} has numbers that are not finite")
    largest = float(np.abs(quaternion).max())
    if largest == 0:
        return np.eye(3), translation, False
    quaternion = quaternion / largest
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    return rotation, translation, True


def _check_e57_header(place: FileLocation, data: bytes) -> None:
    """Raise a FileFormatError if data are not those of an E57 file, if it is truncated, or if its
    XML has a document type, whose entities could stand for any amount of text."""
    if not data.startswith(b"ASTM-E57"):
        raise place.error("this is no E57 file: it does not begin with 'ASTM-E57'")
    if len(data) < 48:
        raise place.error("the file ends within its header: it is truncated")
    size, begin, length, page = struct.unpack_from("<QQQQ", data, 16)
    if size != len(data) or begin >= size or length > size or page != _PAGE:
        raise place.error(
            f"its header promises {size:,} bytes in pages of {page:,}, and it has {len(data):,}: "
            "the file is truncated or damaged"
        )
    # A page ends with its checksum, which is not part of the text.
    first = begin // _PAGE * _PAGE
    pages = (data[k : k + _PAGE - _CHECKSUM] for k in range(first, size, _PAGE))
    text = b"".join(pages)[begin - first :][:length]
    if b"<!DOCTYPE" in text:
        raise place.error("its XML has a document type, which E57 files have not")
