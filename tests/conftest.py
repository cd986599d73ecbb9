"""Settings that hold for every test."""

from __future__ import annotations

import os

# First, as a user's program would: it decides which LLVM Dr.Jit loads.
import harnack.backend  # noqa: F401  # isort: skip

import drjit as dr
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


def _share_cores() -> None:
    """Give each pytest-xdist worker its share of the cores.

    Dr.Jit starts a thread a core in every process; with a worker a core as well, threads would
    outnumber cores by the square.
    """
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers > 1:
        dr.set_thread_count(max(1, (os.cpu_count() or 1) // workers))


_share_cores()
