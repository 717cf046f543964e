"""Files that are there in full or not at all, and operating-system errors as one clear line."""

import contextlib
import errno
import os
import re
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from jaxtrapolate.errors import InputError
from jaxtrapolate.regular import NotRegularError

Action = Literal["read", "write"]

_REMEDIES = {
    errno.ENOENT: "does not exist; check the path",
    errno.ENOTDIR: "does not exist (a folder of its path is a file); check the path",
    errno.EISDIR: "is a folder, not a file; check the path",
    errno.EACCES: "no permission to {action} it; change its permissions or choose another place",
    errno.EPERM: "no permission to {action} it; change its permissions or choose another place",
    errno.EROFS: "cannot be written, the file system is read-only; choose another place",
    errno.ENOSPC: "cannot be written, the disk is full; free some space and run again",
    errno.EDQUOT: "cannot be written, the disk quota is used up; free some space and run again",
    errno.ELOOP: "is a symbolic link that leads back to itself; correct the link",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
    errno.EMFILE: "too many open files; raise the limit (ulimit -n)",
    errno.ELOOP: "is a symbolic link that leads back to itself; give the folder that it should lead to",
    errno.EEXIST: "is there already, and is no folder; choose another place",
}


def os_input_error(path: str | os.PathLike[str], error: OSError, *, action: Action = "read") -> InputError:
    """The `InputError` that says in one line what an `OSError` on `path` means and what to do about it."""
    if isinstance(error, NotRegularError):
        return InputError(f"{path}: {error.strerror}; give a regular file")
    remedy = _REMEDIES.get(error.errno or 0, f"cannot be {'read' if action == 'read' else 'written'} ({{error}})")
    text = remedy.format(action=action, error=error.strerror or " ".join(str(error).split()))
    return InputError(f"{path}: {text}")


def known_os_error(error: OSError) -> bool:
    """Whether `os_input_error` has a remedy for it."""
    return error.errno in _REMEDIES


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """The name of an empty temporary file beside `path`, which takes its place when the block ends without an error.

    On any error in the block or in the renaming (a full disk, Ctrl-C) the temporary file is removed and what was at
    `path` before stays as it was. Only a process that is killed outright leaves a temporary file, whose name starts
    with a dot and ends in `.tmp`; it never leaves half a file at `path`. As long as the process lives it holds a lock
    on the file, by which `sweep` tells what is stale. The folder must exist.

    Raises:
        InputError: for every `OSError`, naming `path`.
    """
    path = Path(path)
    temporary = path.parent / f".{path.name}.{secrets.token_hex(4)}.tmp"
    try:
        if path.is_dir():
            raise OSError(errno.EISDIR, os.strerror(errno.EISDIR))
        descriptor = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
    except OSError as error:
        if error.errno == errno.ENOENT:
            raise InputError(f"{path}: its folder does not exist; create it first") from error
        raise os_input_error(path, error, action="write") from error
    try:
        hold(descriptor)
        yield temporary
        os.replace(temporary, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise os_input_error(path, error, action="write") from error
        raise
    finally:
        os.close(descriptor)


_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{8}\.tmp", re.DOTALL)


def sweep(folder: str | os.PathLike[str]) -> int:
    """Removes the temporary files of `atomic_path` in a folder and below it that no living process holds; how many.

    What cannot be removed, or read, is left where it is.
    """
    removed = 0
    for parent, _, names in os.walk(folder):
        for name in filter(_TEMPORARY.fullmatch, names):
            with contextlib.suppress(OSError):
                descriptor = os.open(os.path.join(parent, name), os.O_RDWR)
                try:
                    stale = hold(descriptor)
                finally:
                    os.close(descriptor)
                if stale:
                    os.unlink(os.path.join(parent, name))
                    removed += 1
    return removed


def hold(descriptor: int) -> bool:
    """Locks an open file until it is closed, or the process ends in any way; False where another open file holds it.

    True without a lock where the file system, or the system, has none.
    """
    try:
        import fcntl
    except ImportError:  # not on Windows, which does not remove a file that is open
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EWOULDBLOCK, errno.EACCES)
    return True
