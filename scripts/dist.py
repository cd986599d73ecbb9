"""Build the wheel and the source archive into dist/, and check both; `make dist` runs it.

    python scripts/dist.py [--fast] [--python PYTHON]

The packages are built from the files that Git tracks, as they are in the folder, twice and in two
places: the bytes have to be the same. So have those of the wheel that is built from the source
archive. Then Twine checks what package indexes want, this script checks what the packages contain,
and each is installed into a fresh environment, where the README's code runs
(`fresh_install.py`). Only when all has passed do the packages replace those in dist/.

Needs the packages of the extra `dist`, and Git or a copy of the repository without it.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

sys.path.insert(0, str(Path(__file__).resolve().parent))

import fresh_install
from commit_date import git, is_repository, source_date

ROOT = Path(__file__).resolve().parents[1]
MAX_WHEEL_BYTES = 3_000_000
MAX_ARCHIVE_BYTES = 4_000_000
PACKAGED = ("src", "tests", "examples")  # folders whose files go into packages
RESOURCES = frozenset({".py", ".pyi", ".typed", ".js", ".css", ".wgsl"})
ARCHIVED = frozenset(
    {
        *(".gitignore", "CHANGELOG.md", "CITATION.cff", "LICENSE", "PKG-INFO", "README.md"),
        *("examples", "pyproject.toml", "src", "tests"),
    }
)
# What a folder may hold that is no source, where there is no Git to ask.
NO_SOURCES = (
    *(".venv", ".git", "out", "site", "dist", "build", "jupyter_execute", "__pycache__"),
    *(".hypothesis", ".pytest_cache", ".ruff_cache", "*.partial", "*.egg-info"),
)


class CheckError(Exception):
    """A package is not as it has to be, or cannot be built. The message says what is wrong."""


@dataclass(frozen=True)
class Packages:
    """The paths of the wheel and of the source archive of one version."""

    wheel: Path
    archive: Path


def main() -> None:
    parser = argparse.ArgumentParser(description="Build and check the packages of harnack.")
    parser.add_argument(
        "--fast", action="store_true", help="do not install the packages into fresh environments"
    )
    parser.add_argument(
        "--python", default=sys.executable, help="the Python of fresh environments (this one)"
    )
    arguments = parser.parse_args()
    try:
        make_packages(ROOT, ROOT / "dist", None if arguments.fast else arguments.python)
    except (CheckError, fresh_install.TrialError, RuntimeError, ValueError) as error:
        sys.exit(f"dist: {error}")


def make_packages(root: Path, folder: Path, python: str | None) -> None:
    """Build and check the packages of the repository in `root`, and put them into `folder`.

    python: the interpreter of the fresh environments; None leaves these out.

    Raises:
        CheckError: something is wrong. `folder` is as it was.
        RuntimeError: Git failed.
        ValueError: the sources have no date.
        fresh_install.TrialError: a package does not work in a fresh environment.
    """
    if has_changes(root):
        report("some files differ from the last commit: not packages to publish")
    with tempfile.TemporaryDirectory(prefix="harnack-dist-") as text:
        work = Path(text)
        packages = build_reproducibly(root, work)
        run(
            [sys.executable, "-m", "twine", "check", "--strict", *map(str, vars(packages).values())]
        )
        report("Twine has no complaints")
        check_wheel(packages.wheel, sources_of(work / "first" / "src"))
        check_archive(packages.archive)
        if python is not None:
            for package in (packages.wheel, packages.archive):
                report(f"trying {package.name} in a fresh environment")
                fresh_install.try_package(package, python, root / "README.md")
        replace_folder(folder, packages)
    for path in sorted(folder.iterdir()):
        report(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


def report(text: str) -> None:
    """Print what has been done."""
    print(f"dist: {text}", flush=True)


def build_reproducibly(root: Path, work: Path) -> Packages:
    """Build the packages of `root` below the folder `work`, in several places, and compare them.

    Raises:
        CheckError: a build failed, or two builds differ.
    """
    epoch = str(int(source_date(root).timestamp()))
    builds: list[Packages] = []
    for name in ("first", "second"):
        copy_sources(root, work / name)
        builds.append(build(work / name, work / f"{name}-packages", epoch))
    first, second = builds
    check_same(first.wheel, second.wheel, "two builds of the wheel")
    check_same(first.archive, second.archive, "two builds of the source archive")
    unpacked = work / "unpacked"
    with tarfile.open(first.archive) as archive:
        archive.extractall(unpacked, filter="data")
    (source,) = unpacked.iterdir()
    run_build("--wheel", source, work / "from-archive", epoch)
    (wheel,) = (work / "from-archive").glob("*.whl")
    check_same(first.wheel, wheel, "wheels of the repository and of the source archive")
    report(f"built three times with the same bytes, dated {source_date(root):%Y-%m-%d %H:%M} UTC")
    return first


def copy_sources(root: Path, target: Path) -> None:
    """Copy the sources in `root` to a new folder `target`: the files that Git tracks or, where
    there is no Git, all but what `NO_SOURCES` names.

    Raises:
        CheckError: files are neither tracked nor ignored, so that they would be missed.
    """
    if not is_repository(root):
        shutil.copytree(root, target, ignore=shutil.ignore_patterns(*NO_SOURCES))
        return
    others = git(root, "ls-files", "--others", "--exclude-standard", "--", *PACKAGED).splitlines()
    if others:
        raise CheckError(
            "these files are in no commit, so packages would lack them: "
            f"{', '.join(others)}; `git add` them, or take them away"
        )
    for name in git(root, "ls-files", "-z", "--cached").split("\0"):
        source = root / name
        if name and source.is_file():  # and was not deleted
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target / name)


def has_changes(root: Path) -> bool:
    """Return whether tracked files in `root` differ from the last commit. Without Git: False."""
    if not is_repository(root):
        return False
    return git(root, "status", "--porcelain", "--untracked-files=no") != ""


def build(source: Path, folder: Path, epoch: str) -> Packages:
    """Build the source archive and the wheel of the sources in `source` into `folder`, with
    files dated `epoch` (seconds since 1970).

    Raises:
        CheckError: the build failed.
    """
    run_build("--sdist", source, folder, epoch)
    run_build("--wheel", source, folder, epoch)
    (wheel,), (archive,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return Packages(wheel, archive)


def run_build(kind: str, source: Path, folder: Path, epoch: str) -> None:
    """Build one package, of the kind "--sdist" or "--wheel", with the installed hatchling."""
    command = [sys.executable, "-m", "build", "--no-isolation", kind]
    run([*command, "--outdir", str(folder), str(source)], SOURCE_DATE_EPOCH=epoch)


def run(command: list[str], **environment: str) -> None:
    """Run a command, and keep to itself what it prints.

    Raises:
        CheckError: the command failed. The message has what it printed.
    """
    done = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        env={**os.environ, **environment},
    )
    if done.returncode:
        hint = "; `make dist` installs what it needs" if "No module named" in done.stdout else ""
        raise CheckError(f"{done.stdout}\nthis failed: {' '.join(command)}{hint}")


def check_same(first: Path, second: Path, what: str) -> None:
    """Check that two files have the same name and the same bytes.

    what: what both are, in words.

    Raises:
        CheckError: they differ. The message names the members that do.
    """
    if first.name != second.name:
        raise CheckError(f"{what} have different names: {first.name} and {second.name}")
    if first.read_bytes() == second.read_bytes():
        return
    contents = [members_of(path) for path in (first, second)]
    names = sorted({*contents[0], *contents[1]})
    different = [name for name in names if contents[0].get(name) != contents[1].get(name)]
    raise CheckError(f"{what} differ in {', '.join(different) or 'dates, order or modes'}")


def members_of(package: Path) -> Mapping[str, bytes]:
    """Return the contents of the files in a wheel or in a source archive, by name."""
    if package.suffix == ".whl":
        with zipfile.ZipFile(package) as wheel:
            return {name: wheel.read(name) for name in wheel.namelist()}
    contents: dict[str, bytes] = {}
    with tarfile.open(package) as archive:
        for member in archive:
            data = archive.extractfile(member)
            if data is not None:
                contents[member.name] = data.read()
    return contents


def sources_of(folder: Path) -> frozenset[str]:
    """Return the names of all files in `folder`, relative to it."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return frozenset(path.relative_to(folder).as_posix() for path in files)


