"""The terminal while OpenEXR decodes: what the library prints about a bad file stays away from it.

OpenEXR says what is wrong with a file in two ways besides its exception: in C, to the stream `stderr`, and in Python,
to `sys.stdout`. Other threads draw a progress bar meanwhile, since decoding releases the interpreter. So no file
descriptor is redirected. The C stream is exchanged for one to the null device, which nothing written in Python
goes through; and of `sys.stdout` only what the decoding thread itself writes is left out.
"""

import contextlib
import ctypes
import functools
import os
import sys
import threading
from collections.abc import Iterator
from typing import Any

_lock = threading.Lock()
_inside = 0
_saved: tuple[Any, Any] | None = None
_muted = threading.local()


class _Output:
    """`sys.stdout` for all threads but those that are muted."""

    def __init__(self, stream: Any):
        self.stream = stream

    def write(self, text: str) -> int:
        return len(text) if getattr(_muted, "depth", 0) else self.stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


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
    """Within the block, C code prints nothing to its `stderr`, and this thread nothing to `sys.stdout`."""
    _enter()
    _muted.depth = getattr(_muted, "depth", 0) + 1
    try:
        yield
    finally:
        _muted.depth -= 1
        _leave()


def _enter() -> None:
    global _inside, _saved
    with _lock:
        _inside += 1
        if _inside == 1:
            output = _Output(sys.stdout)
            streams = _streams()
            _saved = (output, None if streams is None else streams[0].value)
            sys.stdout = output
            if streams is not None:
                streams[0].value = streams[1]


def _leave() -> None:
    global _inside, _saved
    with _lock:
        _inside -= 1
        if _inside == 0 and _saved is not None:
            output, pointer = _saved
            if sys.stdout is output:  # else somebody has set another one meanwhile
                sys.stdout = output.stream
            if pointer is not None and (streams := _streams()) is not None:
                streams[0].value = pointer
            _saved = None
