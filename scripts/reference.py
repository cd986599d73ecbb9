"""Write what the pages of the reference show of signatures, and the table of all options.

`python scripts/reference.py` brings `docs/reference/*.md` and `docs/options.md` up to date; a test
in `tests/project/test_reference.py` says when they are not.

A page of the reference holds Sphinx directives, which the site replaces by whole docstrings. Behind
each of them this script writes a comment of reStructuredText with the signature and the summary,
for readers of the repository; the site leaves comments out.
"""

from __future__ import annotations

import inspect
import math
import re
import textwrap
from collections.abc import Iterable, Iterator
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any

import harnack
from harnack.cli.arguments import parsers
from harnack.fields.parameters import Parametrized
from harnack.rendering.option_table import OPTIONS, Option, options_of

ROOT = Path(__file__).resolve().parents[1]
REFERENCE, OPTION_PAGE = ROOT / "docs/reference", ROOT / "docs/options.md"
_WIDTH = 96
_DIRECTIVE = re.compile(r"\.\. auto(?:function|class):: (harnack\.[\w.]+)$")

VERBS = (
    "trace", "crossings", "render", "animate", "view", "page", "mesh", "repair",
    "signed_distance", "closest_points", "distance_bounds", "curvature", "curvature_lines",
)  # fmt: skip
OTHERS = (
    "check_print", "read_scene", "write_scene", "expression", "solid", "union", "intersection",
)  # fmt: skip
# Verbs that have the same options, under one name in the table.
_SETS = (
    ("all pictures", ("render", "animate", "view", "page")),
    ("distances", ("signed_distance", "closest_points", "distance_bounds")),
)
_GROUPS = {
    "surface": ("The surface", "Arguments of `hk.Surface`. Beside a bare field they are keywords."),
    "trace": ("Tracing", "Arguments of `hk.TraceOptions`. Without `options` they are keywords."),
    "image": (
        "The picture",
        "On the command line a camera is `--azimuth`, `--elevation`, `--fov`, `--zoom`, "
        "`--position`, `--target` and `--distance`, the arguments of `hk.Camera`.",
    ),
    "style": (
        "Style",
        "On the command line `--isolines-width` and `--isolines-color` are the arguments `width` "
        "and `color` of `hk.Isolines`.",
    ),
    "color": ("Colors of values", ""),
    "quality": ("Quality", ""),
    "run": ("Where it runs", "The command line has `--quiet` in place of `progress`."),
    "film": ("Films", "The command draws 48 frames and goes around once, unless told otherwise."),
    "live": ("Pages and views", ""),
    "server": ("The server of a view", "The command line has `--no-browser`."),
    "mesh": ("Meshes", ""),
    "repair": ("Repair", ""),
}


def main() -> None:
    for path, text in updated_pages().items():
        path.write_text(text, encoding="utf-8")


def updated_pages() -> dict[Path, str]:
    """The generated pages, as they should be."""
    pages = sorted(REFERENCE.glob("*.md"))
    texts = {page: with_signatures(page.read_text(encoding="utf-8")) for page in pages}
    return {**texts, OPTION_PAGE: option_page()}


def with_signatures(text: str) -> str:
    """A page of the reference, with a comment behind each directive."""
    lines = without_comments(text.splitlines())
    result: list[str] = []
    while lines:
        line = lines.pop(0)
        result.append(line)
        directive = _DIRECTIVE.match(line)
        if directive:
            while lines and lines[0].startswith("   :"):
                result.append(lines.pop(0))
            result += ["", "..", *(f"   {row}" for row in summary_of(directive[1]))]
    return "\n".join(result) + "\n"


def without_comments(lines: list[str]) -> list[str]:
    """The lines of a page without the comments that this script has written."""
    result: list[str] = []
    is_comment = False
    for line in lines:
        if line == "..":
            is_comment = True
            if result and not result[-1]:
                result.pop()
        elif not (is_comment and line.startswith("   ")):
            is_comment = False
            result.append(line)
    return result


def summary_of(name: str) -> Iterator[str]:
    """The signature of a function, or of a class and its public members, with what they are."""
    thing = find(name)
    if inspect.isclass(thing) and issubclass(thing, Enum):
        # The constructors of enumerations differ between versions of Python.
        yield from wrapped(f"{thing.__name__}: {', '.join(member.name for member in thing)}")
        yield from described(thing)
        return
    yield from wrapped(f"{name.rpartition('.')[2]}{signature_of(thing)}")
    yield from described(thing)
    if inspect.isclass(thing):
        for member, value in members_of(thing):
            is_function = inspect.isfunction(value) or inspect.ismethod(value)
            yield from wrapped(f".{member}{signature_of(value) if is_function else ''}")
            yield from described(value)


def find(name: str) -> Any:
    """The class or function of a dotted name."""
    module, _, attribute = name.rpartition(".")
    try:
        return getattr(import_module(module), attribute)
    except ModuleNotFoundError:
        return getattr(find(module), attribute)


def members_of(kind: type) -> Iterator[tuple[str, Any]]:
    """The public methods and properties that a class itself defines and documents."""
    # What `Field` has made, `evaluate` of `evaluator` or the other way round, is not theirs.
    attributes: dict[str, Any] = {
        name: value
        for name, value in vars(kind).items()
        if not any(vars(base).get(name) is value for base in kind.__mro__[1:])
        and not getattr(value, "is_derived", False)
    }
    if Parametrized in kind.__bases__:  # which has no entry of its own
        attributes = {**vars(Parametrized), **attributes}
    for name, value in attributes.items():
        if name.startswith("_"):
            continue
        member: Any = getattr(value, "__func__", value)
        if (isinstance(member, property) or inspect.isfunction(member)) and docstring_of(member):
            yield name, getattr(kind, name)


