"""The command line: `jaxtrapolate COMMAND`."""

import argparse
import sys
from collections.abc import Sequence

from jaxtrapolate import __version__
from jaxtrapolate.commands import check, demo, evaluate, generate, import_weights, render, scenes, train
from jaxtrapolate.files import InputError
from jaxtrapolate.memory import keep_memory


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    top = argparse.ArgumentParser(
        prog="jaxtrapolate",
        description="Make the frames between rendered frames, and say how good and how fast that is.",
    )
    top.add_argument("--version", action="version", version=f"jaxtrapolate {__version__}")
    subparsers = top.add_subparsers(required=True, metavar="COMMAND")
    for command in (demo, check, generate, evaluate, render, scenes, train, import_weights):
        command.add_parser(subparsers)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; 0, or 2 after one line on stderr about input that cannot be used."""
    options = parser().parse_args(arguments)
    keep_memory()
    try:
        return options.run(options) or 0
    except InputError as error:
        print(f"jaxtrapolate: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxtrapolate: interrupted; run again to go on", file=sys.stderr)
        return 130
    except BrokenPipeError:
        return 141


if __name__ == "__main__":
    sys.exit(main())
