"""The command line: `jaxtrapolate COMMAND`."""

import argparse
import contextlib
import errno
import io
import os
import sys
from collections.abc import Sequence

from jaxtrapolate._version import __version__
from jaxtrapolate.commands import interrupt


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    from jaxtrapolate.commands import check, demo, evaluate, generate, import_weights, methods, render, scenes, train

    top = argparse.ArgumentParser(
        prog="jaxtrapolate",
        description="Generate the frames between rendered frames, and say how good and how fast that is.",
    )
    top.add_argument("--version", action="version", version=f"jaxtrapolate {__version__}")
    top.add_argument(
        "--no-compile-cache",
        action="store_true",
        help="compile everything anew; compiled programs are kept in the user's cache folder, or in the folder that "
        "JAX_COMPILATION_CACHE_DIR names",
    )
    subparsers = top.add_subparsers(required=True, metavar="COMMAND")
    for command in (demo, check, generate, evaluate, methods, render, scenes, train, import_weights):
        command.add_parser(subparsers)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; 0, or 2 after one line on stderr about input that cannot be used, 130 after Ctrl-C."""
    options = parser().parse_args(arguments)
    from jaxtrapolate.runtime.memory import keep_memory

    keep_memory()
    if options.no_compile_cache:
        from jaxtrapolate.runtime.compiled import forget_compiled_programs

        forget_compiled_programs()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files need not be text
    try:
        # only now: an exception in the middle of importing a C++ extension may crash the process
        with interrupt.interruptible():
            return _run(options)
    except KeyboardInterrupt:
        print("jaxtrapolate: interrupted; run again to go on", file=sys.stderr)
        return 130


def _run(options: argparse.Namespace) -> int:
    from jaxtrapolate.atomic import known_os_error, os_input_error
    from jaxtrapolate.errors import InputError

    try:
        status = options.run(options) or 0
        sys.stdout.flush()
        return status
    except InputError as error:
        return _fail(error.on_command_line)
    except BrokenPipeError:
        _give_up_stdout()
        return 141
    except OSError as error:
        if not known_os_error(error):
            raise
        if error.filename is None and error.errno == errno.ENOSPC:
            _give_up_stdout()
        return _fail(str(os_input_error(error.filename or "standard output", error, action="write")))


def _fail(text: str) -> int:
    print(f"jaxtrapolate: {' '.join(text.split())}", file=sys.stderr)
    return 2


def _give_up_stdout() -> None:
    """What is still to be written goes nowhere, so that Python does not complain of it at its end."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
