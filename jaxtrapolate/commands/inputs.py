"""What the commands have in common: inputs, methods, output folders, progress."""

import argparse
import os
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from jaxtrapolate.files import InputError, Sequence, open_sequence
from jaxtrapolate.files.atomic import os_input_error
from jaxtrapolate.methods import Method, load, method_names

SCENES = "scenes:"


def add_input(parser: argparse.ArgumentParser) -> None:
    """The arguments that name an input."""
    parser.add_argument("input", metavar="INPUT", help="a folder of frames, or scenes:NAME for an embedded scene")
    parser.add_argument(
        "--motion",
        metavar="CONVENTION",
        help="how the motion vectors are stated: current_minus_previous or previous_minus_current, pixels, uv or ndc, "
        "down or up (y), separated by commas; `jaxtrapolate check` finds it out",
    )
    parser.add_argument("--strict", action="store_true", help="refuse non-finite pixels and gaps in the numbering")


def open_input(text: str, *, motion: str | None = None, strict: bool = False) -> Sequence:
    """The sequence that an INPUT argument names."""
    if not text.startswith(SCENES):
        return open_sequence(text, motion=motion, strict=strict)
    from jaxtrapolate.scenes import SceneSequence, scene_names

    name = text.removeprefix(SCENES)
    if name not in scene_names():
        raise InputError(f"{text}: no such scene; the embedded ones are {', '.join(scene_names())}")
    return SceneSequence(name)


def open_methods(names: str, *, option: str = "--methods") -> dict[str, Method]:
    """The methods of a comma-separated list; `option` is where it was given."""
    methods = {}
    for name in filter(None, (n.strip() for n in names.split(","))):
        if name not in method_names():
            raise InputError(f"{option}: no method {name!r}; there are {', '.join(method_names())}")
        methods[name] = load(name)
    if not methods:
        raise InputError(f"{option}: expected names separated by commas, of {', '.join(method_names())}")
    return methods


def output_folder(text: str) -> Path:
    """An output folder, made if need be, that can be written to."""
    folder = Path(text)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise os_input_error(folder, error, action="write") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: no permission to write there; change its permissions or choose another place")
    return folder


def progress(console: Console) -> Progress:
    """A progress bar on stderr, gone when it is done; none where stderr is no terminal."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
