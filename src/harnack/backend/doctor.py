"""The report of the command `harnack doctor`: versions, the backend (the device that runs kernels),
LLVM, and what to do about problems. Each line of the report is a `Finding`."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

import drjit as dr
from rich.console import Console
from rich.table import Table
from rich.text import Text

from harnack._version import __version__
from harnack.backend.arrays import BACKEND_VARIABLE, Index, Mask, Real, choose_backend, to_numpy
from harnack.backend.atomic_library import is_stand_in_loaded
from harnack.backend.llvm import PATH_VARIABLE, LLVMNotFoundError, find_libraries, loaded_library

_PACKAGES = ("drjit", "mitsuba", "numpy", "scipy", "trimesh")
# Time after which a kernel counts as hanging.
_KERNEL_SECONDS = 120


@dataclass(frozen=True)
class Finding:
    """One line of the report on an installation.

    subject: what was examined.
    detail: what was found.
    ok: False if harnack cannot work because of it.
    advice: what to do about a problem; empty if there is none.
    """

    subject: str
    detail: str
    ok: bool = True
    advice: str = ""


def diagnose() -> tuple[Finding, ...]:
    """Examine this installation, and return the lines of the report. It raises no error: kernels,
    which might end the process, are tried in separate processes."""
    findings = [
        Finding("harnack", __version__),
        Finding("Python", f"{platform.python_version()} at {sys.executable}"),
        Finding("system", f"{platform.platform()}, {os.cpu_count()} cores"),
        *(_package_finding(name) for name in _PACKAGES),
        *_atomic_findings(),
        _device_finding("CUDA", dr.JitBackend.CUDA),
        _device_finding("Metal", dr.JitBackend.Metal),
        *_llvm_findings(),
    ]
    backend = _backend_finding()
    findings.append(backend)
    if backend.ok:
        findings += [_kernel_finding("single"), _kernel_finding("double")]
    return tuple(findings)


def _package_finding(name: str) -> Finding:
    """Return the line about the version of a package."""
    try:
        return Finding(name, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, "not installed", ok=False, advice=f"pip install {name}")


def _atomic_findings() -> list[Finding]:
    """Return a line that says that a stand-in for libatomic is in use; none if it is not."""
    if not is_stand_in_loaded():
        return []
    return [Finding("libatomic", "none on this system; our stand-in serves Dr.Jit")]


def _device_finding(name: str, kind: Any) -> Finding:
    """Return the line that says whether Dr.Jit finds a usable device. name: of the backend, such as
    "CUDA". kind: Dr.Jit's constant for it."""
    if dr.has_backend(kind):
        return Finding(name, "a usable device")
    return Finding(name, "no usable device (none is needed)")


def _llvm_findings() -> list[Finding]:
    """Return a line about the LLVM that Dr.Jit has loaded, then a line for each LLVM on this
    machine, best first."""
    loaded = loaded_library()
    requested = os.environ.get(PATH_VARIABLE)
    source = f" ({PATH_VARIABLE})" if requested else ""
    text = f"{loaded.path}, version {loaded.major}{source}" if loaded else "none loaded"
    findings = [Finding("LLVM", text)]
    for library in find_libraries():
        version = "unknown" if library.major is None else library.major
        verdict = library.rejection_reason or "acceptable"
        name = "LLVM passed over" if library.rejection_reason else "LLVM found"
        findings.append(Finding(name, f"{library.path}, version {version}: {verdict}"))
    return findings


def _backend_finding() -> Finding:
    """Return the line about the backend that is chosen, or the reason why there is none."""
    forced = os.environ.get(BACKEND_VARIABLE)
    source = f", forced by {BACKEND_VARIABLE}" if forced else ""
    try:
        backend = choose_backend()
    except LLVMNotFoundError as error:
        return Finding("backend", "none", ok=False, advice=str(error))
    except (RuntimeError, ValueError) as error:
        return Finding("backend", f"none{source}", ok=False, advice=str(error))
    threads = f" on {dr.thread_count()} threads" if backend.name == "llvm" else ""
    return Finding("backend", f"{backend.name}{threads}, {backend.precision} precision{source}")


def _kernel_finding(precision: str) -> Finding:
    """Return the line that says whether a small kernel of this precision runs. It is tried in a
    separate process, since an unsuitable LLVM may end the process that uses it."""
    subject = f"kernel, {precision} precision"
    code = f"import harnack.backend.doctor as d; d.try_kernel({precision!r})"
    try:
        process = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            timeout=_KERNEL_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Finding(subject, f"no answer in {_KERNEL_SECONDS} s", ok=False)
    if process.returncode == 0:
        return Finding(subject, "runs")
    # A short error output ends with the message; a long one, as of a crash, begins with it.
    lines = process.stderr.strip().splitlines() or ["no message"]
    detail = (
        f"fails with exit status {process.returncode}: {lines[0] if len(lines) > 3 else lines[-1]}"
    )
    return Finding(
        subject, detail, ok=False, advice=f"choose another LLVM: set {PATH_VARIABLE} to its file"
    )


def try_kernel(precision: str) -> None:
    """Compile and run a small kernel with the operations that the tracer uses, and check its
    result.

    Raises:
        RuntimeError: the result is wrong.
    """
    backend = choose_backend("double" if precision == "double" else "single")
    table = dr.arange(backend.Float, 8) + 1  # 1 to 8
    dr.eval(table)
    x = dr.linspace(backend.Float, 0, 1, 64)

    def is_active(i: Index, total: Real) -> Mask:
        """Return whether the loop continues, for the index i of its next step."""
        return i < 8

    def add(i: Index, total: Real) -> tuple[Index, Real]:
        """Do one step of the loop: add term i of the table to the sum `total`. Returns the next
        index and the new sum."""
        term = dr.gather(backend.Float, table, i)
        return i + 1, total + dr.minimum(term, 4) * dr.sqrt(x)

    _, total = dr.while_loop((backend.UInt32(0), dr.zeros(backend.Float, 64)), is_active, add)
    # At x = 1 the sum is 1 + 2 + 3 + 4 + 4 + 4 + 4 + 4.
    if abs(float(to_numpy(total)[-1]) - 26.0) > 1e-4:
        raise RuntimeError(f"the kernel gave {total[-1]} instead of 26")


def print_report(console: Console) -> bool:
    """Print the report. Returns True if harnack can work with this installation."""
    findings = diagnose()
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column()
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")  # a path must not lose its end
    for finding in findings:
        mark = Text("ok", style="green") if finding.ok else Text("no", style="bold red")
        table.add_row(mark, finding.subject, Text(finding.detail))
    console.print(table)
    for finding in findings:
        if finding.advice:
            console.print(
                Text(f"\n{finding.subject}: ", style="bold").append(finding.advice), soft_wrap=True
            )
    return all(finding.ok for finding in findings)
