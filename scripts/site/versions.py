"""Build the documentation of a tag, and list the versions that the site has.

    python scripts/site/versions.py [TAG]

With a tag such as v0.1.0, the pages are built from that tag's own sources, in a temporary folder,
into `site/v0.1.0`. In either case `site/versions.html` then lists what the site has: the pages in
`site`, which `make site` builds of the sources as they are, and those of tags below it. It is plain
HTML, and every page has a link to it.
"""

from __future__ import annotations

import html
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from packaging.version import InvalidVersion, Version

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

from commit_date import git, is_repository  # noqa: E402

# What the template `templates/page.html` writes at the end of every page.
EDITION = re.compile(r'<p class="edition">(harnack [^<]*?)\.? <')
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>Versions of harnack</title>
<style>
body {{ font-family: sans-serif; margin: 3rem auto; max-width: 40rem; padding: 0 1rem }}
</style>
</head>
<body>
<h1>Versions of harnack</h1>
<ul>
{entries}
</ul>
</body>
</html>
"""


def main() -> None:
    try:
        if len(sys.argv) > 1:
            build_tag(ROOT, sys.argv[1], ROOT / "site")
        write_list(ROOT / "site")
    except (RuntimeError, ValueError) as error:
        sys.exit(f"site: {error}")


def build_tag(root: Path, tag: str, site: Path) -> None:
    """Build the pages of a tag of the repository `root` into the folder `site`/`tag`.

    Raises:
        ValueError: there is no such tag, or it is not named after the version of its sources.
        RuntimeError: `root` is no checkout of Git, or the pages cannot be built.
    """
    if not is_repository(root):
        raise RuntimeError(f"{root} is no checkout of Git, so that it has no tags")
    tags = git(root, "tag", "--list").split()
    if tag not in tags:
        raise ValueError(f"there is no tag {tag!r}, only {', '.join(tags) or 'none at all'}")
    with tempfile.TemporaryDirectory(prefix="harnack-site-") as text:
        folder = Path(text)
        git(root, "archive", f"--output={folder / 'sources.tar'}", tag)
        with tarfile.open(folder / "sources.tar") as archive:
            # Python has filters from 3.11.4 and 3.10.12 on; the files are our own.
            archive.extraction_filter = getattr(tarfile, "data_filter", lambda member, path: member)
            archive.extractall(folder / "sources")
        check_version(folder / "sources", tag)
        environment = {
            **os.environ,
            "PYTHONPATH": str(folder / "sources" / "src"),
            "SOURCE_DATE_EPOCH": git(root, "log", "-1", "--format=%ct", tag).strip(),
        }
        command = [
            *(sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet"),
            *("-c", "scripts/site", "-A", "version_list=../versions.html"),
            *("-d", str(folder / "doctrees"), ".", str(folder / "pages")),
        ]
        if subprocess.run(command, cwd=folder / "sources", env=environment, check=False).returncode:
            raise RuntimeError(f"the pages of {tag} cannot be built; the lines above say why")
        replace_folder(site / tag, folder / "pages")


def check_version(sources: Path, tag: str) -> None:
    """Check that a tag is named after the version of its sources.

    Raises:
        ValueError: it is not.
    """
    text = (sources / "src" / "harnack" / "_version.py").read_text(encoding="utf-8")
    version = re.search(r'__version__ = "(.+)"', text)
    if version is None or tag != f"v{version[1]}":
        found = "no version" if version is None else f"version {version[1]}"
        raise ValueError(f"the sources of tag {tag} have {found}")


def replace_folder(target: Path, pages: Path) -> None:
    """Put the folder `pages` in the place of `target`."""
    partial = target.with_name(f"{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.parent.mkdir(parents=True, exist_ok=True)
    shutil.copytree(pages, partial)
    shutil.rmtree(target, ignore_errors=True)
    partial.rename(target)


def write_list(site: Path) -> None:
    """Write `versions.html` into the folder of the site: the pages in it and in its folders that
    are named after tags, with the newest version first.

    Raises:
        ValueError: a page does not say its version.
    """
    folders = {path: version_of(path.name) for path in site.glob("v*/") if version_of(path.name)}
    newest_first = sorted(folders, key=lambda path: folders[path] or Version("0"), reverse=True)
    entries: list[str] = []
    if (site / "index.html").exists():
        entries.append(entry(site, "index.html", "the sources from which this site was built"))
    entries += [entry(site, f"{path.name}/index.html", "a release") for path in newest_first]
    partial = site / "versions.html.partial"
    partial.write_text(_PAGE.format(entries="\n".join(entries)), encoding="utf-8")
    partial.replace(site / "versions.html")


def version_of(name: str) -> Version | None:
    """Return the version that a folder's name such as "v0.1.0" stands for; None for others."""
    try:
        return Version(name.removeprefix("v")) if name.startswith("v") else None
    except InvalidVersion:
        return None


def entry(site: Path, page: str, what: str) -> str:
    """Return the line of the list for the pages whose home is `page`, a path within `site`.

    Raises:
        ValueError: the page does not say its version.
    """
    text = (site / page).read_text(encoding="utf-8")
    edition = EDITION.search(text)
    if edition is None:
        raise ValueError(f"{site / page} does not say its version at its end; build it again")
    return f'<li><a href="{html.escape(page)}">{edition[1]}</a>: {what}</li>'


if __name__ == "__main__":
    main()
