"""Outlines of text and of SVG files: areas that are known, what would be lost, hostile files."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk


def area(loops: Any) -> float:
    return sum(
        0.5 * float(np.sum(p[:, 0] * np.roll(p[:, 1], -1) - p[:, 1] * np.roll(p[:, 0], -1)))
        for p in loops
    )


def test_regular_polygons() -> None:
    (corners,) = hk.io.outline.regular_polygon(6, 2.0)
    assert np.linalg.norm(corners, axis=1) == pytest.approx(2.0)
    assert area([corners]) == pytest.approx(6 * math.sqrt(3))
    for sides in (2, 2.5, True, 10**7):
        with pytest.raises(ValueError, match="number of sides"):
            hk.io.outline.regular_polygon(sides, 1.0)  # type: ignore[arg-type]


# Text.


def test_letters_have_their_holes() -> None:
    pytest.importorskip("matplotlib")
    loops = hk.io.outline.text("harnack", 10.0)
    assert len(loops) == 9  # two letters a, with a hole each
    coarse, fine = (hk.io.outline.text("oO", 1.0, tolerance=one) for one in (1e-2, 1e-5))
    assert sum(map(len, fine)) > 8 * sum(map(len, coarse))
    assert area(coarse) == pytest.approx(area(fine), rel=0.05)
    assert area(hk.io.outline.text("o", 3.0)) == pytest.approx(
        9 * area(hk.io.outline.text("o", 1.0))
    )


def test_lines_of_text() -> None:
    pytest.importorskip("matplotlib")
    one, two = (
        hk.io.outline.text("ii", align="center"),
        hk.io.outline.text("i\n\nii", align="center"),
    )
    assert len(two) == len(one) + 2
    low, high = (np.concatenate(two).min(axis=0), np.concatenate(two).max(axis=0))
    assert low[0] == pytest.approx(-high[0])
    assert low[1] == pytest.approx(-2.4, abs=0.05)
    assert len(hk.io.outline.text("$x$")) == 7  # no formula


@pytest.mark.parametrize(
    ("words", "options", "complaint"),
    [
        ("", {}, "nothing to see"),
        (" \n\t", {}, "nothing to see"),
        ("a\u4e2d", {}, "has no letter"),
        ("a\x00", {}, "has no letter"),
        (3, {}, "must be a text"),
        ("a" * 20_000, {}, "at most 10,000"),
        ("a", {"font": "No Such Family"}, "no font of the family"),
        ("a", {"font": "missing.ttf"}, "no font file"),
        ("a", {"align": "middle"}, "align must be"),
        ("a", {"size": 0.0}, "size of text must be positive"),
        ("a", {"tolerance": math.nan}, "tolerance must be positive"),
        ("o", {"tolerance": 1e-300}, "larger tolerance"),
    ],
)
def test_what_is_no_text_is_said(words: Any, options: Any, complaint: str) -> None:
    pytest.importorskip("matplotlib")
    with pytest.raises(ValueError, match=complaint):
        hk.io.outline.text(words, **options)


# SVG.


def drawn(folder: Path, inside: str, **options: Any) -> Any:
    pytest.importorskip("svgpathtools")
    file = folder / "drawing.svg"
    file.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9">{inside}</svg>')
    return hk.io.outline.svg(file, **options)


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        ('<rect width="4" height="2"/>', 8.0),
        ('<rect width="4" height="2" rx="9"/>', 2 * math.pi),
        ('<circle r="2"/>', 4 * math.pi),
        ('<ellipse rx="2" ry="1" transform="rotate(30) skewX(40)"/>', 2 * math.pi),
        ('<polygon points="0,0 2,0 0,2"/>', 2.0),
        ('<polyline points="0 0 2 0 0 2"/>', 2.0),
        ('<path d="M0 0h3v3h-3z M1 1v1h1v-1z"/>', 8.0),
        ('<path d="M0 0h3v3h-3z M1 1h1v1h-1z"/>', 9.0),  # the same way around: no hole
        ('<path fill-rule="evenodd" d="M0 0h3v3h-3z M1 1h1v1h-1z"/>', 8.0),
        ('<g style="fill-rule: evenodd"><path d="M0 0h3v3h-3z M1 1h1v1h-1z"/></g>', 8.0),
        ('<g transform="translate(5 5) scale(2)"><rect width="1" height="1"/></g>', 4.0),
        ('<rect width="2" height="2"/><rect x="1" width="2" height="2"/>', 6.0),  # joined
        ('<g fill="none"><rect width="9" height="9"/></g><rect width="1" height="1"/>', 1.0),
        ('<g display="none"><rect width="9" height="9"/></g><rect width="1" height="1"/>', 1.0),
        ('<defs><rect width="9" height="9"/></defs><rect width="1" height="1"/>', 1.0),
        ('<style>.a{fill:#fff}</style><rect class="a" width="1" height="1"/>', 1.0),
        ('<path d="M0 0Q2 4 4 0z"/>', 16 / 3),
        ('<path d="M0 0C0 4 4 4 4 0z"/>', 9.6),
        ('<path d="M0 0A2 2 0 0 1 4 0z"/>', 2 * math.pi),
        ('<path d="M4 4h-4a4 4 0 114 4z"/>', 12 * math.pi),  # flags without a space between
        ('<path d="M0 0A0 5 0 0 1 4 0L4 4z"/>', 8.0),  # an arc of radius 0 is a line
        ('<rect width="9" height="9" style="fill-opacity:0.0"/><rect width="1" height="1"/>', 1.0),
        ('<rect width="9" height="9" fill="transparent"/><rect width="2px" height="1"/>', 2.0),
    ],
)
def test_areas_of_drawings(tmp_path: Path, inside: str, expected: float) -> None:
    loops = drawn(tmp_path, inside, tolerance=1e-5)
    assert area(loops) == pytest.approx(expected, rel=1e-4)
    assert area(drawn(tmp_path, inside, scale=10.0)) == pytest.approx(100 * expected, rel=5e-3)


def test_drawings_stand_upright(tmp_path: Path) -> None:
    """y of SVG points downwards."""
    (loop,) = drawn(tmp_path, '<polygon points="0,0 2,0 0,5"/>')
    assert loop.min(axis=0) == pytest.approx([0, -5])


@pytest.mark.parametrize(
    ("inside", "complaint"),
    [
        ("", "fills nothing"),
        ('<rect width="1" height="1" fill="none"/>', "fills nothing"),
        ('<path d="M0 0L1 1"/>', "strokes have no outline"),
        ('<use href="#a"/>', "<use> is not read"),
        ("<text>a</text>", "<text> is not read"),
        ('<rect width="1" height="1" clip-path="url(#a)"/>', "clip-path is not read"),
        ("<style>.a{fill:none}</style>", "style sheet"),
        ('<rect width="5mm" height="1"/>', "5mm.* has a unit"),
        ('<circle cx="50%" r="1"/>', "50%.* has a unit"),
        ('<svg x="10"><rect width="1" height="1"/></svg>', "place of its own"),
        ('<svg viewBox="0 0 2 2"><rect width="1" height="1"/></svg>', "place of its own"),
        ('<rect style="transform:rotate(9deg)" width="1" height="1"/>', "transforms in styles"),
        ('<path d="M0 0A5 5 0 0 1 0 0L9 0L9 9z"/>', "ends where it begins"),
        ('<rect width="-5" height="1"/>', "negative"),
        ('<circle r="1e300"/><circle r="1"/>', "not finite|too large|too many|overflow|finite"),
        ('<path d="M0 0L1 q"/>', "is none"),
        ('<path d="M0 0L1e999 0L1 1z"/>', "finite"),
        ('<rect width="1" height="1" transform="foo(1)"/>', "foo"),
        ("<g>" * 300 + "</g>" * 300, "within each other"),
        ("<rect", "not well-formed|unclosed"),
    ],
)
def test_what_would_be_lost_is_refused(tmp_path: Path, inside: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        drawn(tmp_path, inside)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_entities_are_refused(tmp_path: Path, encoding: str) -> None:
    """Ten of them, each ten times the one before, would be ten gigabytes."""
    pytest.importorskip("svgpathtools")
    names = "abcdefghij"
    bomb = "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in itertools.pairwise(names))
    text = f'<!DOCTYPE svg [<!ENTITY a "0">{bomb}]><svg><path d="&j;"/></svg>'
    file = tmp_path / "bomb.svg"
    file.write_bytes(f'<?xml version="1.0" encoding="{encoding}"?>{text}'.encode(encoding))
    with pytest.raises(ValueError, match="entities are not read"):
        hk.io.outline.svg(file)
    file.write_bytes(b" " * (33 * 2**20))
    with pytest.raises(ValueError, match="at most 32 MB"):
        hk.io.outline.svg(file)
