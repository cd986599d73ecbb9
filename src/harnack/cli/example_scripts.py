"""The command `examples`: the example scripts that come with harnack, listed, and copied into a
folder."""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path

from harnack.files.file_geometry import write_atomically


@dataclass(frozen=True)
class ExampleScript:
    """An example script.

    name: of the file, such as "film.py".
    content: the bytes of the file.
    title: what it shows, in a sentence without a full stop.
    extras: the names of the extras of harnack, such as "film", whose packages the script needs.
    """

    name: str
    content: bytes
    title: str
    extras: tuple[str, ...]

    @property
    def requirement(self) -> str:
        """What has to be installed for the script, such as " (needs harnack[film])"; "" if harnack
        alone suffices."""
        return f" (needs harnack[{','.join(self.extras)}])" if self.extras else ""


def example_scripts() -> tuple[ExampleScript, ...]:
    """Read the example scripts, in the order of their names.

    Raises:
        FileNotFoundError: this installation has none.
    """
    return tuple(_read_script(path) for path in sorted(_scripts_folder().glob("*.py")))


def _scripts_folder() -> Path:
    """Return the folder of the example scripts: within the installed package or, if the package is
    used from the repository, that of the repository. Raises a FileNotFoundError if there is none.
    """
    package = Path(__file__).resolve().parent.parent
    # The second is beside `src`.
    for folder in (package / "examples", package.parents[1] / "examples"):
        if (folder / "spanning_surface.py").is_file():
            return folder
    raise FileNotFoundError(
        f"the example scripts are missing: there are none in {package / 'examples'}; "
        "install harnack again"
    )


def _read_script(path: Path) -> ExampleScript:
    """Read an example script. Its docstring begins with its title, and names the extras that it
    needs as in `pip install 'harnack[film]'`."""
    content = path.read_bytes()
    docstring = ast.get_docstring(ast.parse(content)) or ""
    extras = re.findall(r"'harnack\[([\w,-]+)\]'", docstring)
    return ExampleScript(
        path.name,
        content,
        docstring.partition("\n")[0].rstrip("."),
        tuple(extra for names in extras for extra in names.split(",")),
    )


def copy_scripts(scripts: tuple[ExampleScript, ...], folder: Path) -> None:
    """Copy example scripts into a folder, which exists. Files that are the same already are left as
    they are.

    Raises:
        FileExistsError: the folder has other files of these names; nothing is copied then.
    """
    differing = [script.name for script in scripts if _differs(folder / script.name, script)]
    if differing:
        raise FileExistsError(
            f"{folder} has other files of these names, which are not overwritten: "
            f"{', '.join(differing)}; move them, or name another folder"
        )
    for script in scripts:
        target = folder / script.name
        if not target.exists():
            with write_atomically(target) as partial:
                partial.write_bytes(script.content)


def _differs(target: Path, script: ExampleScript) -> bool:
    """Return whether there is something at the path `target` that is not a copy of the script."""
    if not target.exists():
        return target.is_symlink()  # a link that leads nowhere would be replaced
    return not target.is_file() or target.read_bytes() != script.content
