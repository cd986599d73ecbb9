"""The date of the sources: that of the commit, by which packages and the site are dated.

Standard library only.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from datetime import datetime, timezone
from pathlib import Path


def source_date(root: Path) -> datetime:
    """Return the date of the sources in `root`, in UTC.

    It is the first of these that there is: the environment variable SOURCE_DATE_EPOCH (seconds
    since 1970, the convention of https://reproducible-builds.org), the date of the last commit of
    the Git repository whose root is `root`, and the release date in CITATION.cff.

    Raises:
        ValueError: SOURCE_DATE_EPOCH is no whole number, or CITATION.cff has no release date.
    """
    stated = os.environ.get("SOURCE_DATE_EPOCH")
    if stated is not None:
        if not stated.isdecimal():
            raise ValueError(f"SOURCE_DATE_EPOCH is a whole number of seconds, not {stated!r}")
        return datetime.fromtimestamp(int(stated), timezone.utc)
    if is_repository(root):
        return datetime.fromtimestamp(int(git(root, "log", "-1", "--format=%ct")), timezone.utc)
    text = (root / "CITATION.cff").read_text(encoding="utf-8")
    released = re.search(r"^date-released: (\d{4}-\d\d-\d\d)$", text, re.MULTILINE)
    if released is None:
        raise ValueError(f"{root / 'CITATION.cff'} has no line `date-released: YEAR-MONTH-DAY`")
    return datetime.strptime(released[1], "%Y-%m-%d").replace(tzinfo=timezone.utc)


def is_repository(root: Path) -> bool:
    """Return whether `root` is the root of a checkout of Git, and Git is installed."""
    # A worktree has a file of this name.
    return (root / ".git").exists() and shutil.which("git") is not None


def git(root: Path, *arguments: str) -> str:
    """Run a command of Git in `root` and return what it prints.

    Raises:
        RuntimeError: the command failed. The message has its words.
    """
    done = subprocess.run(
        ["git", *arguments], cwd=root, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"git {' '.join(arguments)} failed in {root}: {done.stderr.strip()}")
    return done.stdout
