"""The `harnack` command, ready for Ctrl-C before anything large is imported.

This module stands outside the package: importing anything in it imports Dr.Jit and NumPy first,
which takes a second, and a KeyboardInterrupt during an import ends in a traceback.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


def _stop(number: int, frame: FrameType | None) -> None:
    """End at once: nothing has been begun yet, or everything is finished."""
    del number, frame
    os.write(2, b"stopped\n")
    os._exit(130)


# At import, so that no moment is left in which Ctrl-C shows a traceback.
signal.signal(signal.SIGINT, _stop)


def main() -> int:
    """Run a command; the exit code, as `harnack.cli.main` has it, and 1 if what harnack stands on
    cannot be imported."""
    try:
        from harnack.cli import main as run  # not above: it takes a second
    except ImportError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return run()
