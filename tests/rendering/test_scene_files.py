"""Mitsuba scenes in .xml files: hostile files are refused early, and errors are told in words."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path

import pytest

import harnack as hk
from harnack.cli import main
from harnack.files.file_geometry import FileFormatError

SCENE = """<scene version="3.0.0">
<sensor type="perspective"><film type="hdrfilm">
<integer name="width" value="{size}"/><integer name="height" value="{size}"/></film>
<sampler type="independent"><integer name="sample_count" value="{spp}"/></sampler></sensor>
{body}</scene>"""
SPHERE = '<shape type="sphere"/>'


def scene(body: str = SPHERE, *, size: int = 8, spp: int = 1) -> str:
    return SCENE.format(body=body, size=size, spp=spp)


def harnack_shape(properties: str) -> str:
    return scene(f'<shape type="harnack">{properties}</shape>')


def render(path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """The exit code and what was complained of; in a second, whatever the file."""
    start = time.monotonic()
    code = main(["render", str(path), "-o", str(path.with_suffix(".png")), "--quiet"])
    assert time.monotonic() - start < 20.0  # most of it is Mitsuba's import and the first kernel
    return code, capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (None, "there is no such file"),
        (b"", "the file is empty"),
        (b" \n\t ", "the file is empty"),
        (b"hello\n", "this is no XML file: it does not begin with '<'"),
        (b"\0" * 3000, "this is no XML file"),
        (bytes(range(256)) * 40, "this is no XML file"),
        (b"<scene>\0</scene>", "binary data"),
    ],
)
def test_what_is_no_xml_is_refused(tmp_path, capsys, content, complaint) -> None:
    path = tmp_path / "a.xml"
    if content is not None:
        path.write_bytes(content)
    code, said = render(path, capsys)
    assert code == 1
    assert said == f"error: {path}: {said.split(f'{path}: ')[1]}"
    assert complaint in said
    assert said.count("\n") == 1


def test_what_is_no_ordinary_xml_file_is_refused(tmp_path, capsys) -> None:
    (tmp_path / "folder.xml").mkdir()
    os.mkfifo(tmp_path / "pipe.xml")
    (tmp_path / "circle.xml").symlink_to("circle.xml")
    with (tmp_path / "sparse.xml").open("wb") as file:
        file.truncate(3 << 30)
    for name, complaint in (
        ("folder", "this is a directory, not a file"),
        ("pipe", "this is not an ordinary file"),
        ("circle", "this is a link that leads to no file"),
        ("sparse", "3,221,225,472 bytes are too many"),
    ):
        code, said = render(tmp_path / f"{name}.xml", capsys)
        assert (code, said.count("\n")) == (1, 1)
        assert complaint in said


def test_files_that_a_scene_names_are_looked_at_too(tmp_path, capsys) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    with (tmp_path / "sparse.xml").open("wb") as file:
        file.truncate(3 << 30)
    (tmp_path / "inner.xml").write_text("<scene version='3.0.0'><include filename='sparse.xml'/>")
    (tmp_path / "circle.xml").write_text(
        '<scene version="3.0.0"><include filename="circle.xml"/></scene>'
    )
    bitmap = '<texture type="bitmap"><string name="filename" value="pipe.png"/></texture>'
    for name, text, complaint in (
        ("a", scene('<include filename="sparse.xml"/>'), "sparse.xml: 3,221,225,472 bytes are too"),
        ("b", scene('<include filename="inner.xml"/>'), "sparse.xml: 3,221,225,472 bytes are too"),
        ("c", scene(f'<bsdf type="diffuse">{bitmap}</bsdf>'), "pipe.png: this is not an ordinary"),
        ("d", scene('<include filename="circle.xml"/>'), "maximum include recursion depth"),
        ("e", scene('<include filename="nowhere.xml"/>'), '"nowhere.xml" not found'),
    ):
        path = tmp_path / f"{name}.xml"
        path.write_text(text)
        code, said = render(path, capsys)
        assert (code, said.count("\n")) == (1, 1)
        assert complaint in said
        assert len(said) < 1000


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "latin-1"])
def test_scenes_in_any_encoding_are_drawn(tmp_path, capsys, encoding) -> None:
    path = tmp_path / "a.xml"
    path.write_bytes(scene(f"<!-- caf\xe9 -->{SPHERE}").encode(encoding))
    assert render(path, capsys) == (0, "")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (scene().replace("</scene>", ""), "Start-end tags mismatch"),
        ("<html/>", "missing version attribute"),
        (scene('<shape type="spere"/>'), 'Plugin "spere" not found'),
        (harnack_shape('<string name="field" value="gyriod"/>'), 'did you mean "gyroid"?'),
        (harnack_shape('<string name="file" value="no.loops"/>'), "no.loops: there is no such"),
        (scene(size=1_000_000), "needs about 50,000 GB of memory"),
        (scene(spp=4_000_000_000), "spp must be at least 1 and at most 1000000, not 4000000000"),
        ('<scene version="3.0.0"/>', "no sensor to look through"),
    ],
)
def test_errors_of_mitsuba_are_one_line_without_a_traceback(
    tmp_path, capsys, text, complaint
) -> None:
    path = tmp_path / "a.xml"
    path.write_text(text)
    code, said = render(path, capsys)
    assert code == 1
    assert complaint in said
    assert re.fullmatch(r"error: [^\n]*\n", said)
    assert not re.search(r'Traceback|File "|\.cpp:', said)


def test_in_python_too_what_is_no_scene_file_is_said(tmp_path) -> None:
    for name, complaint in (
        ("bunny.obj", r"surface file, not a Mitsuba scene .*field_from_file\(path\)\.field"),
        ("trefoil", r"no such file; .*harnack\.gallery\.SCENES"),
        ("a.xml", "there is no such file"),
    ):
        with pytest.raises(FileFormatError, match=complaint):
            hk.render(str(tmp_path / name))
    with pytest.raises(RuntimeError, match=r'^At dictionary node "root"'):
        hk.render({"type": "scen"})
