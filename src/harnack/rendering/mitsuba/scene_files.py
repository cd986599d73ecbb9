"""Mitsuba scenes in XML files: checked before, and errors told in words, after Mitsuba reads them.

Mitsuba's parser looks at neither kind nor size of a file: it waits for ever at a pipe, and takes
all memory for a file of many gigabytes.
"""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from harnack.fields.expressions import looks_like_formula
from harnack.files.file_format import MAX_BYTES, Place, read_bytes
from harnack.files.surfaces import SURFACE_FILES

_BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16",
    b"<\0": "utf-16-le", b"\0<": "utf-16-be",
}  # fmt: skip
# Elements that name files: <include filename="..."/>, <string name="filename" value="..."/>.
_NAMES_A_FILE = re.compile(r"<(include|string)\b([^<>]*)>")
_ATTRIBUTE = re.compile(r"""\b(filename|value)\s*=\s*(?:"([^"]*)"|'([^']*)')""")
# What an error of Mitsuba says besides what is wrong: places in its own source, Python's traceback.
_SOURCE_PLACE = re.compile(r"\[\w+\.(?:cpp|h):\d+\]\s*")
_TRACEBACK = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t]+.*\n)*(?:[\w.]+: )?")
_REPEATED = re.compile(r"(?m)^(.*\n)(?:\1)+")


def load_scene_file(mi: Any, path: str | os.PathLike[str]) -> Any:
    """The scene in an XML file.

    Raises:
        FileFormatError: missing, no ordinary file, unreadable, empty, above 256 MiB, no XML; or
            so for a file that it includes.
        RuntimeError: Mitsuba cannot read it; the message says where.
    """
    path = Path(path)
    check_scene_file(path)
    try:
        return mi.load_file(os.fspath(path), parallel=False)
    except RuntimeError as error:
        raise RuntimeError(without_traceback(str(error))) from error


def load_dictionary(mi: Any, description: Mapping[str, Any]) -> Any:
    """The scene, or another object of Mitsuba's, that a dictionary describes.

    Raises:
        RuntimeError: Mitsuba cannot make it; the message says which entry is wrong.
    """
    try:
        return mi.load_dict({**description}, parallel=False)
    except RuntimeError as error:
        raise RuntimeError(without_traceback(str(error))) from error


def check_scene_file(path: Path) -> None:
    """Look at a scene file and the files that it names before Mitsuba does."""
    if path.suffix.lower() in SURFACE_FILES:
        raise Place(path).error(
            "this is a surface file, not a Mitsuba scene (.xml): draw the field that "
            "harnack.field_from_file.open_surface(path).field makes of it"
        )
    if looks_like_formula(str(path)) and not path.exists():
        raise Place(path).error(
            "there is no such file; of a formula, take the field harnack.expression(text)"
        )
    if not path.suffix and not path.exists():
        raise Place(path).error(
            "there is no such file; Mitsuba scenes are .xml files, and scenes of the gallery are "
            "drawn by harnack.gallery.SCENES[name].render()"
        )
    seen = {path}
    waiting = [path]
    total = 0
    while waiting:
        text = _scene_text(waiting.pop())
        total += len(text)
        if total > MAX_BYTES:
            raise Place(path).error(f"with what it includes it has more than {MAX_BYTES:,} bytes")
        for element, name in _files_named(text):
            file = path.parent / name
            # What is not found here may lie where the scene tells Mitsuba to look.
            if file in seen or not _exists(file):
                continue
            seen.add(file)
            if element == "include":
                waiting.append(file)
            elif not file.is_file() and not file.is_dir():
                raise Place(file).error("this is not an ordinary file")


def _scene_text(path: Path) -> str:
    """The text of a file that may be XML."""
    data = read_bytes(path)
    mark = next((mark for mark in _BYTE_ORDER_MARKS if data.startswith(mark)), b"")
    text = data.decode(_BYTE_ORDER_MARKS.get(mark, "latin-1"), "replace")
    if not text.lstrip("\ufeff \t\r\n").startswith("<"):
        raise Place(path).error("this is no XML file: it does not begin with '<'")
    if "\0" in text:
        raise Place(path).error("this is binary data, not the text that its extension announces")
    return text


def _files_named(text: str) -> list[tuple[str, str]]:
    """(element, name) of the files that a scene may name."""
    return [
        (element[1], attribute[2] or attribute[3])
        for element in _NAMES_A_FILE.finditer(text)
        for attribute in _ATTRIBUTE.finditer(element[2])
        if attribute[2] or attribute[3]
    ]


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def without_traceback(message: str) -> str:
    """What an error of Mitsuba says is wrong, without Python's traceback and source lines."""
    message = _SOURCE_PLACE.sub("", _TRACEBACK.sub("", message))
    return _REPEATED.sub(r"\1", message).strip()
