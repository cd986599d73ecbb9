"""What a newcomer types first: `harnack` alone, the demo, the example scripts, and mistakes."""

from __future__ import annotations

import ast
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from harnack.backend import LLVMNotFoundError
from harnack.cli import demo, main
from harnack.cli.arguments import parse, parsers
from harnack.cli.demo import DemoTiming
from harnack.cli.example_scripts import example_scripts
from harnack.cli.welcome import FIRST_LINES
from harnack.gallery import SCENES
from harnack.gallery.demo import DEMO_PICTURES

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "src")}


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Exit code, output and error output of a command."""
    try:
        code = main(arguments)
    except SystemExit as end:
        code = int(end.code or 0)
    said, complaint = capsys.readouterr()
    return code, said, complaint


# `harnack` alone, and its mistakes.


def test_the_command_alone_shows_six_lines_to_try(capsys: pytest.CaptureFixture[str]) -> None:
    code, said, complaint = run(capsys)
    assert (code, complaint) == (0, "")
    assert "\x1b" not in said  # no color where no terminal is
    assert len(FIRST_LINES) == 6
    assert len(said.splitlines()) < 24
    for name, _, line in FIRST_LINES:
        assert line in said
        assert parse(shlex.split(line)[1:]).command == name
    assert "harnack --help" in said


def test_the_command_alone_has_color_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert "\x1b[" in run(capsys)[1]


@pytest.mark.slow
def test_the_lines_to_try_work_one_after_the_other(tmp_path: Path) -> None:
    """The pictures of the demo are small and have few samples; all else is as it stands."""
    said: dict[str, str] = {}
    for name, _, line in FIRST_LINES:
        command = [sys.executable, "-m", "harnack.cli", *shlex.split(line)[1:]]
        small = ["--size", "48x36", "--spp", "4"] if name == "demo" else []
        done = subprocess.run(
            [*command, *small], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, (line, done.stderr)
        said[name] = done.stdout
    for file in ("trefoil.png", "trefoil.html", "gyroid.stl"):
        assert (tmp_path / file).stat().st_size > 10_000

    folder = tmp_path / "harnack-demo"
    for number, picture in enumerate(DEMO_PICTURES, start=1):
        assert f"{number}/6 {picture.scene}: " in said["demo"]
        image = np.array(mi.Bitmap(str(folder / f"{picture.scene}.png")))
        assert image.shape[:2] == (36, 48)
        assert image.std() > 10
    assert len(list(folder.iterdir())) == 6
    assert f"6 pictures in {folder}, after " in said["demo"]
    following = re.findall(r"^ +harnack (.+?)(?:  .*)?$", said["demo"], re.M)
    assert len(following) == 2
    for line in following:
        parse(shlex.split(line))


def test_help_is_a_command_as_well(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "help") == run(capsys, "--help")
    code, said, _ = run(capsys, "help", "check")
    assert (code, said) == run(capsys, "check", "--help")[:2]
    assert code == 0
    assert "--min-thickness" in said


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    said = run(capsys, "--help")[1]
    for name in parsers()[1]:
        assert re.search(rf"^ +{name} ", said, re.M)


@pytest.mark.parametrize(
    ("written", "complaint"),
    [
        ("rendr", "there is no command 'rendr'; did you mean \"render\"?"),
        ("exmples", "there is no command 'exmples'; did you mean \"examples\"?"),
        ("qqq", "there is no command 'qqq'; there are demo, examples, render, "),
        ("trefoil", "to draw it, write `harnack render` before it"),
        ("x^2 + y^2 = 1", "to draw it, write `harnack render` before it"),
        ("bunny.OBJ", "to draw it, write `harnack render` before it"),
        ("a\nb", r"there is no command 'a\nb'"),
    ],
)
def test_what_is_no_command_says_what_was_meant(
    capsys: pytest.CaptureFixture[str], written: str, complaint: str
) -> None:
    for arguments in ([written], ["help", written], [written, "--quiet"]):
        code, _, said = run(capsys, *arguments)
        assert code == 2
        assert complaint in said
        assert said.count("\n") == 1


def test_what_cannot_be_imported_is_one_line(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['mitsuba'] = None; sys.argv = ['harnack', 'demo']\n"
        "from harnack_command import main; sys.exit(main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=ENVIRONMENT, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert re.fullmatch(r"error: .*mitsuba.*\n", done.stderr)


# The demo.


def test_the_demo_draws_the_pictures_of_the_readme() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"\(docs/images/([\w-]+)\.png\)", readme))
    assert {picture.scene for picture in DEMO_PICTURES} == shown
    assert shown <= set(SCENES)


def test_the_demo_tells_how_far_it_is_and_keeps_what_is_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With Ctrl-C in the third picture. Nothing is drawn: what is tried is the command itself."""
    drawn: list[dict[str, Any]] = []

    def render(scene: Any, path: Path, **settings: Any) -> None:
        del scene
        if len(drawn) == 2:
            signal.raise_signal(signal.SIGINT)
        drawn.append(settings)
        path.write_text("a picture")

    monkeypatch.setattr("harnack.gallery.scene.Scene.render", render)
    code, said, complaint = run(capsys, "demo", "-o", str(tmp_path / "out"), "--spp", "3")
    assert code == 130
    assert complaint.startswith("stopped")
    assert [settings["spp"] for settings in drawn] == [3, 3]
    assert drawn[0]["size"] == (640, 480)
    assert drawn[0]["progress"] is True  # no terminal: pictures write lines if they take long
    names = [picture.scene for picture in DEMO_PICTURES]
    assert {path.stem for path in (tmp_path / "out").iterdir()} == set(names[:2])
    assert re.search(rf"^2/6 {names[1]}: .* \(0 s, about 0 s left\)$", said, re.M)
    assert f"3/6 {names[2]}: " in said
    assert "next:" not in said


