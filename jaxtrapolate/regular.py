"""Opening files to read: regular files alone, so that a named pipe or a device cannot stop a reader."""

import errno
import os
import stat
from typing import BinaryIO

_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)
_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)


class NotRegularError(OSError):
    """What was to be opened is a pipe, a device or a socket; `strerror` says which."""


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """A regular file, opened for reading bytes; links are followed.

    Every reader of the library opens files by this. A pipe would wait for its writer, `/dev/zero` never ends, and
    to open some devices is to do something; so they are told by their kind before they are opened, and again after.

    Raises:
        NotRegularError: a pipe, a device or a socket.
        OSError: any other reason (a folder is `IsADirectoryError`); `jaxtrapolate.atomic.os_input_error` makes a
            line of it.
    """
    try:
        _check(os.stat(path).st_mode)
        descriptor = os.open(path, _FLAGS)
    except ValueError as error:  # a null character
        raise FileNotFoundError(errno.ENOENT, str(error)) from error
    try:
        _check(os.fstat(descriptor).st_mode)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def _check(mode: int) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(mode):
        kind = next((words for test, words in _KINDS if test(mode)), "a special file")
        raise NotRegularError(0, f"is {kind}, not a regular file")
