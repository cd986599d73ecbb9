"""Progress is a bar in a terminal and text elsewhere."""

from __future__ import annotations

import sys

import pytest
import rich.console

from harnack import progress


def finish_two_parts() -> None:
    with progress.progress_bar("rendering", progress=True) as advance:
        advance(0.25)
        advance(0.75)


def test_notebooks_get_text_without_ipywidgets(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rich.console, "_is_jupyter", lambda: True)
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    monkeypatch.setenv("FORCE_COLOR", "1")  # as kernels of notebooks do
    monkeypatch.setattr(progress, "_SECONDS_BETWEEN_LINES", 0.0)
    finish_two_parts()
    assert capsys.readouterr().err == "rendering: 25% after 0 s, about 0 s left\n"


def test_short_tasks_write_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    finish_two_parts()
    assert capsys.readouterr() == ("", "")


def test_terminals_get_a_bar(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    finish_two_parts()
    assert "\x1b[" in capsys.readouterr().err


def test_none_is_shown_where_none_is_wanted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(progress, "_SECONDS_BETWEEN_LINES", 0.0)
    with progress.progress_bar("rendering", progress=False) as advance:
        advance(0.5)
    assert capsys.readouterr() == ("", "")
