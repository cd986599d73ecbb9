"""What the command `harnack` shows if it is called alone: where to begin, with lines that work."""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

# A command, what it does, and a line that works in any folder, without packages of extras.
FIRST_LINES = (
    ("demo", "draw six pictures, in about a minute", "harnack demo"),
    ("render", "draw one picture", "harnack render trefoil --show shaded -o trefoil.png"),
    ("page", "make a page in which a surface turns", "harnack page trefoil -o trefoil.html"),
    ("mesh", "make triangles, to print", "harnack mesh gyroid --scale 30 -o gyroid.stl"),
    ("check", "say what a slicer would complain of", "harnack check gyroid.stl"),
    ("examples", "copy Python scripts to start from", "harnack examples"),
)
"""Six commands for a beginning: the name, what the command does, and a line to type, each of which
works after those before it."""

_MORE = (
    ("harnack --help", "all commands"),
    ("harnack render --help", "all options of a command"),
    ("harnack gallery --list", "all scenes that have a name, such as trefoil"),
    ("harnack doctor", "what is installed, what works, what is missing"),
)


def print_welcome() -> None:
    """Print six commands with a line to try for each, and where to read more; in color if the
    output is a terminal that has it."""
    console = Console(highlight=False, soft_wrap=True, emoji=False, markup=False)
    console.print("harnack draws, measures and meshes implicit surfaces. To begin with:\n")
    for name, purpose, line in FIRST_LINES:
        console.print(Text(f"  {name:<10}", style="bold").append(purpose, style="not bold"))
        console.print(Text(f"  {'':<10}").append(line, style="cyan"))
    console.print("\nMore:\n")
    width = max(len(line) for line, _ in _MORE) + 2
    for line, purpose in _MORE:
        console.print(Text("  ").append(f"{line:<{width}}", style="cyan").append(purpose))
