"""Ctrl-C: ends a command soon, wherever it strikes, with one line and exit status 130.

An interrupt is an exception in whatever the main thread does. In a callback of the garbage collector (JAX registers
one), or in a finaliser, Python prints such an exception and goes on; while XLA compiles, it waits. So a thread watches:
what was swallowed is raised again at once, and a process that has not ended after some seconds is ended. Files appear
in full or not at all, so that nothing is lost by that.
"""

import _thread
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import Any

from jaxtrapolate.commands.script import end

_PATIENCE = 5.0  # seconds from Ctrl-C to the end of the process
_EACH = 0.05  # seconds between looks


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Within it, Ctrl-C raises `KeyboardInterrupt` in the main thread until that leaves, or else ends the process.

    Nothing is changed in another than the main thread, or where the process ignores interrupts.
    """
    main = threading.current_thread() is threading.main_thread()
    previous = signal.getsignal(signal.SIGINT)
    if not main or previous not in (signal.default_int_handler, end):
        yield
        return
    over, swallowed = threading.Event(), threading.Event()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def raise_once_more(number: int, frame: FrameType | None) -> None:
        if not over.is_set():
            raise KeyboardInterrupt

    def unraisable(what: Any) -> None:
        if what.exc_type is not None and issubclass(what.exc_type, KeyboardInterrupt):
            swallowed.set()
        else:
            sys.__unraisablehook__(what)

    def watch() -> None:
        if os.read(reading, 1) == b"":
            return
        begun = time.monotonic()
        while not over.wait(_EACH):
            if swallowed.is_set():
                swallowed.clear()
                _thread.interrupt_main()
            if time.monotonic() - begun > _PATIENCE:
                end()

    previous_hook, sys.unraisablehook = sys.unraisablehook, unraisable
    previous_descriptor = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, raise_once_more)
    threading.Thread(target=watch, name="jaxtrapolate-interrupt", daemon=True).start()
    try:
        yield
    finally:
        over.set()
        signal.set_wakeup_fd(previous_descriptor)
        signal.signal(signal.SIGINT, previous)
        sys.unraisablehook = previous_hook
        os.close(writing)  # ends the thread
