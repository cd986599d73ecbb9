"""Sphinx extension: docstrings as this project writes them.

A docstring here is plain text with `code`, *emphasis* and **weight**, "- " lists, indented
formulas, entries ("name: what it is", where name is a parameter or an attribute), and the sections
"Returns:" and "Raises:". Entries become definition lists; names that the reference documents become
links.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Container, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

from sphinx.util.inspect import signature, stringify_signature

import harnack

_REFERENCE = Path(__file__).resolve().parents[2] / "docs" / "reference"
_DIRECTIVE = re.compile(
    r"^\.\. (?:auto|py:)(?:class|data|function):: harnack\.([\w.]+)", re.MULTILINE
)
_SECTION = re.compile(r"(Returns|Raises|Yields):$")
_ENTRY = re.compile(r"(\w+(?:, \w+)*): ?(.*)$")
_ERROR = re.compile(r"[A-Z]\w+$")
_RETURNED = re.compile(r"[a-z]\w*$")
_BULLET = re.compile(r"- ")
# Where another entry may begin within a line.
_ANOTHER = re.compile(r"(?<=\.) (?=\w+: )")
# Defaults of arguments, and how they are shown.
_READABLE = {"<factory>": "...", repr(2 * math.pi): "2 * math.pi"}
# Code, or strong or plain emphasis of words: what follows a space or a bracket and ends a word.
_MARKED = re.compile(
    r"(`[^`]+`|(?<![\w*])\*\*[A-Za-z][^*]*\*\*(?!\w)|(?<![\w*])\*[A-Za-z][^*]*\*(?!\w))"
)


def setup(app: Any) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", process)
    app.connect("autodoc-process-signature", with_readable_defaults)
    return {"parallel_read_safe": True}


def process(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """What autodoc calls with the docstring of each object."""
    lines[:] = list(converted(lines, names_of(thing)))


def with_readable_defaults(
    app: Any, what: str, name: str, thing: Any, options: Any, arguments: str | None, result: Any
) -> tuple[str, Any] | None:
    """Signatures that can be parsed and read: dataclasses write what is no Python for made
    defaults, and angles are numbers. (Sphinx can take defaults from the code, but that of verbs
    has fewer parameters than their signature.) Of a class those of `__init__`, where Sphinx shows
    a `__new__` that takes anything."""
    if what == "class" and arguments and arguments.startswith("(*"):
        aliases = app.config.autodoc_type_aliases
        own = signature(thing.__init__, bound_method=True, type_aliases=aliases)
        public = [p for name, p in own.parameters.items() if not name.startswith("_")]
        arguments = stringify_signature(
            own.replace(parameters=public),
            show_return_annotation=False,
            unqualified_typehints=True,
        )
    for default, readable in _READABLE.items():
        arguments = arguments and arguments.replace(default, readable)
    return arguments and (arguments, result)


def names_of(thing: Any) -> frozenset[str]:
    """Parameters of a function; parameters, fields, attributes and methods of a class."""
    names: set[str] = set()
    if inspect.isclass(thing):
        names.update(dir(thing))
        for base in thing.__mro__:
            names.update(vars(base).get("__annotations__", {}))
    if callable(thing):
        # Constructors of some exceptions are built in, and have no signature.
        with suppress(TypeError, ValueError):
            names.update(inspect.signature(thing).parameters)
    return frozenset(names)


def converted(lines: list[str], names: Container[str]) -> Iterator[str]:
    """The docstring in reStructuredText."""
    inside = None  # what the entries of a section may be, where one has begun
    for is_blank, group in groupby(lines, key=lambda line: not line.strip()):
        block = list(group)
        if is_blank:
            yield ""
        elif not block[0].startswith("    "):
            section = _SECTION.match(block[0])
            inside = section and _entries_of(section[1])
            yield from _block(block, names)
        elif inside:
            yield from _block(_indented(block), inside)
        else:
            yield from _literal(block)


def _block(lines: list[str], names: Container[str]) -> Iterator[str]:
    """Lines without a blank one: text, and entries, lists, formulas and sections within it."""
    kind = ""
    rest = list(_apart(lines, names))
    while rest:
        line = rest.pop(0)
        section, entry = _SECTION.match(line), _ENTRY.match(line)
        if section:
            body = _indented(rest)
            yield from ("", f"**{section[1]}**", "")
            yield from _block(body, _entries_of(section[1]))
            yield ""
            kind = ""
        elif entry and all(name in names for name in entry[1].split(", ")):
            hanging = _indented(rest)
            text = [entry[2], *(hanging or _plain(rest, names))]
            if kind != "entry":
                yield ""
            yield ", ".join(f"``{name}``" for name in entry[1].split(", "))
            yield from _nested(text)
            kind = "entry"
        elif _BULLET.match(line):
            if kind != "bullet":
                yield ""
            yield "- " + inline(line[2:])
            yield from (f"  {inline(more.strip())}" for more in _indented(rest))
            kind = "bullet"
        elif line.startswith("    "):
            yield ""
            yield from _literal([line, *(f"    {more}" for more in _indented(rest))])
            kind = "formula"
        else:
            if kind not in ("", "text"):
                yield ""
            yield inline(line)
            kind = "text"
    yield ""


def _apart(lines: list[str], names: Container[str]) -> Iterator[str]:
    """The lines, broken where another entry begins within one."""
    for line in lines:
        start, *others = _ANOTHER.split(line)
        for other in others:
            if other.split(":")[0] in names:
                yield start
                start = other
            else:
                start = f"{start} {other}"
        yield start


@dataclass(frozen=True)
class _Named:
    """All names of a form, as a container."""

    form: re.Pattern[str]

    def __contains__(self, name: str) -> bool:
        return bool(self.form.match(name))


def _entries_of(section: str) -> Container[str]:
    """The names that stand for entries in a section: errors are classes, others are not."""
    return _Named(_ERROR if section == "Raises" else _RETURNED)


def _indented(rest: list[str]) -> list[str]:
    """Take the indented lines that come first, without their common indent."""
    taken: list[str] = []
    while rest and rest[0].startswith(" "):
        taken.append(rest.pop(0))
    return inspect.cleandoc("\n".join(["", *taken])).splitlines()


def _plain(rest: list[str], names: Container[str]) -> list[str]:
    """Take the lines that go on with an entry though they are not indented."""
    taken: list[str] = []
    while rest and not rest[0].startswith(("- ", " ")) and not _SECTION.match(rest[0]):
        entry = _ENTRY.match(rest[0])
        if entry and all(name in names for name in entry[1].split(", ")):
            break
        taken.append(rest.pop(0))
    return taken


def _nested(text: list[str]) -> Iterator[str]:
    yield from (f"    {inline(line.strip())}" for line in text if line.strip())


def _literal(lines: list[str]) -> Iterator[str]:
    language = "python" if any("hk." in line or "harnack." in line for line in lines) else "text"
    yield from (f".. code-block:: {language}", "", *lines, "")


def inline(text: str) -> str:
    """A line of text: marked parts keep their marks, names of ours become links."""
    parts = _MARKED.split(text)
    for index, part in enumerate(parts):
        if index % 2 == 0:
            parts[index] = re.sub(r"([\\*|_`])", r"\\\1", part)
        elif part.startswith("`"):
            parts[index] = f"\\ {_code(part[1:-1])}\\ "
    return "".join(parts)


def _code(text: str) -> str:
    """Code, linked if it names something that the reference documents."""
    path = documented_path(text.removesuffix("()"))
    return f"``{text}``" if path is None else f":py:obj:`{text} <{path}>`"


def documented_path(name: str) -> str | None:
    """The path under which the reference documents a name, or what it is an attribute of; with or
    without its namespace. None if it does not document it."""
    parts = re.sub(r"^(harnack|hk)\.", "", name).split(".")
    if len(parts) > 1 and parts[0] in dir(harnack) and parts[0] not in harnack.__all__:
        parts = parts[1:]  # a namespace
    paths = _documented_paths()
    for count in (2, 1):
        path = paths.get(".".join(parts[:count]))
        if path is not None:
            return ".".join((path, *parts[count:]))
    return None


@cache
def _documented_paths() -> dict[str, str]:
    """The paths of the reference by their names without the namespace; in a module of a namespace,
    with the module, such as "outline.text"."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in sorted(_REFERENCE.glob("*.md")))
    paths = [path.split(".") for path in _DIRECTIVE.findall(text)]
    return {".".join(path[1:] or path): ".".join(("harnack", *path)) for path in paths}
