"""Progress is a bar in a terminal and text elsewhere."""

from __future__ import annotations

import sys

import pytest
import rich.console

import harnack as hk
from harnack import progress


def finish_two_parts() -> None:
    with progress.show_progress("rendering", progress=True) as reporter:
        reporter.advance(0.25)
        reporter.advance(0.75)


def test_notebooks_get_text_without_ipywidgets(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rich.console, "_is_jupyter", lambda: True)
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    monkeypatch.setenv("FORCE_COLOR", "1")  # as kernels of notebooks do
    monkeypatch.setattr(progress, "_SECONDS_BETWEEN_LINES", 0.0)
    finish_two_parts()
    assert capsys.readouterr().err == "rendering: 25% after 0 s, about 0 s left\n"


def test_no_time_is_estimated_from_the_first_few_percent(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A task that compiles first was said to take several times as long as it did."""
    monkeypatch.setattr(progress, "_SECONDS_BETWEEN_LINES", 0.0)
    with progress.show_progress("page", progress=True) as reporter:
        reporter.advance(0.05)
        reporter.advance(0.15)
    told = ["page: 5% after 0 s", "page: 20% after 0 s, about 0 s left"]
    assert capsys.readouterr().err.splitlines() == told


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
    with progress.show_progress("rendering", progress=False) as reporter:
        reporter.advance(0.5)
    assert capsys.readouterr() == ("", "")


def test_a_function_gets_texts_and_what_is_done() -> None:
    told: list[hk.Progress] = []
    with progress.show_progress("rendering", told.append) as reporter:
        reporter.advance(0.25)
        reporter.tell("cells")
        reporter.advance(0.75)
    assert told == ["rendering: 25%", "cells", "rendering: 100%"]
    assert [one.done for one in told] == [0.25, None, 1.0]


def test_texts_are_printed_in_log_files(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "_SECONDS_BETWEEN_LINES", 0.0)
    hk.mesh(hk.Sphere(1.0), cell_size=0.5, tolerance=0.1, progress=True)
    assert "mesh: " in capsys.readouterr().err
