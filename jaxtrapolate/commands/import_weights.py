"""`jaxtrapolate import-weights`: trained weights, or the authors' of ExtraNet, as a file of this library."""

import argparse
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx

from jaxtrapolate.atomic import os_input_error
from jaxtrapolate.commands.inputs import terminal
from jaxtrapolate.errors import InputError
from jaxtrapolate.methods import load
from jaxtrapolate.methods.extranet import extranet_config, load_extranet
from jaxtrapolate.weights import load_orbax, save_weights


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "import-weights",
        help="a PyTorch checkpoint of ExtraNet, or what `train` has written, as a file of weights",
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
    parser.add_argument("--half", action="store_true", help="kept in float16: a file half as large")
    parser.add_argument("--note", metavar="TEXT", help="a line that is kept in the file: how they were trained")
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
            method, tree, about = weights.method, weights.tree, (weights.config, weights.note)
        else:
            model, preparation = load_extranet(source)
            method, tree = "extranet", nnx.to_pure_dict(nnx.state(model))
            about = extranet_config(model.config, preparation), f"imported from {source.name}"
        if options.half:
            tree = jax.tree.map(lambda array: np.asarray(array, np.float16), tree)
        config, note = about
        path = save_weights(folder, method, tree, config=config, note=options.note or note, name=stem)
    except OSError as error:
        raise os_input_error(source, error) from error
    except ValueError as error:
        raise InputError(str(error)) from error
    terminal().print(f"{path}\nuse it with --weights {method}={path}", soft_wrap=True, highlight=False)
