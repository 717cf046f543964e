"""`jaxtrapolate generate`: make the frames between the rendered ones."""

import argparse
import dataclasses
import itertools
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtrapolate._version import __version__
from jaxtrapolate.commands.inputs import (
    add_fresh,
    add_input,
    add_weights,
    open_input,
    open_methods,
    progress,
    terminal,
)
from jaxtrapolate.errors import InputError
from jaxtrapolate.files import Sequence, runs, write_frame
from jaxtrapolate.files.reader import stored_size
from jaxtrapolate.methods import BEST_FIRST, method_names
from jaxtrapolate.methods.method import Frames, Method, neighbours, rendered
from jaxtrapolate.ops.forecast import forecast
from jaxtrapolate.records import Frame, replace
from jaxtrapolate.runtime.output import open_output, write_json
from jaxtrapolate.weights import fingerprint


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "generate",
        help="make the frames between the rendered ones",
        description="A frame that has buffers but no colour is made. Where all have colour, FACTOR - 1 frames are put "
        "after each: between it and the next by methods that interpolate, else by its motion carried on.",
    )
    add_input(parser)
    parser.add_argument(
        "--method", metavar="M", help=f"of {', '.join(method_names())} (the best that can run: {', '.join(BEST_FIRST)})"
    )
    add_weights(parser)
    parser.add_argument("--output", required=True, metavar="DIR", help="for the frames: EXR for HDR input, else PNG")
    parser.add_argument("--factor", type=int, default=2, metavar="N", help="frame rate out over frame rate in (2)")
    add_fresh(parser)
    parser.set_defaults(run=run)


@dataclasses.dataclass(frozen=True)
class Job:
    """A frame to be made.

    Attributes:
        name: of its file, without the ending.
        numbers: of the frames of the input that it is made from.
        given: history, target and future for the method, or why it cannot have them.
    """

    name: str
    numbers: tuple[int, ...]
    given: Callable[[], tuple[Frames, Frame, Frames] | str]


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    console = terminal(stderr=True)
    if options.factor < 2 or options.factor > 1000:
        raise InputError(f"--factor: expected 2 to 1000, got {options.factor}")
    sequence = open_input(options.input, motion=options.motion, strict=options.strict)
    if options.method is None:
        method, jobs, how = _best(sequence, options.factor, options.weights)
    else:
        method = _one(*open_methods(options.method, option="--method", weights=options.weights))
        jobs, how = _jobs(sequence, method, options.factor)
    all_rendered = all(map(sequence.has_color, sequence.numbers))
    settings = {
        **sequence.identity(),
        "method": method.name,
        "weights": fingerprint(method.weights) if jax.tree.leaves(method.weights) else None,
        "factor": options.factor if all_rendered else None,
    }
    with open_output(options.output, "generate", settings, fresh=options.fresh) as output:
        suffix = ".exr" if sequence.hdr else ".png"
        made, kept, reasons = 0, 0, dict[str, int]()
        with progress(console) as bar:
            hashing = bar.add_task("read input", total=None)
            output.agree_frames(
                sequence,
                sorted({n for job in jobs for n in job.numbers}),
                step=lambda text, done, total: bar.update(hashing, completed=done, total=total),
            )
            bar.remove_task(hashing)
            for job in bar.track(jobs, description="generate"):
                path = output.folder / f"{job.name}{suffix}"
                if _whole(path, sequence.size, method.scale):
                    kept += 1
                    continue
                given = job.given()
                if isinstance(given, str):
                    reasons[given] = reasons.get(given, 0) + 1
                    continue
                write_frame(path, np.asarray(method(*given)), sequence.hdr)
                made += 1
        if not made + kept:
            causes = "; ".join(f"{count}: {reason}" for reason, count in reasons.items())
            raise InputError(f"{sequence.name}: no frame can be made with {method.name} ({causes or 'too few frames'})")
        summary = {
            "version": __version__,
            "input": sequence.name,
            "method": method.name,
            "frames": len(jobs),
            "made": made,
            "kept from an earlier run": kept,
            "left out": reasons,
            "how": how,
            "notes": list(sequence.notes),
        }
        write_json(output.folder / "generate.json", summary)
    text = f"{made} frames made with {method.name}, {how}; in {output.folder}"
    text += f"; {kept} were there already" if kept else ""
    text += "".join(f"; {count} left out: {reason}" for reason, count in reasons.items())
    console.print(text, soft_wrap=True, highlight=False)
    for note in sequence.notes:
        console.print(f"note: {note}", soft_wrap=True, highlight=False)


def _jobs(sequence: Sequence, method: Method, factor: int) -> tuple[list[Job], str]:
    """What is to be made with a method, and how that is called."""
    missing = [n for n in sequence.numbers if not sequence.has_color(n)]
    if missing:
        return list(_missing(sequence, method, missing)), "from the buffers drawn for them"
    if method.kind == "interpolation":
        return list(_between(sequence, method, factor)), "between each two rendered frames"
    how = "after each rendered frame, by its motion carried on: no buffers were drawn for them"
    return list(_onward(sequence, method, factor)), how


