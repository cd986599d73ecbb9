"""Ctrl-C while a command runs."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

# A terminal and a parent process may both pass on the same Ctrl-C.
_SAME = 1.0


@dataclass
class Interrupts:
    """Whether Ctrl-C was pressed, and when (`time.monotonic`)."""

    asked: bool = False
    when: float = -_SAME

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, but not again while the first one is being answered."""
        del number, frame
        now = time.monotonic()
        if self.asked and now - self.when < _SAME:
            return
        self.asked, self.when = True, now
        raise KeyboardInterrupt


@contextmanager
def interrupts_noticed() -> Generator[Interrupts]:
    """Keeps account of Ctrl-C within the block, where signals can be handled (the main thread)."""
    interrupts = Interrupts()
    if threading.current_thread() is not threading.main_thread():
        yield interrupts
        return
    before = signal.signal(signal.SIGINT, interrupts)
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, before)
