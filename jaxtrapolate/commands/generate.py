"""`jaxtrapolate generate`: make the frames between the rendered ones."""

import argparse
import json
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import jax
import numpy as np

from jaxtrapolate import __version__
from jaxtrapolate.commands.inputs import (
    add_input,
    add_weights,
    open_input,
    open_methods,
    output_folder,
    progress,
    terminal,
)
from jaxtrapolate.files import InputError, Sequence, runs, write_frame
from jaxtrapolate.files.atomic import atomic_path
from jaxtrapolate.forecast import forecast
from jaxtrapolate.methods.method import Frames, Method, rendered
from jaxtrapolate.records import Frame, replace


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "generate",
        help="make the frames between the rendered ones",
        description="A frame that has buffers but no colour is made. Where all have colour, FACTOR - 1 frames are put "
        "after each: between it and the next by methods that interpolate, else by its motion carried on.",
    )
    add_input(parser)
    parser.add_argument("--method", required=True, metavar="M", help="name of a method")
    add_weights(parser)
    parser.add_argument("--output", required=True, metavar="DIR", help="for the frames: EXR for HDR input, else PNG")
    parser.add_argument("--factor", type=int, default=2, metavar="N", help="frame rate out over frame rate in (2)")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    console = terminal(stderr=True)
    if options.factor < 2:
        raise InputError(f"--factor: expected 2 or more, got {options.factor}")
    method = _one(*open_methods(options.method, option="--method", weights=options.weights))
    sequence = open_input(options.input, motion=options.motion, strict=options.strict)
    folder = output_folder(options.output)
    missing = [n for n in sequence.numbers if not sequence.has_color(n)]
    if missing:
        jobs, count, how = list(_missing(sequence, method, missing)), len(missing), "from the buffers drawn for them"
    elif method.kind == "interpolation":
        steps = sum(len(r) - 1 for r in runs(sequence))
        jobs, count = _between(sequence, method, options.factor), steps * (options.factor - 1)
        how = "between each two rendered frames"
    else:
        jobs, count = _onward(sequence, method, options.factor), len(sequence.numbers) * (options.factor - 1)
        how = "after each rendered frame, by its motion carried on: no buffers were drawn for them"
    made, kept, skipped = 0, 0, 0
    suffix = ".exr" if sequence.hdr else ".png"
    with progress(console) as bar:
        for name, given in bar.track(jobs, total=count, description="generate"):
            path = folder / f"{name}{suffix}"
            if path.exists():
                kept += 1
                continue
            frames = given()
            if frames is None:
                skipped += 1
                continue
            write_frame(path, np.asarray(method(*frames)), sequence.hdr)
            made += 1
    summary = {
        "version": __version__,
        "input": sequence.name,
        "method": method.name,
        "frames": count,
        "made": made,
        "kept from an earlier run": kept,
        "without history": skipped,
        "how": how,
    }
    with atomic_path(folder / "generate.json") as temporary:
        temporary.write_text(json.dumps(summary, indent=1))
    text = f"{made} frames made with {method.name}, {how}; in {folder}"
    text += f"; {kept} were there already" if kept else ""
    text += f"; {skipped} left out, with too little history" if skipped else ""
    console.print(text, soft_wrap=True, highlight=False)


def _one(methods: dict[str, Method], unavailable: dict[str, str]) -> Method:
    if len(methods) + len(unavailable) != 1:
        raise InputError(f"--method: expected one name, got {', '.join((*methods, *unavailable))}")
    for reason in unavailable.values():
        raise InputError(reason)
    return next(iter(methods.values()))


def _history(sequence: Sequence, number: int, method: Method) -> Frames:
    """The frames before `number` without a gap, back to as many rendered ones as the method wants."""
    (run,) = (r for r in runs(sequence) if number in r)
    frames: list[Frame] = []
    for i in range(number - 1, run[0] - 1, -1):
        frames.insert(0, sequence.frame(i))
        if len(rendered(frames)) == method.past:
            break
    while frames and frames[0].color is None:
        frames.pop(0)
    return tuple(frames)


def _usable(method: Method, history: Frames, target: Frame, future: Frames = ()):
    """History, target and future, `None` where the method cannot start yet; raises where it never can."""
    if not rendered(history):
        return None
    try:
        method.active(history, target, future)
    except ValueError as error:
        if "rendered frames in history" in str(error):
            return None
        raise InputError(str(error)) from None
    return history, target, future


def _missing(sequence: Sequence, method: Method, numbers: list[int]) -> Iterator[tuple[str, Any]]:
    """The frames that have buffers but no colour."""
    for number in numbers:

        def given(number=number):
            future: Frames = ()
            if method.future:
                later = [n for n in sequence.numbers if n > number and sequence.has_color(n)]
                future = tuple(sequence.frame(n) for n in later[: method.future])
            return _usable(method, _history(sequence, number, method), sequence.frame(number), future)

        yield f"{number:04d}", given


def _between(sequence: Sequence, method: Method, factor: int) -> Iterator[tuple[str, Any]]:
    """factor - 1 frames between each two."""
    for run in runs(sequence):
        for number in run[:-1]:
            for k in range(1, factor):

                def given(number=number, k=k):
                    following = sequence.frame(number + 1)
                    target = Frame(time=number + k / factor)
                    history = (*_history(sequence, number, method), replace(sequence.frame(number), time=float(number)))
                    future = (replace(following, time=float(number + 1)),)
                    return _usable(method, history[-max(1, 2 * method.past - 1) :], target, future)

                yield _name(number, k, factor), given


def _onward(sequence: Sequence, method: Method, factor: int) -> Iterator[tuple[str, Any]]:
    """factor - 1 frames after each, as if its motion went on."""
    for number in sequence.numbers:
        for k in range(1, factor):

            def given(number=number, k=k):
                newest = sequence.frame(number)
                if newest.motion is None:
                    raise InputError(f"{sequence.name}: frame {number} has no motion vectors to carry on")
                history = (*_history(sequence, number, method), newest)
                while len(rendered(history)) > method.past:
                    history = history[1:]
                return _usable(method, history, jax.device_get(forecast(newest, k / factor)))

            yield _name(number, k, factor), given


def _name(number: int, k: int, factor: int) -> str:
    """Frame number and fraction: 0012.5, 0012.333."""
    fraction = f"{float(Fraction(k, factor)):.3f}".rstrip("0")[2:]
    return f"{number:04d}.{fraction}"
