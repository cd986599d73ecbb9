"""Set up the development environment in .venv; `make setup` runs it. Standard library only.

Needs Python 3.10 or newer, and no right to install anything on the system: on x86-64 processors
LLVM is one of the Python packages. What the system itself may lack is installed where this runs as
root on Debian or Ubuntu; elsewhere it says which command to run. It never asks for a password.
Running it again changes nothing.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
VENV_PYTHON = VENV / "bin" / "python"
PIP = (str(VENV_PYTHON), "-m", "pip", "--disable-pip-version-check")
DOCTOR = (
    "import sys; from rich.console import Console; from harnack.backend import doctor; "
    "sys.exit(not doctor.print_report(Console()))"
)

if sys.version_info < (3, 10):  # noqa: UP036  # Python reads no pyproject.toml
    sys.exit(f"harnack needs Python 3.10 or newer, and {sys.executable} is older")


def main() -> None:
    apt = Apt() if shutil.which("apt-get") and shutil.which("dpkg") else None
    make_venv(apt)
    run([*PIP, "install", "--quiet", "--editable", f"{ROOT}[dev]"])
    provide_libraries(apt)
    provide_webgpu(apt)
    if subprocess.run([str(VENV_PYTHON), "-c", DOCTOR], cwd=ROOT, check=False).returncode:
        sys.exit("setup: harnack cannot run yet; see the advice above")


def run(command: Sequence[str], cwd: Path = ROOT, **environment: str) -> str:
    """Run a command and return what it prints; end the setup if it fails."""
    done = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        cwd=cwd,
        env={**os.environ, **environment},
    )
    if done.returncode:
        sys.exit(f"{done.stdout}\nsetup: this failed: {' '.join(command)}")
    return done.stdout


def works(python: str | Path, code: str) -> bool:
    """Whether `python` runs `code` without an error."""
    try:
        done = subprocess.run([str(python), "-c", code], capture_output=True, check=False)
    except OSError:
        return False
    return done.returncode == 0


def make_venv(apt: Apt | None) -> None:
    """Create .venv with pip in it."""
    if works(VENV_PYTHON, "import pip"):
        return
    shutil.rmtree(VENV, ignore_errors=True)
    complete = "import ensurepip, venv"  # Debian splits ensurepip off into python3-venv
    if not works(sys.executable, complete) and apt and apt.is_root:
        apt.install("python3-venv")
    if works(sys.executable, complete):
        run([sys.executable, "-m", "venv", str(VENV)])
        return
    if not works(sys.executable, "import venv") or apt is None:
        sys.exit(f"setup: {sys.executable} lacks the module venv or ensurepip; install them")
    run([sys.executable, "-m", "venv", "--without-pip", str(VENV)])
    # The wheel that Debian's ensurepip would install can install itself.
    folder = VENV / "pip-wheel"
    apt.unpack(["python3-pip-whl"], folder)
    wheel = str(max(folder.glob("usr/share/python-wheels/pip-*.whl")))
    run(
        [str(VENV_PYTHON), "-m", "pip", "install", "--quiet", "--no-index", wheel], PYTHONPATH=wheel
    )
    shutil.rmtree(folder)


def provide_libraries(apt: Apt | None) -> None:
    """Install what Dr.Jit needs of the system where no Python package brings it. What this cannot
    do, the doctor reports."""
    if platform.machine() != "x86_64" and apt is not None and apt.is_root:
        apt.install("libllvm19", "libatomic1")


def provide_webgpu(apt: Apt | None) -> None:
    """Install a device for tests of WebGPU that is none: Mesa's, which computes on the CPU."""
    found = "import sys, wgpu; info = wgpu.gpu.request_adapter_sync().info; "
    if works(VENV_PYTHON, found + "sys.exit(info['backend_type'] == 'OpenGL')"):
        return
    if apt is not None and apt.is_root:
        apt.install("mesa-vulkan-drivers", "libvulkan1")
    else:
        print("setup: no device for WebGPU, so its tests are skipped: install a Vulkan driver")


