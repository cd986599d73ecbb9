"""The command line `harnack`. It turns arguments into calls of the library, and writes results to
files. A "command" is the first argument, such as `render`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from harnack.cli.arguments import parse
from harnack.cli.commands import COMMANDS
from harnack.cli.messages import error_line, print_warnings, track_interrupts

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line with these arguments (by default those of the process), and return the
    exit code: 0 for success, 1 for an error, 2 for wrong usage, 130 for Ctrl-C."""
    with track_interrupts() as interrupts, print_warnings():
        try:
            options = parse(arguments)
            return COMMANDS[options.command](options)
        except KeyboardInterrupt:
            interrupts.pressed = True
        except (ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError) as error:
            # A Ctrl-C within a plug-in reaches us as an error of Mitsuba or Dr.Jit.
            if not interrupts.pressed:
                print(error_line(error), file=sys.stderr)
                return 1
        print("stopped; nothing was written for what was in progress", file=sys.stderr)
        return 130
