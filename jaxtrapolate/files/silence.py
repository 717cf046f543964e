"""The terminal while a library decodes: what it prints about a bad file stays away from it.

OpenEXR says what is wrong with a file in two ways besides its exception: in C, to the stream `stderr`, and in Python,
to `sys.stdout`; libtiff does so in C, tifffile and Pillow to loggers. Other threads draw a progress bar meanwhile,
since decoding releases the interpreter. So no file descriptor is redirected. The C stream is exchanged for one to the
null device, which nothing written in Python goes through; and of `sys.stdout` and of the loggers only what the
decoding thread itself writes is left out.
"""

import contextlib
import ctypes
import functools
import logging
import os
import sys
import threading
from collections.abc import Iterator
from typing import Any

_lock = threading.Lock()
_inside = 0
_pointer: int | None = None
_muted = threading.local()


class _Output:
    """`sys.stdout` for all threads but those that are muted.

    There is one for ever: CPython's `print` holds no reference to the stream that it has looked up, so that one that
    goes away while another thread prints to it ends the process.
    """

    stream: Any = None

    def write(self, text: str) -> int:
        return len(text) if getattr(_muted, "depth", 0) else self.stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


_output = _Output()
_LOGGERS = ("tifffile", "PIL.TiffImagePlugin", "PIL.PngImagePlugin")


class _Filter(logging.Filter):
    """Lets pass what other threads log."""

    def filter(self, record: logging.LogRecord) -> bool:
        return not getattr(_muted, "depth", 0)


@functools.cache
def _filter_loggers() -> None:
    for name in _LOGGERS:
        logging.getLogger(name).addFilter(_Filter())


@functools.cache
def _streams() -> tuple[Any, int] | None:
    """The C variable `stderr` and a stream to the null device; `None` where the system has no such variable."""
    for name in ("stderr", "__stderrp"):
        try:
            process = ctypes.CDLL(None)
            variable = ctypes.c_void_p.in_dll(process, name)
            process.fopen.restype = ctypes.c_void_p
            process.fopen.argtypes = [ctypes.c_char_p, ctypes.c_char_p]
            null = process.fopen(os.devnull.encode(), b"w")
        except (OSError, TypeError, ValueError, AttributeError):
            continue
        if null and variable.value:
            return variable, null
    return None


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Within the block C code prints nothing to its `stderr`, this thread nothing to `sys.stdout` and the loggers."""
    _filter_loggers()
    _enter()
    _muted.depth = getattr(_muted, "depth", 0) + 1
    try:
        yield
    finally:
        _muted.depth -= 1
        _leave()


def _enter() -> None:
    global _inside, _pointer
    with _lock:
        _inside += 1
        if _inside == 1:
            _output.stream, sys.stdout = sys.stdout, _output
            if (streams := _streams()) is not None:
                variable, null = streams
                _pointer, variable.value = variable.value, null


def _leave() -> None:
    global _inside
    with _lock:
        _inside -= 1
        if _inside == 0:
            if sys.stdout is _output:  # else somebody has set another one meanwhile
                sys.stdout = _output.stream
            if (streams := _streams()) is not None:
                streams[0].value = _pointer