def _best(sequence: Sequence, factor: int, weights: list[str]) -> tuple[Method, list[Job], str]:
    """The first of `BEST_FIRST` that can make the frame in the middle, and what is to be made with it."""
    reasons = []
    for name in BEST_FIRST:
        own = [w for w in weights if w.startswith(f"{name}=")]
        methods, unavailable = open_methods(name, option="--method", weights=own)
        for method in methods.values():
            jobs, how = _jobs(sequence, method, factor)
            try:
                given = jobs[len(jobs) // 2].given() if jobs else "too few frames"
            except InputError as error:
                given = str(error)
            if not isinstance(given, str):
                return method, jobs, how
            reasons.append(f"{name}: {given}")
        reasons += [f"{name}: {reason}" for reason in unavailable.values()]
    raise InputError(f"{sequence.name}: no method can run: {'; '.join(reasons)}")


def _whole(path: Path, size: tuple[int, int], scale: int) -> bool:
    """Whether a frame's file is there, in full and of the right size."""
    if not path.is_file():
        return False
    try:
        return stored_size(path) == (size[0] * scale, size[1] * scale)
    except InputError:
        return False


def _one(methods: dict[str, Method], unavailable: dict[str, str]) -> Method:
    if len(methods) + len(unavailable) != 1:
        raise InputError(f"--method: expected one name, got {', '.join((*methods, *unavailable))}")
    for reason in unavailable.values():
        raise InputError(reason)
    return next(iter(methods.values()))


NO_HISTORY = "too little history: rendered frames before them, without a gap"
NO_FUTURE = "no rendered frame follows them without a gap"


def _run_of(sequence: Sequence, number: int) -> range:
    """The frames without a gap that a frame belongs to."""
    return next(r for r in runs(sequence) if number in r)


def _around(sequence: Sequence, number: int, past: int, future: int = 0) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The frames before and after a frame that `neighbours` says, within its run."""
    run = _run_of(sequence, number)
    colored = [sequence.has_color(n) for n in run]
    before, behind = neighbours(colored, run.index(number), past=past, future=future)
    return tuple(run[i] for i in before), tuple(run[i] for i in behind)


def _with_older(sequence: Sequence, number: int, past: int) -> tuple[int, ...]:
    """A rendered frame, and those before it, up to `past` rendered ones in all."""
    return (*_around(sequence, number, past - 1)[0], number) if past > 1 else (number,)


def _frames(sequence: Sequence, numbers: tuple[int, ...]) -> Frames:
    return tuple(sequence.frame(n) for n in numbers)


def _usable(method: Method, history: Frames, target: Frame, future: Frames = ()) -> tuple[Frames, Frame, Frames] | str:
    """History, target and future, or why the method cannot start yet; raises where it never can."""
    if not rendered(history):
        return NO_HISTORY
    try:
        method.active(history, target, future)
    except ValueError as error:
        if "rendered frames in history" in str(error):
            return NO_HISTORY
        raise InputError(str(error)) from None
    return history, target, future


def _missing(sequence: Sequence, method: Method, numbers: list[int]) -> Iterator[Job]:
    """The frames that have buffers but no colour."""
    for number in numbers:
        before, behind = _around(sequence, number, method.past, method.future)

        def given(number=number, before=before, behind=behind):
            if method.future and not behind:
                return NO_FUTURE
            frames = _frames(sequence, before), sequence.frame(number), _frames(sequence, behind)
            return _usable(method, *frames)

        yield Job(f"{number:04d}", (*before, number, *behind), given)


def _between(sequence: Sequence, method: Method, factor: int) -> Iterator[Job]:
    """factor - 1 frames between each two."""
    for run in runs(sequence):
        for number, following in itertools.pairwise(run):
            before = _with_older(sequence, number, method.past)
            for k in range(1, factor):

                def given(before=before, number=number, following=following, k=k):
                    target = Frame(time=number + (following - number) * k / factor)
                    later = replace(sequence.frame(following), time=float(following))
                    history = tuple(replace(sequence.frame(n), time=float(n)) for n in before)
                    return _usable(method, history, target, (later,))

                yield Job(_name(number, k, factor), (*before, following), given)


def _onward(sequence: Sequence, method: Method, factor: int) -> Iterator[Job]:
    """factor - 1 frames after each, as if its motion went on."""
    for number in sequence.numbers:
        before = _with_older(sequence, number, method.past)
        for k in range(1, factor):

            def given(before=before, number=number, k=k):
                *older, newest = _frames(sequence, before)
                if newest.motion is None:
                    raise InputError(f"{sequence.name}: frame {number} has no motion vectors to carry on")
                return _usable(method, (*older, newest), jax.device_get(forecast(newest, k / factor)))

            yield Job(_name(number, k, factor), before, given)


def _name(number: int, k: int, factor: int) -> str:
    """Frame number and fraction: 0012.5, 0012.333."""
    fraction = f"{float(Fraction(k, factor)):.3f}".rstrip("0")[2:]
    return f"{number:04d}.{fraction}"
