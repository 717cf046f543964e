"""`jaxtrapolate import-weights`: trained weights, or the authors' of ExtraNet, as a file of this library."""

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

from jaxtrapolate.files import InputError
from jaxtrapolate.files.atomic import os_input_error
from jaxtrapolate.methods import load
from jaxtrapolate.methods.extranet import load_extranet, save_extranet
from jaxtrapolate.weights import load_orbax, save_weights


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "import-weights",
        help="a PyTorch checkpoint of ExtraNet, or what `train` has made, as a file of weights",
        description="Reads the authors' checkpoint of ExtraNet without PyTorch and without running anything in it, or "
        "the model that `jaxtrapolate train` left in its workdir, and writes its weights with all that the method is "
        "built with. Mind the licence of the file.",
    )
    parser.add_argument("source", metavar="SOURCE", help="FILE.pth.tar, or WORKDIR/model")
    parser.add_argument(
        "--output",
        metavar="FILE.npz",
        help="where to, by default the method's name; a part of the file's hash is put into it (extranet-1a2b3c4d.npz)",
    )
    parser.add_argument("--note", metavar="TEXT", help="a line that is kept in the file: how they were made")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    source = Path(options.source)
    output = None if options.output is None else Path(options.output)
    if output is not None and output.suffix != ".npz":
        raise InputError(f"--output: expected a name that ends in .npz, got {options.output!r}")
    folder, stem = (Path(), None) if output is None else (output.parent, output.stem)
    try:
        if source.is_dir():
            weights = load_orbax(source)
            if weights.method is None:
                raise InputError(f"{source}: does not say of which method these weights are")
            load(weights.method, weights=source)  # it fits
            note = options.note or weights.note
            path = save_weights(folder, weights.method, weights.tree, config=weights.config, note=note, name=stem)
            method = weights.method
        else:
            model, preparation = load_extranet(source)
            note = options.note or f"imported from {source.name}"
            path = save_extranet(folder, model, preparation=preparation, note=note, name=stem)
            method = "extranet"
    except OSError as error:
        raise os_input_error(source, error) from error
    except ValueError as error:
        raise InputError(str(error)) from error
    Console().print(f"{path}\nuse it with --weights {method}={path}", soft_wrap=True, highlight=False)
