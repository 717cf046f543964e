"""`jaxtrapolate import-weights`: the authors' weights of ExtraNet as a file of this library."""

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

from jaxtrapolate.files import InputError
from jaxtrapolate.files.atomic import os_input_error
from jaxtrapolate.methods.extranet import load_extranet, save_extranet


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "import-weights",
        help="a PyTorch checkpoint of ExtraNet as a file of weights",
        description="Reads the authors' checkpoint without PyTorch and without running anything in it, and writes its "
        "weights with the preparation that they need. Mind the licence of the file.",
    )
    parser.add_argument("file", metavar="FILE.pth.tar", help="the checkpoint")
    parser.add_argument(
        "--output",
        default="extranet.npz",
        metavar="FILE.npz",
        help="where to; a part of the file's hash is put into its name (extranet-1a2b3c4d.npz)",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    source, output = Path(options.file), Path(options.output)
    if output.suffix != ".npz":
        raise InputError(f"--output: expected a name that ends in .npz, got {options.output!r}")
    try:
        model, preparation = load_extranet(source)
    except OSError as error:
        raise os_input_error(source, error) from error
    except ValueError as error:
        raise InputError(str(error)) from error
    note = f"imported from {source.name}"
    path = save_extranet(output.parent, model, preparation=preparation, note=note, name=output.stem)
    Console().print(f"{path}\nuse it with --weights extranet={path}", soft_wrap=True, highlight=False)
