"""Generated pages are up to date, and the guide has every name at the top."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

import harnack as hk

ROOT = Path(__file__).resolve().parents[2]


def generator() -> ModuleType:
    """The script that writes the pages."""
    path = ROOT / "scripts/reference.py"
    spec = importlib.util.spec_from_file_location("reference", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.skipif(
    sys.version_info < (3, 11), reason="Python 3.10 and its last NumPy name parameters otherwise"
)
def test_signatures_and_options_are_up_to_date() -> None:
    pages = generator().updated_pages()
    outdated = [
        str(path.relative_to(ROOT))
        for path, text in pages.items()
        if not path.exists() or path.read_text(encoding="utf-8") != text
    ]
    assert not outdated, "run python scripts/reference.py"


def test_writing_signatures_twice_changes_nothing() -> None:
    page = "# A\n\n.. autofunction:: harnack.trace\n\n.. autoclass:: harnack.Hits\n   :members:\n"
    with_signatures = generator().with_signatures
    first = with_signatures(page)
    assert "max_steps=2000" in first
    assert with_signatures(first) == first


def test_members_are_those_that_a_class_defines() -> None:
    """`Field` makes `evaluate` of `evaluator` in classes that define the latter alone."""
    members_of = generator().members_of
    assert "evaluate" in dict(members_of(hk.Field))
    assert "evaluator" in dict(members_of(hk.fields.Morph))
    assert "evaluate" in vars(hk.fields.Morph)
    assert "evaluate" not in dict(members_of(hk.fields.Morph))


def test_the_guide_has_every_name_at_the_top() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    generated = {"options.md", "benchmarks.md", "figures.md"}
    text = "\n".join(
        page.read_text(encoding="utf-8") for page in pages if page.name not in generated
    )
    assert [name for name in hk.__all__ if not re.search(rf"\bhk\.{name}\b", text)] == []