@pytest.mark.slow
def test_ctrl_c_ends_the_demo_in_one_line(tmp_path: Path) -> None:
    command = ["demo", "-o", "out", "--size", "320x240"]
    code = (
        f"import sys; sys.argv = {['harnack', *command]!r}\n"
        "from harnack_command import main; sys.exit(main())"
    )
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", code], cwd=tmp_path, env=ENVIRONMENT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("3/6"):
            break
    process.send_signal(signal.SIGINT)
    _, complaint = process.communicate(timeout=60)
    assert process.returncode == 130
    assert re.search(r"^stopped\b.*\n\Z", complaint, re.M)
    assert "Traceback" not in complaint
    # Whole pictures alone: those before the third, and whatever was finished in the meantime.
    files = list((tmp_path / "out").iterdir())
    assert {picture.scene for picture in DEMO_PICTURES[:2]} <= {path.stem for path in files}
    assert len(files) < 6
    for path in files:
        assert np.array(mi.Bitmap(str(path))).shape[:2] == (240, 320)


def test_the_remaining_time_follows_from_the_pictures_that_are_done(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 100.0
    monkeypatch.setattr(demo.time, "monotonic", lambda: now)
    timing = DemoTiming((1.0, 3.0, 4.0))
    assert timing.text(timing.done(0, 0.0)) == "0 s"
    now = 110.0
    assert timing.done(1, 1 / 3) == pytest.approx(0.25)
    assert timing.text(timing.done(1, 1 / 3)) == "10 s, about 30 s left"
    assert timing.done(2, 1.0) == 1.0


def test_a_bar_of_the_demo_never_goes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    from harnack.progress import Progress

    monkeypatch.setenv("FORCE_COLOR", "1")  # as a terminal
    timing = DemoTiming([picture.seconds for picture in DEMO_PICTURES])
    seen: list[float] = []
    update = demo.Bar.update

    def record(bar: demo.Bar, *arguments: Any, **settings: Any) -> None:
        update(bar, *arguments, **settings)
        seen.append(bar.tasks[0].completed)

    monkeypatch.setattr(demo.Bar, "update", record)
    with demo._show_progress(timing, 3, quiet=False) as show:
        assert callable(show)
        for told in (Progress("building"), Progress("", 0.5), Progress("", 0.1), Progress("", 0.8)):
            show(told)
    expected = [timing.done(3, part) for part in (0.0, 0.5, 0.5, 0.8)]
    assert seen == pytest.approx(expected)


def test_the_demo_without_llvm_says_what_to_do_and_does_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: Any) -> None:
        raise LLVMNotFoundError("The CPU backend needs LLVM. Install it: `install llvm`")

    monkeypatch.setattr(demo, "choose_backend", none)
    code, said, complaint = run(capsys, "demo", "-o", str(tmp_path / "out"))
    assert (code, said) == (1, "")
    assert re.fullmatch(r"error: .*`install llvm` .*`harnack doctor`.*\n", complaint)
    assert list(tmp_path.iterdir()) == []


# Example scripts.


def test_examples_are_copied_once_and_never_over_something_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mine"
    code, said, _ = run(capsys, "examples", str(folder))
    assert code == 0
    originals = {path.name: path.read_bytes() for path in (ROOT / "examples").glob("*.py")}
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == originals
    for name in originals:
        assert re.search(rf"^{name} +\w.*", said, re.M)
    assert f"    python {folder / 'spanning_surface.py'} out\n" in said
    assert run(capsys, "examples", str(folder))[0] == 0  # the same files again

    (folder / "film.py").write_text("mine")
    (folder / "own_field.py").write_text("mine too")
    (folder / "point_cloud.py").unlink()
    code, said, complaint = run(capsys, "examples", str(folder))
    assert (code, said) == (1, "")
    assert "film.py, own_field.py; move them, or name another folder" in complaint
    assert (folder / "film.py").read_text() == "mine"
    assert not (folder / "point_cloud.py").exists()  # nothing was copied


def test_examples_are_listed_with_what_they_need(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, said, _ = run(capsys, "examples", "--list")
    assert code == 0
    assert re.search(r"^film.py +A film of all .* curve \(needs harnack\[film\]\)$", said, re.M)
    assert re.search(r"^printed_parts.py .* \(needs harnack\[outlines\]\)$", said, re.M)
    assert said.count("needs") == 6
    assert list(tmp_path.iterdir()) == []


def test_examples_need_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("old")
    assert "a file of that name is there" in run(capsys, "examples", str(tmp_path / "file"))[2]
    assert "the folder's name is empty" in run(capsys, "examples", "")[2]


def test_examples_have_a_title_and_no_files_of_the_repository() -> None:
    for script in example_scripts():
        assert len(script.title) > 20
        tree = ast.parse(script.content)
        modules = [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        assert not [name for name in modules if name and name.split(".")[0] in ("tests", "scripts")]
        assert b"__file__" not in script.content
        # harnack has Dr.Jit load its LLVM, so it comes before Dr.Jit and Mitsuba.
        text = script.content.decode()
        for later in re.findall(r"^import (?:drjit|mitsuba)\b", text, re.M):
            assert text.index("import harnack") < text.index(later)


def test_examples_that_are_missing_are_said_to_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = tmp_path / "src" / "harnack" / "cli" / "example_scripts.py"
    monkeypatch.setattr("harnack.cli.example_scripts.__file__", str(module))
    code, _, complaint = run(capsys, "examples", "--list")
    assert code == 1
    assert "install harnack again" in complaint
    # An installed wheel has them within the package.
    shutil.copytree(ROOT / "examples", tmp_path / "src" / "harnack" / "examples")
    assert run(capsys, "examples", "--list")[0] == 0
