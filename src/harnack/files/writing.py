"""Writing files so that none is ever left half done."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import tempfile
from collections.abc import Generator
from pathlib import Path

from harnack.files.file_format import Place

__all__ = ["check_writable", "write_atomically"]


@contextlib.contextmanager
def write_atomically(path: str | os.PathLike[str]) -> Generator[Path, None, None]:
    """A name to write to, in the folder of `path`, that becomes `path` when the block ends.

    If the block raises, nothing is left and an existing file stays as it was. The name has the
    extension of `path`, from which many writers tell the format.

    Raises:
        FileNotFoundError: the folder does not exist, or the block wrote no file.
        IsADirectoryError: `path` is a directory.
        OSError: `path` is a device or a pipe; or the system refuses to write, as where the disk
            is full. The message names the file, why, and what to do.
    """
    target = _writable_target(path)
    partial = _partial_name(target)
    try:
        yield partial
        os.replace(partial, target)
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(partial)):
            raise  # about something else than this file
        raise _write_error(path, error) from error
    finally:
        try:
            _remove(partial)
        except KeyboardInterrupt:
            _remove(partial)
            raise


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise what `write_atomically` would raise at once, and try to create a file there."""
    target = _writable_target(path)
    try:
        # Where the system can, this file has no name that an interrupt could leave behind.
        tempfile.TemporaryFile(dir=target.parent).close()
    except OSError as error:
        raise _write_error(path, error) from error


def _writable_target(path: str | os.PathLike[str]) -> Path:
    """The file that `path` names, links followed."""
    cannot = f"cannot write {_name(path)}"
    try:
        target = Path(os.path.realpath(path))
        if not target.parent.is_dir():
            raise FileNotFoundError(f"{cannot}: create the folder {_name(target.parent)} first")
        if target.is_dir():
            raise IsADirectoryError(f"{cannot}: it is a directory, name a file in it")
        if target.exists() and not target.is_file():
            raise OSError(f"{cannot}: it is a device or a pipe, name an ordinary file")
    except ValueError as error:  # a NUL character in the name
        raise ValueError(f"{str(path)!r} is no name of a file: {error}") from None
    except OSError as error:
        if error.errno is None:
            raise
        raise _write_error(path, error) from error
    return target


def _remove(partial: Path) -> None:
    if os.path.lexists(partial):
        partial.unlink()


def _partial_name(target: Path) -> Path:
    # As long as the target's name if that is long, so that it is allowed where the target's is.
    token = f".{secrets.token_hex(4)}.partial"
    stem = os.fsencode(target.stem)
    kept = os.fsdecode(stem[: max(0, len(stem) - len(token) - 1)])
    return target.with_name(f".{kept}{token}{target.suffix}")


_ADVICE = {
    errno.ENOSPC: "the disk is full; free some space, or write to another disk",
    errno.EDQUOT: "your share of the disk is used up; free some space, or write to another disk",
    errno.EACCES: "you may not write in its folder; name another one",
    errno.EPERM: "you may not write in its folder; name another one",
    errno.EROFS: "its disk can only be read; name a folder on another one",
    errno.ENAMETOOLONG: "its name is too long; choose a shorter one",
    errno.EFBIG: "it would be larger than files may be here; write to another disk",
}


def _name(path: str | os.PathLike[str]) -> str:
    return str(Place(Path(path)))


def _write_error(path: str | os.PathLike[str], error: OSError) -> OSError:
    """The error that says which file could not be written, why, and what to do."""
    number = error.errno
    why = _ADVICE.get(number or 0) or f"{error.strerror or error}; name a file elsewhere"
    explained = type(error)(f"cannot write {_name(path)}: {why}")
    explained.errno = number
    return explained
