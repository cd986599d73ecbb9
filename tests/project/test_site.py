"""What the documentation site is made of: every public name, every scene, docstrings as written."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import harnack as hk
from harnack.gallery import SCENES

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"

# Namespaces for users; modules among their names.
NAMESPACES = (
    "backend", "distance", "fields", "files", "geometry", "io", "kernels", "live", "math",
    "printing", "proofs", "rendering", "solids", "testing",
)  # fmt: skip
MODULES = {"outline", "example_curves", "example_meshes"}


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


def test_the_reference_has_every_public_name() -> None:
    assert set(hk.__all__) <= documented()
    # A name of several namespaces is documented in one of them.
    last_names = {name.rpartition(".")[2] for name in documented()}
    for namespace in NAMESPACES:
        module = getattr(hk, namespace)
        names = {name for name in module.__all__ if _home(module, name).startswith("harnack")}
        assert names - set(hk.__all__) - MODULES <= last_names, namespace


def _home(module: ModuleType, name: str) -> str:
    """The module that a class, function or constant is explained in, "" for names of types."""
    thing = getattr(module, name)
    if isinstance(thing, ModuleType):
        return thing.__name__
    return getattr(thing, "__module__", None) or ""


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


def test_names_of_ours_become_links() -> None:
    inline = extension("docstrings").inline
    assert inline("`harnack.Surface` and `x`s") == (
        "\\ :py:obj:`harnack.Surface <harnack.Surface>`\\  and \\ ``x``\\ s"
    )
