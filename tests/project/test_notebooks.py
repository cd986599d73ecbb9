"""The notebooks of the documentation run, and show what they should."""

from __future__ import annotations

from pathlib import Path

import nbclient
import nbformat
import pytest

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))


def test_there_are_notebooks_without_outputs() -> None:
    assert len(NOTEBOOKS) >= 2
    for path in NOTEBOOKS:
        cells = nbformat.read(path, as_version=4).cells
        assert all(not cell.outputs for cell in cells if cell.cell_type == "code")


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_its_pictures(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The kernel of the site: this Python, whatever kernels the user has.
    monkeypatch.setenv("JUPYTER_PATH", str(ROOT / "scripts/site/jupyter"))
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    drawn = [cell for cell in code if "hk.render(" in cell.source]
    assert len(drawn) >= 2
    for cell in drawn:
        (result,) = [each for each in cell.outputs if each.output_type == "execute_result"]
        assert "image/png" in result.data
    written = [each for cell in code for each in cell.outputs if each.output_type == "stream"]
    lines = [line for each in written if each.name == "stderr" for line in each.text.splitlines()]
    assert all(line.startswith("rendering: ") for line in lines), lines  # slow machines tell this
