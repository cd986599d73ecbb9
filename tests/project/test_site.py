"""What the documentation site is made of: every public name, every scene, docstrings as written."""

from __future__ import annotations

import importlib
import importlib.util
import operator
import re
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

import harnack as hk
from harnack.gallery import SCENES

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


def extension(name: str) -> ModuleType:
    """A Sphinx extension of the site."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts/site" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def documented() -> set[str]:
    """The names that the reference documents."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in DOCS.glob("reference/*.md"))
    pattern = r"^\.\. (?:auto\w+|py:\w+):: harnack\.([\w.]+)"
    return set(re.findall(pattern, text, re.MULTILINE))


def namespaces() -> dict[str, ModuleType]:
    """The modules at the top of harnack, by name."""
    things = {name: getattr(hk, name) for name in dir(hk)}
    return {name: thing for name, thing in things.items() if isinstance(thing, ModuleType)}


def test_the_reference_has_every_public_name() -> None:
    assert set(hk.__all__) <= documented()


# Rooms whose names are for the library itself; what users need of them is in other namespaces.
INNER = ("arithmetic", "enclosures", "gallery", "tracer")


@pytest.mark.parametrize("namespace", sorted({*namespaces()} - {*INNER}))
def test_the_reference_has_every_name_of_a_namespace(namespace: str) -> None:
    """Under one path: `hk.geometry.Ball` is `hk.Ball`, for example."""
    things = {id(attribute_at(path)) for path in documented()}
    public = public_things(namespaces()[namespace])
    assert [name for name, thing in public.items() if id(thing) not in things] == []


def test_the_reference_has_what_users_need_of_the_tracer() -> None:
    assert {"tracer.HitTolerance", "tracer.RayCrossings", "TraceOptions", "Surface"} <= documented()


def attribute_at(path: str) -> object:
    """The thing that a path below harnack names. Raises AttributeError if there is none."""
    try:
        return operator.attrgetter(path)(hk)
    except AttributeError:
        parent, _, name = path.rpartition(".")  # a module within a package
        return getattr(importlib.import_module(f"harnack.{parent}"), name)


def public_things(module: ModuleType) -> dict[str, object]:
    """What a module makes public and what is explained: all but names of types. Of a module within
    it, such as `outline`, what that makes public; without `__all__`, what it defines."""
    things: dict[str, object] = {}
    own = [
        name
        for name, thing in vars(module).items()
        if not name.startswith("_") and getattr(thing, "__module__", "") == module.__name__
    ]
    for name in getattr(module, "__all__", own):
        thing = getattr(module, name)
        if isinstance(thing, ModuleType):
            things |= {f"{name}.{inner}": value for inner, value in public_things(thing).items()}
        elif (getattr(thing, "__module__", None) or "").startswith("harnack"):
            things[name] = thing
    return things


def test_every_scene_has_a_picture() -> None:
    gallery = extension("gallery")
    assert [name for name in SCENES if gallery.picture_of(name, DOCS) is None] == []


def test_every_example_has_a_picture() -> None:
    pictures = {path.stem for path in (DOCS / "images/examples").iterdir()}
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} <= pictures


def rendered(text: str, *names: str) -> str:
    lines = list(extension("docstrings").converted(text.splitlines(), names))
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).strip()


def test_entries_become_a_list_of_definitions() -> None:
    text = "a, b: two numbers,\n    both positive. c: a third.\nd: the last\nPlain: text."
    expected = (
        "``a``, ``b``\n    two numbers,\n    both positive.\n"
        "``c``\n    a third.\n``d``\n    the last\n    Plain: text."
    )
    assert rendered(text, "a", "b", "c", "d") == expected


def test_what_is_no_entry_stays_text() -> None:
    assert rendered("Proof: it is so.\nnote: this too") == "Proof: it is so.\nnote: this too"


def test_errors_are_listed() -> None:
    text = (
        "Does it.\n\nRaises:\n    ValueError: not that,\n        nor this.\n    OSError: no file."
    )
    expected = (
        "Does it.\n\n**Raises**\n\n``ValueError``\n    not that,\n    nor this.\n"
        "``OSError``\n    no file."
    )
    assert rendered(text) == expected


def test_what_is_returned_may_have_entries_and_paragraphs() -> None:
    text = "Returns:\n    One with\n    size: how large\n        it is.\n\n    More of it."
    assert rendered(text) == (
        "**Returns**\n\nOne with\n\n``size``\n    how large\n    it is.\n\nMore of it."
    )


def test_lists_and_formulas_are_kept() -> None:
    assert rendered("Of:\n- one\n  thing\n- two\n\n    x_i = |y|") == (
        "Of:\n\n- one\n  thing\n- two\n\n.. code-block:: text\n\n    x_i = |y|"
    )


def test_marks_of_restructured_text_are_taken_as_they_stand() -> None:
    inline = extension("docstrings").inline
    assert inline("|f_v| <= a*b*c, **every** x**2 + y**2, *unit*") == (
        r"\|f\_v\| <= a\*b\*c, **every** x\*\*2 + y\*\*2, *unit*"
    )


@pytest.mark.parametrize(
    ("thing", "shown"),
    [
        (hk.Gyroid, "(cell: float = 2 * math.pi, *, domain: Volume | None = None)"),
        (hk.Box, "(lower: tuple[float, float, float], upper: tuple[float, float, float])"),
    ],
)
def test_signatures_are_those_of_constructors(thing: type, shown: str) -> None:
    """Fields and volumes have a `__new__` that takes anything; what is private is not shown."""
    config = SimpleNamespace(autodoc_type_aliases={})
    arguments, _ = extension("docstrings").with_readable_defaults(
        SimpleNamespace(config=config), "class", "", thing, None, "(*given: Any)", None
    )
    assert arguments == shown


def test_names_of_ours_become_links() -> None:
    inline = extension("docstrings").inline
    assert inline("`harnack.Surface` and `x`s") == (
        "\\ :py:obj:`harnack.Surface <harnack.Surface>`\\  and \\ ``x``\\ s"
    )


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("Surface.replace", "harnack.Surface.replace"),
        ("HitTolerance", "harnack.tracer.HitTolerance"),
        ("harnack.tracer.HitTolerance", "harnack.tracer.HitTolerance"),
        ("harnack.geometry.Ball", "harnack.Ball"),
        ("enclosures.choose_enclosures", "harnack.proofs.choose_enclosures"),
        ("harnack.io.outline.text", "harnack.io.outline.text"),
        ("outline.text", "harnack.io.outline.text"),
        ("text", None),
        ("level", None),
        ("geometry", None),
        ("tolerance=1e-3", None),
    ],
)
def test_links_lead_to_where_names_are_documented(name: str, path: str | None) -> None:
    assert extension("docstrings").documented_path(name) == path