def check_wheel(wheel: Path, sources: Collection[str]) -> None:
    """Check what a wheel contains, and its size.

    sources: the files that it has to have, such as "harnack/py.typed".

    Raises:
        CheckError: it lacks some, has others, or is too large.
    """
    if wheel.stat().st_size > MAX_WHEEL_BYTES:
        raise CheckError(f"{wheel.name} has {wheel.stat().st_size} bytes, above {MAX_WHEEL_BYTES}")
    names = members_of(wheel)
    missing = sorted({*sources} - {*names})
    if missing:
        raise CheckError(f"{wheel.name} lacks {', '.join(missing)}")
    strange = strangers_in_wheel(names)
    if strange:
        raise CheckError(f"{wheel.name} has what does not belong there: {', '.join(strange)}")
    report(f"{wheel.name} has {len(names)} files, all of src/ and nothing else")


def strangers_in_wheel(names: Iterable[str]) -> list[str]:
    """Return those names of files that do not belong into the wheel: all but the package, the
    module of the command, the examples and what describes the wheel; caches and pictures."""
    strange: list[str] = []
    for name in names:
        path = PurePosixPath(name)
        described = re.fullmatch(r"harnack-[\w.+!]+\.dist-info", path.parts[0]) is not None
        packaged = path.parts[0] == "harnack" and path.suffix in RESOURCES
        cached = "__pycache__" in path.parts
        if cached or not (described or packaged or name == "harnack_command.py"):
            strange.append(name)
    return strange


def check_archive(archive: Path) -> None:
    """Check what a source archive contains, and its size.

    Raises:
        CheckError: it has folders or files that do not belong there, or is too large.
    """
    if archive.stat().st_size > MAX_ARCHIVE_BYTES:
        size = archive.stat().st_size
        raise CheckError(f"{archive.name} has {size} bytes, above {MAX_ARCHIVE_BYTES}")
    names = members_of(archive)
    tops = {PurePosixPath(name).parts[1] for name in names}
    if tops - ARCHIVED:
        strange = ", ".join(sorted(tops - ARCHIVED))
        raise CheckError(f"{archive.name} has what does not belong there: {strange}")
    cached = [name for name in names if "__pycache__" in name]
    if cached:
        raise CheckError(f"{archive.name} has compiled files: {', '.join(cached[:5])}")
    report(f"{archive.name} has {len(names)} files")


def replace_folder(folder: Path, packages: Packages) -> None:
    """Put the packages into `folder`, in place of all that is there."""
    new, old = folder.with_suffix(".new.partial"), folder.with_suffix(".old.partial")
    for leftover in (new, old):
        shutil.rmtree(leftover, ignore_errors=True)
    new.mkdir()
    for package in (packages.wheel, packages.archive):
        shutil.copy(package, new)
    if folder.exists():
        folder.rename(old)
    new.rename(folder)
    shutil.rmtree(old, ignore_errors=True)


if __name__ == "__main__":
    main()
