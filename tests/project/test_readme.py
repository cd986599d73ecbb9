"""The Python code of the README and of the documentation runs as it stands."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def blocks_of(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


README = blocks_of(ROOT / "README.md")
# `tests/backend/test_frameworks.py` runs the code that needs PyTorch and JAX.
PAGES = sorted({*(ROOT / "docs").glob("*.md")} - {ROOT / "docs" / "frameworks.md"})
DOCS = [block for page in PAGES for block in blocks_of(page)]


def test_there_is_code() -> None:
    assert len(README) >= 3
    assert len(DOCS) >= 10


@pytest.mark.few(2)
@pytest.mark.parametrize("block", README, ids=lambda b: b.splitlines()[-1][:40])
def test_code_of_the_readme_runs(block: str, tmp_path: Path) -> None:
    run_code(block, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("block", DOCS, ids=lambda b: b.splitlines()[-1][:40])
def test_code_of_other_pages_runs(block: str, tmp_path: Path) -> None:
    run_code(block, tmp_path)


def run_code(block: str, tmp_path: Path) -> None:
    script = tmp_path / "example.py"
    script.write_text(block, encoding="utf-8")
    run = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    named = re.findall(r'"(\w+\.png)"', block)
    for name in named:
        assert (tmp_path / name).stat().st_size > 1000
