"""Settings that hold for every test."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

# First, as a user's program would: it decides which LLVM Dr.Jit loads.
import harnack.backend  # noqa: F401  # isort: skip

import drjit as dr
import pytest
from hypothesis import HealthCheck, settings

# A first example compiles kernels, so its time says nothing: no deadline, no too-slow check.
# Derandomized: a run tests the change, not its luck. Found failures become literal cases.
settings.register_profile(
    "harnack",
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("harnack")


# The folders whose files take longest.
_LONG_FILES = "tests/project/", "tests/meshing/"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of a test marked `few(k)`, the quick suite runs k of its parameters, spread over all of them;
    the others are slow."""
    tests: defaultdict[str, list[pytest.Item]] = defaultdict(list)
    for item in items:
        if item.get_closest_marker("few") and not item.get_closest_marker("slow"):
            tests[item.nodeid.partition("[")[0]].append(item)
    for each in tests.values():
        (count,) = each[0].get_closest_marker("few").args  # type: ignore[union-attr]
        quick = {(2 * k + 1) * len(each) // (2 * count) for k in range(count)}
        for number, item in enumerate(each):
            if number not in quick:
                item.add_marker(pytest.mark.slow)
    # Files that take long first, so that no worker is left alone with one at the end.
    items.sort(key=lambda item: not item.nodeid.startswith(_LONG_FILES))


def _share_cores() -> None:
    """Give each pytest-xdist worker its share of the cores.

    Dr.Jit starts a thread a core in every process; with a worker a core as well, threads would
    outnumber cores by the square.
    """
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers > 1:
        dr.set_thread_count(max(1, (os.cpu_count() or 1) // workers))


_share_cores()


@pytest.fixture
def save(tmp_path: Path) -> Callable[[str, str | bytes], Path]:
    """Writes a file of that name and content into the test's own folder."""

    def write(name: str, content: str | bytes) -> Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write
