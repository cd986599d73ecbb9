"""Chooses the LLVM on which the CPU backend runs, before Dr.Jit can load an unsuitable one.

Dr.Jit compiles CPU kernels with an LLVM library that it finds and loads during `import drjit`; the
environment variable `DRJIT_LIBLLVM_PATH` names one. Dr.Jit accepts nearly any version, but many
versions do not work. Tried with Dr.Jit 1.5.0 on x86-64 (loops, packet gathers, elementary
functions, gradients, scatters, a Mitsuba render):

    up to 14   refused by Dr.Jit, which then has no CPU backend
    15, 16     abort the whole process at the first `dr.minimum` ("Cannot select ... fmaximum")
    17 to 19   work
    20         not tried (no package at hand); its neighbors work
    21 to 23   work; 22 and 23 made the tracing kernels 10 to 15 % slower than 19

So 17 is the minimum and 19 the preferred version. A version newer than 23 is used only if there is
no other.

On Linux with an x86-64 processor, the package requires `karellen-llvm-core`, a wheel that brings
LLVM 19 into the Python environment, so nothing has to be installed on the system. No such wheel is
known for other systems.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import mmap
import os
import platform
import re
import shlex
import shutil
import site
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from harnack.backend.atomic_library import provide_atomic_library

LLVM_WHEEL = "'karellen-llvm-core>=19.1.7,<20'"
"""What pip installs to bring LLVM to Linux on x86-64, as pyproject.toml requires it."""
MINIMUM_MAJOR = 17
PREFERRED_MAJOR = 19
NEWEST_TRIED_MAJOR = 23
PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"


class LLVMNotFoundError(RuntimeError):
    """The error if there is no LLVM that Dr.Jit can use. The message ends with a command that mends
    this."""


@dataclass(frozen=True)
class LLVMLibrary:
    """A shared LLVM library on this machine.

    path: its path; links are not resolved.
    major: its major version, None if it cannot be determined without loading the library.
    """

    path: Path
    major: int | None

    @property
    def rejection_reason(self) -> str | None:
        """Why this library must not be used; None if it may be used."""
        return rejection_reason(self.major)


def rejection_reason(major: int | None) -> str | None:
    """Return why an LLVM of this major version must not be used; None if it may be used. major:
    None if the version is unknown."""
    if major is None:
        return "its version cannot be told"
    if major < 15:
        return f"LLVM {major} is too old for Dr.Jit, which would run without a CPU backend"
    if major < MINIMUM_MAJOR:
        return f"LLVM {major} aborts the process when Dr.Jit compiles dr.minimum"
    return None


def library_version(path: Path) -> int | None:
    """Determine the major version of the LLVM library at `path` without loading it; None if
    unknown.

    The version is looked for in the file name (libLLVM-15.so.1, libLLVM.so.19.1), in the name of
    the file to which links lead, in the SONAME that the library stores, and in the folders of the
    path (Homebrew: Cellar/llvm/21.1.0/lib).
    """
    resolved_path = Path(os.path.realpath(path))
    for name in (path.name, resolved_path.name):
        match = re.match(r"libLLVM(?:-|\.so\.|\.)(\d+)", name)
        if match:
            return int(match[1])
    major = _version_from_soname(resolved_path)
    if major is not None:
        return major
    # From the innermost folder outwards; a number counts only below a folder of LLVM.
    for folder in reversed(resolved_path.parts[:-1]):
        match = re.fullmatch(r"(?:llvm[-@]?)?(\d\d)(?:\.\d+){0,2}(?:_\d+)?", folder)
        if match and "llvm" in str(resolved_path.parent).lower():
            return int(match[1])
    return None


def _version_from_soname(path: Path) -> int | None:
    """Return the major version in the SONAME of a library (the name that the library stores for the
    linker); None if there is none."""
    try:
        # 0: the whole file is mapped.
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            match = re.search(rb"\0libLLVM(?:-(\d+)[.\d]*\.so|\.so\.(\d+))[.\d]*\0", data)
            return int(match[1] or match[2]) if match else None
    except (OSError, ValueError):  # unreadable, or empty
        return None


def _search_folders() -> Iterator[Path]:
    """Yield the folders that may hold LLVM libraries on this platform, the folders of this Python
    first."""
    # Where wheels install LLVM: into this environment, by `pip install --user`, or into the
    # environment that this one sees by `--system-site-packages`.
    yield Path(sys.prefix) / "lib"
    if site.ENABLE_USER_SITE:
        yield Path(site.getuserbase()) / "lib"
    yield Path(sys.base_prefix) / "lib"
    if "CONDA_PREFIX" in os.environ:
        yield Path(os.environ["CONDA_PREFIX"]) / "lib"
    if sys.platform == "darwin":
        for base in (Path("/opt/homebrew/opt"), Path("/usr/local/opt")):
            yield from (keg / "lib" for keg in sorted(base.glob("llvm*")))
    else:
        yield Path(f"/usr/lib/{platform.machine()}-linux-gnu")
        yield from sorted(Path("/usr/lib").glob("llvm-*/lib"))
        yield Path("/usr/lib64")
        yield from sorted(Path("/usr/lib64").glob("llvm*/lib*"))
        yield Path("/usr/lib")
    yield Path("/usr/local/lib")


def find_libraries(folders: Iterable[Path] | None = None) -> tuple[LLVMLibrary, ...]:
    """Find all LLVM libraries in `folders` (by default, the folders where this platform keeps
    them). Returns them, best first. Each file is listed once, however many links lead to it. No
    library is loaded."""
    libraries: dict[str, LLVMLibrary] = {}
    for folder in _search_folders() if folders is None else folders:
        for pattern in ("libLLVM.so*", "libLLVM-*.so*", "libLLVM.dylib", "libLLVM-*.dylib"):
            for path in sorted(folder.glob(pattern)):
                resolved_path = os.path.realpath(path)
                if resolved_path not in libraries and os.path.isfile(resolved_path):
                    libraries[resolved_path] = LLVMLibrary(path, library_version(path))
    # The sort is stable, so among equals the order of the folders decides.
    best_first = sorted(
        libraries.values(), key=lambda library: preference_key(library.major), reverse=True
    )
    return tuple(best_first)


def preference_key(major: int | None) -> tuple[bool, bool, bool, int]:
    """Return a key by which LLVM versions are sorted: the greatest key belongs to the version to
    use. major: None if the version is unknown."""
    version = major or 0
    return (
        rejection_reason(major) is None,
        version == PREFERRED_MAJOR,
        version <= NEWEST_TRIED_MAJOR,
        version,
    )


def best_library() -> LLVMLibrary | None:
    """Return the acceptable LLVM library on this machine that is used by default; None if there is
    none."""
    return next((library for library in find_libraries() if library.rejection_reason is None), None)


def import_drjit() -> None:
    """Import Dr.Jit such that it loads the best acceptable LLVM. Whether the loaded LLVM works is
    not checked here.

    Dr.Jit loads LLVM while it is imported, so this must come before any other `import drjit`. If
    Dr.Jit was imported already, or the user set DRJIT_LIBLLVM_PATH, that choice stands, and
    `ensure_llvm` checks it. The environment is unchanged afterwards.

    Raises:
        ImportError: Dr.Jit cannot be imported.
    """
    if "drjit" in sys.modules:
        return
    provide_atomic_library()
    requested = os.environ.get(PATH_VARIABLE)
    best = None if requested else best_library()
    if best is not None:
        os.environ[PATH_VARIABLE] = str(best.path)
    if requested or best:
        _load_cpp_runtime(Path(os.environ[PATH_VARIABLE]))
    try:
        importlib.import_module("drjit")
    except (ImportError, NameError) as error:  # Dr.Jit 1.5 covers its ImportError by a NameError
        cause = error.__context__ or error
        # The stand-in for libatomic could not be loaded, or this is no x86-64 processor.
        hint = ": on Debian and Ubuntu, `sudo apt-get install libatomic1`"
        raise ImportError(
            f"Dr.Jit cannot be imported: {cause}{hint if 'libatomic' in str(cause) else ''}"
        ) from error
    finally:
        if best is not None:
            del os.environ[PATH_VARIABLE]


def _load_cpp_runtime(path: Path) -> None:
    """Load the C++ runtime that the wheel `karellen-llvm-core` puts beside its LLVM, if it lacks
    the links by which the dynamic linker finds it.

    A wheel cannot contain links. This one makes them when Python next starts, which fails where
    the user may not write into the environment, as in many containers.

    path: of the LLVM library.
    """
    folder = path.parent / f"{platform.machine()}-unknown-linux-gnu"
    for name in ("libunwind.so.1", "libc++abi.so.1", "libc++.so.1"):  # each needs those before it
        library = folder / f"{name}.0"
        if library.is_file() and not (folder / name).exists():
            # If this fails, so does loading LLVM, and `ensure_llvm` reports it.
            with contextlib.suppress(OSError):
                ctypes.CDLL(str(library))


def loaded_library() -> LLVMLibrary | None:
    """Return the LLVM library that Dr.Jit has loaded in this process; None if it has loaded
    none."""
    major = _loaded_major()
    if major is None:
        return None
    for path in _mapped_libraries():
        if library_version(path) == major:
            return LLVMLibrary(path, major)
    # No memory map to read (macOS), or an unusual name: the path that Dr.Jit was given, or its
    # default.
    return LLVMLibrary(Path(os.environ.get(PATH_VARIABLE) or "libLLVM"), major)


def _loaded_major() -> int | None:
    """Return the major version of the LLVM that Dr.Jit has loaded; None if it has none."""
    import_drjit()
    import drjit as dr  # not at the top: importing it loads LLVM, and import_drjit says which

    if not dr.has_backend(dr.JitBackend.LLVM):
        return None
    return int(dr.detail.llvm_version()[0])


def _mapped_libraries() -> tuple[Path, ...]:
    """Return the LLVM libraries in this process's memory map. There are none on systems other than
    Linux."""
    maps = Path("/proc/self/maps")
    if not maps.exists():
        return ()
    lines = maps.read_text(errors="replace").splitlines()
    # The sixth column of a line is the path of the file.
    names = {line.split(maxsplit=5)[-1] for line in lines if "libLLVM" in line}
    return tuple(Path(name) for name in sorted(names))


def ensure_llvm() -> int:
    """Check the LLVM that Dr.Jit has loaded, and return its major version.

    Call it before the first CPU kernel: with an unsuitable version the first kernel may end the
    process.

    Raises:
        LLVMNotFoundError: Dr.Jit has no LLVM, or one that it cannot use.
    """
    major = _loaded_major()
    if major is None:
        raise LLVMNotFoundError(_load_failure_message())
    reason = rejection_reason(major)
    if reason is not None:
        raise LLVMNotFoundError(
            f"Dr.Jit has loaded an LLVM it cannot work with: {reason}. {repair_advice()}"
        )
    return major


def _load_failure_message() -> str:
    """Return the message of an error: why Dr.Jit has loaded no LLVM, and what to do."""
    requested = os.environ.get(PATH_VARIABLE)
    # The user has chosen a file; otherwise one was looked for.
    if requested:
        reason = rejection_reason(library_version(Path(requested)))
        if not Path(requested).exists():
            reason = "there is no such file"
        reason = reason or "Dr.Jit cannot load it"
        return f"{PATH_VARIABLE} names {requested}: {reason}. {repair_advice()}"
    libraries = find_libraries()
    if libraries and libraries[0].rejection_reason is None:
        return f"Dr.Jit did not load {libraries[0].path}. {repair_advice()}"
    listing = "; ".join(f"{library.path} ({library.rejection_reason})" for library in libraries)
    found_text = f" Found only {listing}." if libraries else ""
    return f"The CPU backend needs LLVM {MINIMUM_MAJOR} or newer.{found_text} {repair_advice()}"


def repair_advice() -> str:
    """Return what to do on this machine so that Dr.Jit loads an acceptable LLVM, as a sentence with
    a command."""
    best = best_library()
    requested = os.environ.get(PATH_VARIABLE)
    if best is None or (requested and os.path.realpath(requested) == os.path.realpath(best.path)):
        return f"Install LLVM {PREFERRED_MAJOR}: {install_advice()}"
    import_hint = "" if requested else "import harnack before drjit and mitsuba, or "
    return f"LLVM {best.major} is installed: {import_hint}run `export {PATH_VARIABLE}={best.path}`"


def install_advice() -> str:
    """Return the command that installs an acceptable LLVM on this kind of system, in backquotes,
    and what else is to be done."""
    if sys.platform == "linux" and platform.machine() == "x86_64":
        return f"`{shlex.quote(sys.executable)} -m pip install {LLVM_WHEEL}`"
    if "CONDA_PREFIX" in os.environ:
        return f"`conda install -c conda-forge libllvm{PREFERRED_MAJOR}`"
    if sys.platform == "darwin":
        return f"`brew install llvm@{PREFERRED_MAJOR}`"
    if sys.platform == "win32":
        return f"`winget install LLVM.LLVM`, then set {PATH_VARIABLE} to its file bin\\LLVM-C.dll"
    if shutil.which("dnf"):
        return "`sudo dnf install llvm-libs`"
    return f"`sudo apt-get install libllvm{PREFERRED_MAJOR}`"
