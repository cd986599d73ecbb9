"""The site says of which version it is, and lists the others."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tests.project.scripts import ROOT, load_script

versions = load_script("site/versions.py")


def write_home(folder: Path, version: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    text = f'<p class="edition">harnack {version}, 2027-01-02. <a href="versions.html">All</a></p>'
    (folder / "index.html").write_text(text, encoding="utf-8")


def test_versions_are_listed_from_the_newest_on(tmp_path: Path) -> None:
    write_home(tmp_path, "0.11.0.dev0")
    for version in ("0.9.0", "0.10.0", "0.2.0"):
        write_home(tmp_path / f"v{version}", version)
    (tmp_path / "video").mkdir()
    versions.write_list(tmp_path)
    text = (tmp_path / "versions.html").read_text(encoding="utf-8")
    assert re.findall(r'<a href="(.+)">harnack (.+), 2027-01-02</a>', text) == [
        ("index.html", "0.11.0.dev0"),
        ("v0.10.0/index.html", "0.10.0"),
        ("v0.9.0/index.html", "0.9.0"),
        ("v0.2.0/index.html", "0.2.0"),
    ]


def test_a_page_without_a_version_is_refused(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("<p>harnack</p>", encoding="utf-8")
    with pytest.raises(ValueError, match="does not say its version"):
        versions.write_list(tmp_path)


def test_the_end_of_pages_is_what_the_list_reads() -> None:
    template = (ROOT / "scripts/site/templates/page.html").read_text(encoding="utf-8")
    page = template.replace("{{ version }}", "1.2.3").replace("{{ source_date }}", "2027-01-02")
    edition = versions.EDITION.search(page)
    assert edition is not None
    assert edition[1] == "harnack 1.2.3, 2027-01-02"


def test_tags_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    root = tmp_path / "root"
    (root / "src/harnack").mkdir(parents=True)
    (root / "src/harnack/_version.py").write_text('__version__ = "1.2.3"\n', encoding="utf-8")
    with pytest.raises(RuntimeError, match="no checkout of Git"):
        versions.build_tag(root, "v1.2.3", tmp_path / "site")
    for command in (
        ("init", "--quiet"),
        ("add", "."),
        ("-c", "user.name=a", "-c", "user.email=a@example.org", "commit", "--quiet", "-m", "a"),
        ("tag", "v1.2.4"),
    ):
        subprocess.run(["git", *command], cwd=root, check=True)
    with pytest.raises(ValueError, match=r"no tag 'v1\.2\.3', only v1\.2\.4"):
        versions.build_tag(root, "v1.2.3", tmp_path / "site")
    with pytest.raises(ValueError, match=r"tag v1\.2\.4 have version 1\.2\.3"):
        versions.build_tag(root, "v1.2.4", tmp_path / "site")
    assert not (tmp_path / "site").exists()
