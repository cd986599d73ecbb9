"""Check that a tag is ready to be released, and write its section of the changelog to a file.

    python scripts/release_notes.py v0.1.0 notes.md

Standard library only. The workflow for releases runs it on the tag that was pushed.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    if len(sys.argv) != 3:
        sys.exit("usage: release_notes.py TAG FILE")
    try:
        notes = release_notes(ROOT, sys.argv[1])
    except ValueError as error:
        sys.exit(f"release: {error}")
    Path(sys.argv[2]).write_text(notes, encoding="utf-8")


def release_notes(root: Path, tag: str) -> str:
    """Return the section of the changelog of the version that `tag` names, without its title.

    Raises:
        ValueError: the tag is not named after the version of the sources in `root`, or that is one
            of development, or CITATION.cff or the changelog do not have it, with the same date.
    """
    version = only_match(root / "src/harnack/_version.py", r'^__version__ = "(.+)"$')
    if tag != f"v{version}":
        raise ValueError(f"the tag is {tag}, and the sources have version {version}")
    if re.fullmatch(r"\d+\.\d+\.\d+", version) is None:
        raise ValueError(f"{version} is no version to release, as 0.1.0 is")
    cited = only_match(root / "CITATION.cff", r"^version: (\S+)$")
    if cited != version:
        raise ValueError(f"CITATION.cff has version {cited}, and the sources have {version}")
    section = section_of(root / "CHANGELOG.md", version)
    date = only_match(root / "CITATION.cff", r"^date-released: (\S+)$")
    if date != section[0]:
        raise ValueError(f"CITATION.cff has the date {date}, and CHANGELOG.md has {section[0]}")
    return section[1]


def section_of(changelog: Path, version: str) -> tuple[str, str]:
    """Return the date and the text of the section of a version.

    Raises:
        ValueError: there is no such section, or no text in it.
    """
    text = changelog.read_text(encoding="utf-8")
    pattern = rf"^## \[{re.escape(version)}\] - (\d{{4}}-\d\d-\d\d)\n(.*?)(?=^## |\Z)"
    section = re.search(pattern, text, re.MULTILINE | re.DOTALL)
    if section is None or not section[2].strip():
        raise ValueError(f"{changelog.name} has no text below `## [{version}] - YEAR-MONTH-DAY`")
    return section[1], section[2].strip() + "\n"


def only_match(path: Path, pattern: str) -> str:
    """Return what the group of `pattern` matches in a file.

    Raises:
        ValueError: the pattern matches no line, or several.
    """
    found = re.findall(pattern, path.read_text(encoding="utf-8"), re.MULTILINE)
    if len(found) != 1:
        raise ValueError(f"{path} has {len(found)} lines like {pattern}, and needs one")
    return found[0]


if __name__ == "__main__":
    main()