def provide_browser() -> None:
    """Install Chromium for tests of pages: of Debian as root, else Playwright's own."""
    if shutil.which("chromium"):
        return
    apt = Apt() if shutil.which("apt-get") and shutil.which("dpkg") else None
    # Ubuntu's package of this name is a step to a snap, which containers cannot install.
    if apt is not None and apt.is_root and Path("/etc/debian_version").exists() and not is_ubuntu():
        apt.install("chromium")
        return
    run([str(VENV_PYTHON), "-m", "playwright", "install", "chromium"])


# What the tools of docs/interoperability load of the system, and the packages that have it: Open3D
# libusb, VTK and Polyscope EGL with Mesa's driver, Blender the others.
TOOL_LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libEGL_mesa.so.0": "libegl-mesa0",
    "libSM.so.6": "libsm6",
    "libXt.so.6": "libxt6",
    "libXi.so.6": "libxi6",
    "libXrender.so.1": "libxrender1",
    "libXfixes.so.3": "libxfixes3",
    "libxkbcommon.so.0": "libxkbcommon0",
}


def provide_tool_libraries() -> None:
    """Install the libraries of the system that tests of other tools need; where that cannot be
    done, end with the names of those that are missing."""
    missing = [
        package
        for library, package in TOOL_LIBRARIES.items()
        if not works(VENV_PYTHON, f"import ctypes; ctypes.CDLL({library!r})")
    ]
    if not missing:
        return
    apt = Apt() if shutil.which("apt-get") and shutil.which("dpkg") else None
    if apt is None or not apt.is_root:
        sys.exit(f"setup: install these first, or what they are called here: {' '.join(missing)}")
    apt.install(*missing)


def is_ubuntu() -> bool:
    release = Path("/etc/os-release")
    return release.exists() and "\nID=ubuntu" in "\n" + release.read_text()


@dataclass
class Apt:
    """The distribution's packages, with or without the right to install them.

    options: for every apt command; without that right, `update` adds a state of our own.
    """

    options: tuple[str, ...] = ()

    @property
    def is_root(self) -> bool:
        return os.geteuid() == 0

    def update(self) -> None:
        """Fetch the package lists: the system's as root, else a copy under .venv."""
        if not self.is_root:
            state = VENV / "apt"
            (state / "lists" / "partial").mkdir(parents=True, exist_ok=True)
            (state / "archives" / "partial").mkdir(parents=True, exist_ok=True)
            self.options = (f"-oDir::State::Lists={state}/lists", f"-oDir::Cache={state}")
        run(["apt-get", *self.options, "-qq", "update"])

    def install(self, *packages: str) -> None:
        print(f"setup: installing {', '.join(packages)}")
        command = ["apt-get", "install", "-qq", "-y", "--no-install-recommends", *packages]
        environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        if subprocess.run(command, capture_output=True, check=False, env=environment).returncode:
            self.update()  # no lists yet, or stale ones
            run(command, DEBIAN_FRONTEND="noninteractive")

    def unpack(self, packages: Sequence[str], folder: Path) -> None:
        """Unpack packages into `folder` without installing them."""
        print(f"setup: unpacking {', '.join(packages)} under {folder.relative_to(ROOT)}")
        downloads = VENV / "downloads"
        downloads.mkdir(exist_ok=True)
        command = ["apt-get", *self.options, "-qq", "download", *packages]
        if subprocess.run(command, cwd=downloads, capture_output=True, check=False).returncode:
            self.update()  # no lists yet, or stale ones
            run(["apt-get", *self.options, "-qq", "download", *packages], cwd=downloads)
        folder.mkdir(parents=True, exist_ok=True)
        for archive in sorted(downloads.glob("*.deb")):
            run(["dpkg", "-x", str(archive), str(folder)])
        shutil.rmtree(downloads)
        shutil.rmtree(VENV / "apt", ignore_errors=True)
        self.options = ()


if __name__ == "__main__":
    tasks = {(): main, ("browser",): provide_browser, ("tools",): provide_tool_libraries}
    tasks[tuple(sys.argv[1:])]()
