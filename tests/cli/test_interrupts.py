"""Ctrl-C: one line, exit code 130 and nothing half-written, whenever it comes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from harnack import cli

ROOT = Path(__file__).resolve().parents[2]
# Where the command begins, as it is installed.
MODULE, FUNCTION = re.findall(
    r'^harnack = "([\w.]+):(\w+)"', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.M
)[0]

# Sends Ctrl-C to the process itself at the moment when a module begins to be imported.
INTERRUPT_AT = """
import os, signal, sys
class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == {name!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
sys.argv = ["harnack", *{arguments!r}]
from {module} import {function}
sys.exit({function}())
"""


def run(code: str, folder: Path) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120,
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
    )  # fmt: skip
    return done.returncode, done.stderr


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "name", ["harnack", "numpy", "drjit", "scipy.spatial", "harnack.cli", "rich.console", "mitsuba"]
)
def test_ctrl_c_during_imports_ends_in_one_line(name: str, tmp_path: Path) -> None:
    arguments = ["render", "polygon", "--size", "8x8", "--show", "normal", "--quiet"]
    code = INTERRUPT_AT.format(name=name, arguments=arguments, module=MODULE, function=FUNCTION)
    status, complaint = run(code, tmp_path)
    assert status == 130, complaint
    assert re.fullmatch(r"stopped\b.*\n", complaint)
    assert list(tmp_path.iterdir()) == []


def interrupting(text: str) -> str:
    """A harnack command interrupted where `text` patches something to call `interrupt`."""
    return f"""
import os, signal, sys
def interrupt(*_, **__):
    os.kill(os.getpid(), signal.SIGINT)
    return 0
import {MODULE}, harnack.cli
{text}
sys.argv = ["harnack", "render", "polygon", "--size", "64x64", "--spp", "1", "-o", "a.png"]
sys.exit({MODULE}.{FUNCTION}())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "patch",
    [
        # between two bands of the picture
        "import harnack.rendering.light_paths as m; m._mixed = interrupt",
        # while Mitsuba calls us from its own code, which makes another error of it
        "import harnack.rendering.integrator as m; m.PathTracer.__init__ = interrupt",
        # while the picture is written, and again while that is cleared up
        "import pathlib; w, u = pathlib.Path.write_bytes, pathlib.Path.unlink; "
        "pathlib.Path.write_bytes = lambda p, b: [w(p, b[:9]), interrupt()]; "
        "pathlib.Path.unlink = lambda *a, **k: [interrupt(), u(*a, **k)]",
    ],
)
def test_ctrl_c_during_a_render_leaves_nothing(patch: str, tmp_path: Path) -> None:
    status, complaint = run(interrupting(patch), tmp_path)
    assert status == 130, complaint
    assert re.search(r"^stopped\b.*\n\Z", complaint, re.M)
    assert "Traceback" not in complaint
    assert list(tmp_path.iterdir()) == []


def test_an_error_that_ctrl_c_turned_into_another_is_no_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import signal

    def interrupted(options: Any) -> int:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise RuntimeError("a plug-in failed") from None
        return 0

    monkeypatch.setattr(cli, "COMMANDS", {"doctor": interrupted})
    before = signal.getsignal(signal.SIGINT)
    assert cli.main(["doctor"]) == 130
    assert capsys.readouterr().err.startswith("stopped")
    assert signal.getsignal(signal.SIGINT) is before
