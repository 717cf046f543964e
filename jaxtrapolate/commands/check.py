"""`jaxtrapolate check`: what an input holds, how its motion vectors are stated, and which methods can run on it."""

import argparse
import itertools
from collections.abc import Iterator
from typing import Any, get_args

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxtrapolate.commands.inputs import add_input, open_input, open_methods, progress, terminal
from jaxtrapolate.evaluation import arguments, display, held_back, windows
from jaxtrapolate.files import MotionConvention, Sequence, gaps, prefetch, runs
from jaxtrapolate.gather import backward_warp
from jaxtrapolate.methods import method_names
from jaxtrapolate.methods.method import buffer
from jaxtrapolate.metrics import psnr
from jaxtrapolate.motion import Sign, Units, YAxis, convert_motion
from jaxtrapolate.records import CHANNELS

_SCANNED = 20  # frames whose buffers are read
_PAIRS = 4  # pairs of frames that conventions are tried on


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "check",
        help="what an input holds, its motion vectors' convention, which methods can run",
        description="Reports buffers, sizes, ranges, non-finite pixels and gaps; tries every convention of the motion "
        "vectors; says which methods can run and what the others miss.",
    )
    add_input(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    sequence = open_input(options.input, motion=options.motion, strict=options.strict)
    console, out = terminal(stderr=True), terminal()
    with progress(console) as bar:
        buffers, nonfinite = _scan(sequence, bar)
        tried = try_conventions(sequence, bar)
    _print_summary(sequence, nonfinite, out)
    _print_buffers(buffers, out)
    _print_conventions(sequence, tried, out)
    _print_methods(sequence, out)


def _scan(sequence: Sequence, bar) -> tuple[dict[str, dict[str, Any]], dict[int, int]]:
    """Range and count of each buffer, and the non-finite pixels by frame, over evenly spaced frames."""
    count = min(_SCANNED, len(sequence.numbers))
    places = np.unique(np.linspace(0, len(sequence.numbers) - 1, count).round().astype(int))
    numbers = [sequence.numbers[i] for i in places]
    found: dict[str, dict[str, Any]] = {}
    nonfinite = {}
    for number, frame in bar.track(prefetch(sequence, numbers), total=len(numbers), description="read buffers"):
        for name in ("color", "motion", *CHANNELS):
            value = buffer(frame, name)
            if value is None:
                continue
            finite = value[np.isfinite(value)]
            low, high = (float(finite.min()), float(finite.max())) if finite.size else (np.nan, np.nan)
            entry = found.setdefault(
                name, {"shape": value.shape, "low": low, "high": high, "frames": 0, "constant": True}
            )
            entry["constant"] &= low == high and entry["low"] == low
            entry["low"], entry["high"] = min(entry["low"], low), max(entry["high"], high)
            entry["frames"] += 1
        if bad := sequence.nonfinite(number):
            nonfinite[number] = bad
    for entry in found.values():
        entry["of"] = len(numbers)
    return found, nonfinite


def conventions() -> Iterator[MotionConvention]:
    """Every convention of motion vectors."""
    for sign, units, y_axis in itertools.product(get_args(Sign), get_args(Units), get_args(YAxis)):
        yield MotionConvention(sign, units, y_axis)


def try_conventions(sequence: Sequence, bar) -> list[tuple[MotionConvention, float]]:
    """The dB of warping a frame onto the next one under each convention of the stored motion, best first.

    Empty where no two neighbouring frames have colour, or there is no motion.
    """
    pairs = [(r[i], r[i + 1]) for r in runs(sequence) for i in range(len(r) - 1)]
    places = np.unique(np.linspace(0, len(pairs) - 1, min(_PAIRS, len(pairs))).round().astype(int)) if pairs else []
    mean_square: dict[MotionConvention, list[float]] = {c: [] for c in conventions()}
    for earlier, later in bar.track([pairs[i] for i in places], description="try conventions"):
        stored = sequence.stored_motion(later)
        first, second = sequence.frame(earlier).color, sequence.frame(later).color
        if stored is None or first is None or second is None:
            continue
        first, stored = jax.device_put(first), jax.device_put(np.asarray(stored, np.float32))
        truth = display(second, hdr=sequence.hdr)
        for convention, errors in mean_square.items():
            motion = convert_motion(stored, sign=convention.sign, units=convention.units, y_axis=convention.y_axis)
            errors.append(float(psnr(display(backward_warp(first, motion), hdr=sequence.hdr), truth)))
    scored = [(c, float(np.mean(e))) for c, e in mean_square.items() if e]
    return sorted(scored, key=lambda pair: -pair[1])


def _print_summary(sequence: Sequence, nonfinite: dict[int, int], out: Console) -> None:
    height, width = sequence.size
    numbers = sequence.numbers
    kind = "HDR" if sequence.hdr else "8-bit sRGB"
    out.print(
        f"{sequence.name}: {len(numbers)} frames ({numbers[0]}-{numbers[-1]}), {width}x{height}, {kind} colour, "
        f"depth {sequence.depth}",
        soft_wrap=True,
    )
    for gap in gaps(sequence):
        where = f"{gap[0]}" if len(gap) == 1 else f"{gap[0]}-{gap[-1]}"
        out.print(f"gap: frame {where} is missing; the history starts anew after it", soft_wrap=True)
    if nonfinite:
        listed = ", ".join(f"{n} ({c})" for n, c in list(nonfinite.items())[:8])
        out.print(f"non-finite pixels, treated as holes, in frames: {listed}", soft_wrap=True)
    else:
        out.print("no non-finite pixels in the frames read")
    for note in sequence.notes:
        out.print(f"note: {note}", soft_wrap=True)


def _print_buffers(buffers: dict[str, dict[str, Any]], out: Console) -> None:
    table = Table(title="buffers")
    for column in ("buffer", "size", "range", "frames", ""):
        table.add_column(column)
    for name, entry in buffers.items():
        size = "x".join(str(s) for s in (entry["shape"][1], entry["shape"][0], entry["shape"][2]))
        remark = "constant" if entry["constant"] else ""
        table.add_row(
            name, size, f"{entry['low']:.4g} .. {entry['high']:.4g}", f"{entry['frames']}/{entry['of']}", remark
        )
    out.print(table)
    absent = [n for n in ("color", "motion", *CHANNELS) if n not in buffers]
    if absent:
        out.print(f"absent: {', '.join(absent)}", soft_wrap=True)


def _print_conventions(sequence: Sequence, tried: list[tuple[MotionConvention, float]], out: Console) -> None:
    if not tried:
        out.print("motion vectors: none to try, or no two neighbouring frames with colour")
        return
    table = Table(title="a frame warped onto the next, by convention of the motion vectors")
    for column in ("sign", "units", "y axis", "dB", ""):
        table.add_column(column, justify="right" if column == "dB" else "left")
    best = tried[0][0]
    for convention, decibels in tried:
        marks = [m for m, c in (("best", best), ("in use", sequence.convention)) if c == convention]
        row = convention.sign, convention.units, convention.y_axis, f"{decibels:.2f}", ", ".join(marks)
        table.add_row(*row)
    out.print(table)
    lead = tried[0][1] - tried[1][1]
    if tried[0][1] - tried[-1][1] < 0.1:
        out.print("motion vectors: all conventions are alike, since hardly anything moves here; nothing can be said")
    elif best == sequence.convention:
        out.print(f"motion vectors: {best}, as in use; {lead:.2f} dB ahead of the next")
    else:
        in_use = dict(tried)[sequence.convention]
        out.print(
            f"motion vectors: {best} is {tried[0][1] - in_use:.2f} dB better than {sequence.convention}, which is in "
            f"use; run with --motion {best}, or write it to jaxtrapolate.toml",
            soft_wrap=True,
        )


def _print_methods(sequence: Sequence, out: Console) -> None:
    table = Table(title="methods")
    for column in ("method", "runs", "left out or missing"):
        table.add_column(column)
    methods, unavailable = open_methods(method_names())
    for name in method_names():
        if name in unavailable:
            table.add_row(name, "no", unavailable[name])
            continue
        method = methods[name]
        tries = [(p, held_back(sequence, past=p, future=method.future)) for p in range(method.past, 0, -1)]
        past, numbers = next(((p, n) for p, n in tries if n), (0, []))
        if not numbers:
            table.add_row(name, "no", f"{len(sequence.numbers)} frames in a row are too few")
            continue
        window = next(iter(windows(sequence, numbers[:1], past=past, future=method.future)))
        given = arguments(method, window)
        missing = "; ".join(f"{stage}: {', '.join(lacks)}" for stage, lacks in method.missing(*given).items())
        try:
            method.active(*given)
            table.add_row(name, "yes", missing)
        except ValueError as error:
            table.add_row(name, "no", str(error))
    out.print(table)
