"""Kernels are recorded beside other threads."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable

import drjit as dr
import pytest

from harnack.backend import choose_backend
from harnack.webgpu import record_kernel

# In a process of its own, since the lock that it is about stops all threads.
_SCRIPT = """
import faulthandler, gc, sys, threading
from harnack.backend import choose_backend
from harnack.webgpu.recording import record_kernel
import drjit as dr

faulthandler.dump_traceback_later(50, exit=True)
real = choose_backend("single").Float


class Cycle:
    pass


def cycle():
    one = Cycle()
    one.own, one.array = one, real([1.0, 2.0])
    return one


def recorded():
    for k in range(60):
        record_kernel(lambda x, k=k: {"y": dr.sin(x) * (k + 1.0)}, {"x": real([1.0, 2.0, 3.0])}, ())


waste = [cycle() for _ in range(50_000)]
thread = threading.Thread(target=recorded)
gc.set_threshold(20)
sys.setswitchinterval(1e-5)
thread.start()
while thread.is_alive() and waste:
    waste.pop()
    [[] for _ in range(300)]
thread.join()
assert gc.isenabled()
"""


def test_arrays_freed_as_garbage_of_other_threads_stop_no_recording() -> None:
    """One thread waited for Dr.Jit's lock with Python's, the other for Python's with Dr.Jit's."""
    ended = subprocess.run([sys.executable, "-c", _SCRIPT], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


def in_another_thread(work: Callable[[], None]) -> None:
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()


def test_other_threads_print_while_a_kernel_is_recorded(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = choose_backend("single").Float
    clear = dr.kernel_history_clear

    def clear_and_print() -> None:
        clear()
        in_another_thread(lambda: print("said meanwhile"))

    monkeypatch.setattr(dr, "kernel_history_clear", clear_and_print)
    record_kernel(lambda x: {"y": dr.sin(x)}, {"x": real([1.0, 2.0])}, ())
    assert capsys.readouterr().out == "said meanwhile\n"


def test_what_other_threads_read_is_no_data_of_a_kernel() -> None:
    backend = choose_backend("single")
    table, index = backend.Float([1.0, 2.0, 3.0]), backend.UInt32([0, 2, 1])
    dr.eval(table, index)

    def compute(x: dr.ArrayBase) -> dict[str, dr.ArrayBase]:
        in_another_thread(lambda: dr.eval(dr.gather(backend.Float, table, index + 0 * index)))
        return {"y": dr.sin(x)}

    assert record_kernel(compute, {"x": backend.Float([1.0, 2.0])}, ()).data == {}
