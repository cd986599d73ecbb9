"""What `make dist` builds and how it judges it, without a network."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from tests.project.scripts import ROOT, load_script

dist = load_script("dist.py")
fresh_install = dist.fresh_install  # as `dist` has it, so that errors are of the same classes
WHEEL = "harnack-0.1.0-py3-none-any.whl"


@pytest.mark.slow
def test_packages_are_reproducible_and_complete(tmp_path: Path) -> None:
    """Of a copy without Git, dated by CITATION.cff: it has what is not committed yet, too."""
    dist.shutil.copytree(
        ROOT, tmp_path / "copy", ignore=dist.shutil.ignore_patterns(*dist.NO_SOURCES, "docs")
    )
    packages = dist.build_reproducibly(tmp_path / "copy", tmp_path / "work")
    sources = dist.sources_of(tmp_path / "work/first/src")
    assert {"harnack/py.typed", "harnack/__init__.pyi", "harnack_command.py"} <= sources
    assert {Path(name).suffix for name in sources} >= {".js", ".wgsl", ".css", ".pyi"}
    dist.check_wheel(packages.wheel, sources)
    dist.check_archive(packages.archive)
    with zipfile.ZipFile(packages.wheel) as wheel:
        dates = {member.date_time[:3] for member in wheel.infolist()}
        (metadata,) = (name for name in wheel.namelist() if name.endswith("/METADATA"))
        text = wheel.read(metadata).decode()
    assert dates == {(2026, 11, 28)}
    assert "\nLicense-Expression: MIT\n" in text
    assert "\nClassifier: License" not in text  # which indexes refuse beside the expression


def write_wheel(path: Path, *names: str) -> Path:
    with zipfile.ZipFile(path, "w") as wheel:
        for name in names:
            wheel.writestr(name, "text")
    return path


def test_strangers_in_a_wheel_are_named() -> None:
    expected = (
        *("harnack/py.typed", "harnack/live/panel.js", "harnack/examples/film.py"),
        *("harnack_command.py", "harnack-0.1.0.dist-info/METADATA", "harnack/tracer/__init__.pyi"),
    )
    strange = (
        *("tests/test_a.py", "harnack/picture.png", "harnack/__pycache__/a.py", "benchmarks/b.py"),
        *("other-1.0.dist-info/METADATA", "harnack_other.py", "figures/page.py"),
    )
    assert dist.strangers_in_wheel([*expected, *strange]) == list(strange)


def test_a_wheel_without_a_source_is_refused(tmp_path: Path) -> None:
    wheel = write_wheel(tmp_path / WHEEL, "harnack/a.py")
    dist.check_wheel(wheel, ["harnack/a.py"])
    with pytest.raises(dist.CheckError, match=r"lacks harnack/py\.typed"):
        dist.check_wheel(wheel, ["harnack/a.py", "harnack/py.typed"])


def test_a_wheel_that_is_too_large_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dist, "MAX_WHEEL_BYTES", 10)
    with pytest.raises(dist.CheckError, match="above 10"):
        dist.check_wheel(write_wheel(tmp_path / WHEEL, "harnack/a.py"), [])


def test_differences_of_packages_are_named(tmp_path: Path) -> None:
    first = write_wheel(tmp_path / WHEEL, "a.py", "b.py")
    other = tmp_path / "other"
    other.mkdir()
    second = write_wheel(other / WHEEL, "a.py", "c.py")
    dist.check_same(first, first, "both")
    with pytest.raises(dist.CheckError, match=r"both differ in b\.py, c\.py"):
        dist.check_same(first, second, "both")


def test_strangers_in_a_source_archive_are_named(tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("text", encoding="utf-8")
    archive = tmp_path / "harnack-0.1.0.tar.gz"
    with tarfile.open(archive, "w:gz") as opened:
        opened.add(file, "harnack-0.1.0/README.md")
        opened.add(file, "harnack-0.1.0/out/notes.txt")
    with pytest.raises(dist.CheckError, match="does not belong there: out"):
        dist.check_archive(archive)


def git(folder: Path, *arguments: str) -> None:
    names = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
    subprocess.run(["git", *names, *arguments], cwd=folder, check=True, capture_output=True)


def test_sources_are_what_git_tracks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "root"
    (root / "src").mkdir(parents=True)
    for name in ("src/a.py", "notes.txt"):
        (root / name).write_text("first", encoding="utf-8")
    git(root, "init", "--quiet")
    git(root, "add", "src")
    monkeypatch.setenv("GIT_COMMITTER_DATE", "2001-02-03T04:05:06Z")
    git(root, "commit", "--quiet", "--message=a")
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    assert dist.source_date(root).isoformat() == "2001-02-03T04:05:06+00:00"
    dist.copy_sources(root, tmp_path / "first")
    assert dist.sources_of(tmp_path / "first") == {"src/a.py"}
    assert not dist.has_changes(root)

    (root / "src/a.py").write_text("second", encoding="utf-8")
    dist.copy_sources(root, tmp_path / "second")
    assert (tmp_path / "second/src/a.py").read_text(encoding="utf-8") == "second"
    assert dist.has_changes(root)

    (root / "src/b.py").write_text("new", encoding="utf-8")
    with pytest.raises(dist.CheckError, match=r"in no commit.*src/b\.py"):
        dist.copy_sources(root, tmp_path / "third")


def test_dates_of_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    (tmp_path / "CITATION.cff").write_text("date-released: 2026-11-28\n", encoding="utf-8")
    assert dist.source_date(tmp_path).isoformat() == "2026-11-28T00:00:00+00:00"
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert dist.source_date(tmp_path).isoformat() == "1970-01-02T00:00:00+00:00"
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "today")
    with pytest.raises(ValueError, match="not 'today'"):
        dist.source_date(tmp_path)


def test_dist_is_replaced_as_a_whole(tmp_path: Path) -> None:
    folder = tmp_path / "dist"
    folder.mkdir()
    (folder / "old.whl").write_text("old", encoding="utf-8")
    archive = tmp_path / "harnack-0.1.0.tar.gz"
    archive.write_text("new", encoding="utf-8")
    wheel = write_wheel(tmp_path / WHEEL, "a.py")
    dist.replace_folder(folder, dist.Packages(wheel, archive))
    assert {path.name for path in folder.iterdir()} == {wheel.name, archive.name}
    assert not list(tmp_path.glob("*.partial"))


def test_code_of_the_readme_is_found() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    commands = {line.split()[1] for line in fresh_install.command_lines(text)}
    assert commands >= {"render", "animate", "view", "mesh", "repair", "check"}
    assert len(fresh_install.python_blocks(text)) >= 3
    assert {"film", "view"} <= {*fresh_install.named_extras(text)}
    with pytest.raises(fresh_install.TrialError, match="no command line"):
        fresh_install.command_lines("harnack draws")


def test_failures_in_an_environment_are_told(tmp_path: Path) -> None:
    programs = Path(sys.executable).parent
    environment = fresh_install.Environment(programs, tmp_path, dict(os.environ))
    assert environment.run("python", "-c", "print(6 * 7)") == "42\n"
    assert environment.run("python", "-c", "raise SystemExit(1)", exit_codes=(0, 1)) == ""
    with pytest.raises(fresh_install.TrialError, match=r"no such thing\n\nexit code 1: python"):
        environment.run("python", "-c", "raise SystemExit('no such thing')")


def test_a_missing_interpreter_is_told(tmp_path: Path) -> None:
    with pytest.raises(fresh_install.TrialError, match="no interpreter python9"):
        fresh_install.make_environment(tmp_path, "python9")
