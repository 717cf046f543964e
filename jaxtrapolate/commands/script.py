"""The program `jaxtrapolate`: `jaxtrapolate.commands.main` in a process of its own.

From its first line on Ctrl-C ends it with one line and status 130, also while the rest is being imported.
"""

import contextlib
import os
import signal
import sys


def end(*_: object) -> None:
    """Ends the process at once, with the line and the status of an interrupt."""
    cursor = b"\x1b[?25h\r\x1b[K" if os.isatty(2) else b""  # a progress bar hides it
    try:
        os.write(2, cursor + b"jaxtrapolate: interrupted; run again to go on\n")
    finally:
        os._exit(130)


def script() -> int:
    """Runs the command that the process's arguments ask for; its exit status."""
    signal.signal(signal.SIGINT, end)
    from jaxtrapolate.runtime.compiled import keep_compiled_programs

    keep_compiled_programs()
    from jaxtrapolate.commands.main import main

    status = main()
    if status == 130:  # at once: threads that still write complain where Python takes itself down beneath them
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()
        os._exit(status)
    return status


if __name__ == "__main__":
    sys.exit(script())