def signature_of(thing: Any) -> str:
    """The parameters of a function or class without types; private ones are left out."""
    try:
        signature = inspect.signature(thing)
    except (TypeError, ValueError):
        return ""
    parameters = [
        parameter.replace(
            annotation=parameter.empty,
            default=parameter.empty
            if parameter.default is parameter.empty
            else _Shown(parameter.default),
        )
        for name, parameter in signature.parameters.items()
        if not name.startswith("_") and name not in ("self", "cls")
    ]
    return str(signature.replace(parameters=parameters, return_annotation=signature.empty))


class _Shown:
    """A default value as a signature shows it."""

    def __init__(self, value: Any) -> None:
        self._value = value

    def __repr__(self) -> str:
        if isinstance(self._value, float) and math.isinf(self._value):
            return "math.inf" if self._value > 0 else "-math.inf"
        text = repr(self._value)
        return "..." if text.startswith("<") or " at 0x" in text or len(text) > 60 else text


def docstring_of(thing: Any) -> str:
    """The docstring of a class or function, or the one that it inherits; empty if there is none."""
    text = inspect.getdoc(thing) or ""
    # From Python 3.13 on, what overrides an attribute that is None inherits None's own docstring.
    return "" if text == type(None).__doc__ else text


def described(thing: Any) -> Iterator[str]:
    """The first paragraph of a docstring, indented."""
    text = docstring_of(thing)
    paragraph = " ".join(text.partition("\n\n")[0].split())
    yield from textwrap.wrap(
        paragraph, _WIDTH, initial_indent="    ", subsequent_indent="    ", break_long_words=False
    )


def wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, subsequent_indent="        ", break_long_words=False)


def option_page() -> str:
    """The page of all verbs and options, from the table of options."""
    lines = [
        "# Every option and every verb",
        "",
        "Written by `python scripts/reference.py` from the table of options "
        "(`src/harnack/rendering/option_table.py`).",
        "",
        "```python",
        "import harnack as hk",
        "",
        "surface = hk.Surface(hk.Gyroid(1.0), level=0.2)",
        "options = hk.TraceOptions(tolerance=1e-5)",
        "hk.trace(surface, [[0, 0, 3.0]], [[0, 0.1, -1.0]], options=options)",
        "hk.trace(hk.Gyroid(1.0), [[0, 0, 3.0]], [[0, 0.1, -1.0]], level=0.2, tolerance=1e-5)",
        "```",
        "",
        "Every verb takes a field or a `hk.Surface`, and `options=`, a `hk.TraceOptions`. The "
        "arguments of both are keywords as well, as in the last line. Beside the object that "
        "holds them they raise a `TypeError`, and so does an option that the verb does not have. "
        "`render`, `animate`, `view` and `page` also take a list of surfaces.",
        "",
        "## Verbs",
        "",
        "| verb | arguments of its own | what it does |",
        "|---|---|---|",
        *(verb_row(verb) for verb in VERBS),
        "",
        "Other functions at the top take none of the options below, but for those that a scene "
        "file holds.",
        "",
        "| function | arguments | what it does |",
        "|---|---|---|",
        *(verb_row(name) for name in OTHERS),
        "",
        "## Options",
        "",
        "The last column says which verbs have the option: *all pictures* are `render`, `animate`, "
        "`view` and `page`; *distances* are `signed_distance`, `closest_points` and "
        "`distance_bounds`. An option with a star may be a function of s in a film, and of "
        "sliders in a view or a page. Defaults are in brackets.",
    ]
    for group, (title, text) in _GROUPS.items():
        lines += ["", f"### {title}", ""]
        lines += [text, ""] if text else []
        lines += ["| option | command line | what it says | verbs |", "|---|---|---|---|"]
        lines += [option_row(option) for option in OPTIONS if option.group == group]
    return "\n".join(lines) + "\n"


def verb_row(verb: str) -> str:
    function = find(f"harnack.{verb}" if verb in harnack.__all__ else f"harnack.distance.{verb}")
    known = {option.name for option in options_of(verb)} | {"options"}
    own = [
        name
        for name, parameter in inspect.signature(function).parameters.items()
        if name not in known and parameter.kind is not parameter.VAR_KEYWORD
    ]
    name = f"hk.{verb}" if verb in harnack.__all__ else f"hk.distance.{verb}"
    first_sentence = " ".join((inspect.getdoc(function) or "").partition("\n\n")[0].split())
    return _row(f"`{name}`", ", ".join(f"`{one}`" for one in own), first_sentence)


def option_row(option: Option) -> str:
    has_flag = any(option.flag in command.options() for command in parsers()[1].values())
    command = f"`{option.flag} {option.value}`".replace(" `", "`") if has_flag else ""
    star = " *" if option.varies else ""
    return _row(f"`{option.name}`{star}", command, option.help, verbs_text(option.verbs))


def verbs_text(verbs: Iterable[str]) -> str:
    """The verbs in their order, sets of them under one name."""
    left = set(verbs)
    names: list[tuple[int, str]] = []
    for name, members in _SETS:
        if left.issuperset(members):
            left -= set(members)
            names.append((VERBS.index(members[0]), name))
    names += [(VERBS.index(verb), f"`{verb}`") for verb in left]
    return ", ".join(name for _, name in sorted(names))


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", r"\|").replace("*", r"\*") for cell in cells) + " |"


if __name__ == "__main__":
    main()
