"""Install a package into a fresh environment and run the README's code there, away from the
repository. `scripts/dist.py` does so with the wheel and with the source archive. Standard library
only."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import tempfile
import threading
import time
import urllib.request
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

IMPORT_AIM = 0.35  # seconds for `import harnack` once its files are in memory
COMMAND_TIMEOUT = 900  # seconds
VIEW_TIMEOUT = 120  # seconds until a view has a page
# The files that the README's command lines read, which stand for a user's own.
INPUT_FILES = """
import trimesh
sphere = trimesh.creation.icosphere(subdivisions=3)
sphere.export("bunny.obj")
sphere.update_faces(range(40, len(sphere.faces)))
sphere.export("broken.ply")
"""
# `harnack check` ends with 1 where a part has faults, which is no fault of the program.
EXIT_CODES = {"check": (0, 1)}
# How long the import takes, without starting Python.
IMPORT_TIME = "import time; t = time.perf_counter(); import harnack; print(time.perf_counter() - t)"


class TrialError(Exception):
    """A package cannot be installed, or what the README says does not run. The message has the
    command and what it printed."""


@dataclass(frozen=True)
class Environment:
    """A virtual environment, and a folder in which its programs run.

    programs: the folder of python, pip and harnack.
    folder: an empty folder, outside of the repository.
    variables: the variables of the operating system's environment.
    """

    programs: Path
    folder: Path
    variables: Mapping[str, str]

    def run(self, *command: str, exit_codes: Sequence[int] = (0,)) -> str:
        """Run a program of the environment and return what it prints to standard output.

        Raises:
            TrialError: its exit code is none of `exit_codes`, or it took longer than
                `COMMAND_TIMEOUT`.
        """
        try:
            done = subprocess.run(
                [str(self.programs / command[0]), *command[1:]],
                cwd=self.folder,
                env=dict(self.variables),
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                check=False,
                timeout=COMMAND_TIMEOUT,
            )
        except subprocess.TimeoutExpired as error:
            raise TrialError(f"no end after {COMMAND_TIMEOUT} s: {shlex.join(command)}") from error
        if done.returncode not in exit_codes:
            text = f"{done.stdout}{done.stderr}\n"
            raise TrialError(f"{text}exit code {done.returncode}: {shlex.join(command)}")
        return done.stdout


def try_package(package: Path, python: str, readme: Path) -> None:
    """Install the wheel or source archive `package` into a fresh environment of the interpreter
    `python`, and run there what `readme` shows: first the program alone, then, with the extras
    that the README names, its Python code and its command lines.

    Raises:
        TrialError: something does not work. The message says what.
    """
    text = readme.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory(prefix="harnack-fresh-") as folder:
        environment = make_environment(Path(folder), python)
        install(environment, str(package))
        environment.run("harnack", "doctor")
        report_import_time(environment)
        extras = ",".join(named_extras(text))
        if extras:
            install(environment, f"harnack[{extras}] @ {package.as_uri()}")
        run_blocks(environment, python_blocks(text))
        environment.run("python", "-c", INPUT_FILES)
        for line in command_lines(text):
            run_line(environment, line)


def make_environment(folder: Path, python: str) -> Environment:
    """Make a virtual environment of the interpreter `python` below `folder`, and a folder to work
    in beside it.

    Raises:
        TrialError: `python` is not there, or cannot make virtual environments.
    """
    venv, work = folder / "environment", folder / "work"
    work.mkdir()
    variables = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    }
    try:
        subprocess.run(
            [python, "-m", "venv", str(venv)], check=True, cwd=folder, env=variables, text=True,
            capture_output=True,
        )  # fmt: skip
    except OSError as error:
        raise TrialError(f"no interpreter {python}: {error}") from error
    except subprocess.CalledProcessError as error:
        raise TrialError(f"{python} makes no virtual environment: {error.stderr}") from error
    programs = venv / ("Scripts" if os.name == "nt" else "bin")
    path = os.pathsep.join([str(programs), variables.get("PATH", "")])
    return Environment(programs, work, {**variables, "PATH": path})


def install(environment: Environment, requirement: str) -> None:
    """Install a requirement into an environment, and check that all packages there fit."""
    start = time.monotonic()
    environment.run("pip", "install", "--quiet", "--disable-pip-version-check", requirement)
    environment.run("pip", "check", "--disable-pip-version-check")
    print(f"dist:   {time.monotonic() - start:4.0f} s  pip install {requirement.split('/')[-1]}")


def report_import_time(environment: Environment) -> None:
    """Print how long `import harnack` takes, the least of five times."""
    least = min(float(environment.run("python", "-c", IMPORT_TIME)) for _ in range(5))
    print(f"dist:   {least:.2f} s  import harnack (at most {IMPORT_AIM} s is the aim)", flush=True)


def named_extras(text: str) -> list[str]:
    """Return the extras of harnack that a page names, as in "pip install 'harnack[film,view]'"."""
    lists = re.findall(r"\bharnack\[([\w,-]+)\]", text)
    return sorted({name for names in lists for name in names.split(",")})


def python_blocks(text: str) -> list[str]:
    """Return the blocks of Python code of a page.

    Raises:
        TrialError: there is none.
    """
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    if not blocks:
        raise TrialError("the README has no block of Python code")
    return blocks


def command_lines(text: str) -> list[str]:
    """Return the lines with commands of harnack of a page: the indented ones.

    Raises:
        TrialError: there is none.
    """
    lines = re.findall(r"^ {4}(harnack .*?) *$", text, re.MULTILINE)
    if not lines:
        raise TrialError("the README has no command line of harnack")
    return lines


def run_blocks(environment: Environment, blocks: Sequence[str]) -> None:
    """Run blocks of Python code, each as a script of its own."""
    for number, block in enumerate(blocks, 1):
        script = environment.folder / f"block_{number}.py"
        script.write_text(block, encoding="utf-8")
        start = time.monotonic()
        environment.run("python", script.name)
        print(f"dist:   {time.monotonic() - start:4.0f} s  Python block {number}", flush=True)


def run_line(environment: Environment, line: str) -> None:
    """Run a command line, and check that the file behind -o is there afterwards.

    Raises:
        TrialError: it failed, or wrote no file.
    """
    start = time.monotonic()
    command = shlex.split(line, comments=True)
    if command[1] == "view":
        try_view(environment, command)
    else:
        environment.run(*command, exit_codes=EXIT_CODES.get(command[1], (0,)))
    if "-o" in command:
        output = environment.folder / command[command.index("-o") + 1]
        if not output.exists():
            raise TrialError(f"wrote no {output.name}: {line}")
    print(f"dist:   {time.monotonic() - start:4.0f} s  {line}", flush=True)


def try_view(environment: Environment, command: Sequence[str]) -> None:
    """Start a live view without a browser, fetch its page, and stop it as Ctrl-C does.

    Raises:
        TrialError: it names no address within `VIEW_TIMEOUT`, or has no page there.
    """
    program = [str(environment.programs / command[0]), *command[1:], "--no-browser"]
    with subprocess.Popen(
        program,
        cwd=environment.folder,
        env=dict(environment.variables),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout is not None
        stopwatch = threading.Timer(VIEW_TIMEOUT, process.kill)
        stopwatch.start()
        printed = ""
        try:
            for line in process.stdout:
                printed += line
                address = re.search(r"http://\S+", line)
                if address is not None:
                    with urllib.request.urlopen(address[0], timeout=VIEW_TIMEOUT) as page:
                        has_page = b"<html" in page.read()
                    break
            else:
                raise TrialError(f"{printed}\nno address: {shlex.join(command)}")
        finally:
            stopwatch.cancel()
            process.send_signal(signal.SIGINT)
    if not has_page:
        raise TrialError(f"{printed}\nno page at {address[0]}: {shlex.join(command)}")
