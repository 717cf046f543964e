"""`jaxtrapolate check`: what an input holds, how its motion vectors are stated, and which methods can run on it."""

import argparse
import dataclasses
import functools
import itertools
from collections.abc import Iterator
from typing import Any, get_args

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxtrapolate.commands.inputs import add_input, open_input, open_methods, progress, terminal
from jaxtrapolate.evaluation.score import display
from jaxtrapolate.evaluation.windows import arguments, held_back, windows
from jaxtrapolate.files import SETTINGS_NAME, MotionConvention, Sequence, gaps, prefetch, runs
from jaxtrapolate.methods import method_names
from jaxtrapolate.methods.frames import buffer
from jaxtrapolate.ops.ego_motion import camera_matrix, off_camera, static_ids
from jaxtrapolate.ops.holes import possible_masks
from jaxtrapolate.ops.jitter import shift_motion
from jaxtrapolate.ops.motion import convert_motion
from jaxtrapolate.ops.warp import backward_warp
from jaxtrapolate.records import CHANNELS, Frame, Sign, Units, YAxis

_SCANNED = 20  # frames whose buffers are read
_WATCHED = 8  # frames in which objects are compared to the camera
_PAIRS = 4  # pairs of frames that conventions are tried on
_PLATEAU = 0.01  # of a frame's pixels have its largest depth: it may stand for nothing
_ALIKE = 0.1  # dB: less is no difference


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
        found = _scan(sequence, bar)
        tried = try_conventions(sequence, bar)
    _print_summary(sequence, found, out)
    _print_buffers(found, out)
    _print_objects(sequence, found, out)
    _print_conventions(sequence, tried, out)
    _print_methods(sequence, out)


@dataclasses.dataclass
class Scan:
    """What the frames hold that were read.

    numbers: of these frames. buffers: by name, shape, range, and in how many frames. nonfinite: such pixels, by frame.
    no_depth: pixels without depth by frame, by why. ids: for each object, in which frames it moves as the camera does;
    None where that cannot be told. watched: the frames in which the camera's motion was found. farthest: the largest
    depth of frames in which many pixels have it. colors: how many of all frames have colour. jitter: of those that say.
    """

    numbers: list[int]
    buffers: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    nonfinite: dict[int, int] = dataclasses.field(default_factory=dict)
    no_depth: dict[int, dict[str, int]] = dataclasses.field(default_factory=dict)
    ids: dict[int, list[bool]] = dataclasses.field(default_factory=dict)
    watched: list[int] = dataclasses.field(default_factory=list)
    farthest: dict[float, list[int]] = dataclasses.field(default_factory=dict)
    colors: int = 0
    jitter: list[np.ndarray] = dataclasses.field(default_factory=list)


def _spaced(items: Any, most: int) -> list:
    """At most so many of a list, evenly spaced from the first to the last."""
    indices = np.unique(np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int)) if items else []
    return [items[i] for i in indices]


def _scan(sequence: Sequence, bar) -> Scan:
    """Reads evenly spaced frames."""
    scan = Scan(_spaced(sequence.numbers, _SCANNED), colors=sum(map(sequence.has_color, sequence.numbers)))
    watch = _spaced(scan.numbers, _WATCHED)
    frames = prefetch(sequence, scan.numbers)
    for number, frame in bar.track(frames, total=len(scan.numbers), description="read buffers"):
        for name in ("color", "motion", *CHANNELS):
            value = buffer(frame, name)
            if value is None:
                continue
            finite = value[np.isfinite(value)]
            low, high = (float(finite.min()), float(finite.max())) if finite.size else (np.nan, np.nan)
            entry = scan.buffers.setdefault(
                name, {"shape": value.shape, "low": low, "high": high, "frames": 0, "constant": True}
            )
            entry["constant"] &= low == high and entry["low"] == low
            entry["low"], entry["high"] = float(np.fmin(entry["low"], low)), float(np.fmax(entry["high"], high))
            entry["frames"] += 1
            if name == "depth" and np.count_nonzero(value == high) > _PLATEAU * value.size:
                scan.farthest.setdefault(high, []).append(number)
        if frame.jitter is not None:
            scan.jitter.append(np.asarray(frame.jitter))
        if bad := sequence.nonfinite(number):
            scan.nonfinite[number] = bad
        if none := sequence.no_depth(number):
            scan.no_depth[number] = none
        _watch(sequence, number, frame, scan, watched=number in watch)
    return scan


def _watch(sequence: Sequence, number: int, frame: Frame, scan: Scan, *, watched: bool) -> None:
    """Notes the objects of a frame, and which move as the camera does."""
    buffers = frame.gbuffer
    if buffers is None or buffers.stencil is None:
        return
    stencil = np.asarray(buffers.stencil)
    for found in np.unique(stencil[stencil > 0]):
        scan.ids.setdefault(int(found), [])
    if not watched or not scan.ids or frame.motion is None or buffers.depth is None or sequence.depth != "metric":
        return
    depth, motion = np.asarray(buffers.depth), np.asarray(frame.motion)
    there = np.isfinite(depth[..., 0])
    static = there & (stencil[..., 0] == 0)
    fitted = camera_matrix(depth, motion, static if static.sum() > 0.2 * there.sum() else there)
    if fitted is None:
        return
    scan.watched.append(number)
    off = np.where(there, off_camera(fitted[0], depth, motion), np.nan)
    for found, fits in static_ids(stencil, off).items():
        scan.ids[found].append(fits)


def conventions() -> Iterator[MotionConvention]:
    """Every convention of motion vectors."""
    for sign, units, y_axis in itertools.product(get_args(Sign), get_args(Units), get_args(YAxis)):
        yield MotionConvention(sign, units, y_axis)


@dataclasses.dataclass(frozen=True)
class Trial:
    """The dB of warping a frame onto the next one.

    conventions: under each convention of the stored motion, best first; infinite where every pixel is met. still: of
    the frame before, without any motion. one_number: where the numbering has a step, of vectors `step` times as long,
    under the best convention: as if they led to the frame with the number before.
    """

    conventions: list[tuple[MotionConvention, float]]
    still: float
    one_number: float | None = None


def try_conventions(sequence: Sequence, bar) -> Trial | None:
    """Warps frames onto the next ones under each convention of the stored motion; pixels that are not finite are out.

    `None` where no two neighbouring frames have colour, or there is no motion.
    """
    pairs = [(r[i], r[i + 1]) for r in runs(sequence) for i in range(len(r) - 1)]
    pairs = [pair for pair in pairs if all(map(sequence.has_color, pair))]
    errors: dict[Any, list[float]] = {c: [] for c in (*conventions(), "still", "one number")}
    best = None
    for earlier, later in bar.track(_spaced(pairs, _PAIRS), description="try conventions"):
        stored = sequence.stored_motion(later)
        newer, older = sequence.frame(later), sequence.frame(earlier)
        first, second = older.color, newer.color
        if stored is None or first is None or second is None:
            continue
        valid = np.isfinite(stored).all(-1, keepdims=True)
        for number in (earlier, later):
            invalid = sequence.invalid(number)
            valid &= True if invalid is None else ~invalid[..., None]
        if not valid.any():
            continue
        first, truth = jax.device_put(first), np.asarray(display(second, hdr=sequence.hdr))
        stored = jax.device_put(np.where(np.isfinite(stored), stored, 0).astype(np.float32))

        def error(motion, first=first, truth=truth, valid=valid, frames=(newer, older)) -> float:
            warped = np.asarray(display(backward_warp(first, shift_motion(motion, *frames)), hdr=sequence.hdr))
            return float(np.mean(np.square(warped - truth, dtype=np.float64), where=valid))

        for convention in conventions():
            errors[convention].append(error(convert_motion(stored, **dataclasses.asdict(convention))))
        errors["still"].append(error(jax.numpy.zeros_like(stored)))
        if sequence.step > 1:
            best = best or min(conventions(), key=lambda c: errors[c][0])
            motion = convert_motion(stored, **dataclasses.asdict(best))
            errors["one number"].append(error(motion * np.float32(sequence.step)))
    if not errors["still"]:
        return None
    decibels = {key: _decibels(float(np.mean(e))) for key, e in errors.items() if e}
    ordered = sorted(((c, decibels[c]) for c in conventions()), key=lambda pair: -pair[1])
    return Trial(ordered, decibels["still"], decibels.get("one number"))


def _decibels(mean_square: float) -> float:
    return -10 * float(np.log10(mean_square)) if mean_square > 0 else np.inf


def _listed(numbers: Any) -> str:
    return ", ".join(map(str, numbers))


def _print_summary(sequence: Sequence, scan: Scan, out: Console) -> None:
    height, width = sequence.size
    numbers = sequence.numbers
    kind = "HDR" if sequence.hdr else "8-bit sRGB"
    step = f", step {sequence.step}" if sequence.step > 1 else ""
    out.print(
        f"{sequence.name}: {len(numbers)} frames ({numbers[0]}-{numbers[-1]}{step}), {width}x{height}, {kind} colour, "
        f"depth {sequence.depth}",
        soft_wrap=True,
    )
    if scan.colors < len(numbers):
        out.print(f"colour: in {scan.colors} of {len(numbers)} frames", soft_wrap=True)
    for gap in gaps(sequence):
        where = f"frame {gap[0]} is" if len(gap) == 1 else f"frames {gap[0]}-{gap[-1]} are"
        out.print(f"gap: {where} missing; the history starts anew after it", soft_wrap=True)
    if len(scan.numbers) == len(numbers):
        out.print(f"read: all {len(numbers)} frames", soft_wrap=True)
    else:
        listed = _listed(scan.numbers)
        out.print(f"read: {len(scan.numbers)} of {len(numbers)} frames, evenly spaced: {listed}", soft_wrap=True)
    if scan.nonfinite:
        listed = ", ".join(f"{n} ({c})" for n, c in list(scan.nonfinite.items())[:8])
        more = f" and {len(scan.nonfinite) - 8} more" if len(scan.nonfinite) > 8 else ""
        out.print(f"non-finite pixels, treated as holes, in frames: {listed}{more}", soft_wrap=True)
    else:
        out.print("no non-finite pixels in the frames read")
    if scan.jitter:
        low, high, count = np.min(scan.jitter), np.max(scan.jitter), len(scan.jitter)
        text = f"{low:.3g} to {high:.3g} pixels, in {count} of {len(scan.numbers)} frames read"
        out.print(f"jitter: {text}", soft_wrap=True)
    _print_no_depth(sequence, scan, out)
    for note in sequence.notes:
        out.print(f"note: {note}", soft_wrap=True)


def _print_no_depth(sequence: Sequence, scan: Scan, out: Console) -> None:
    if sequence.depth == "metric" and len(scan.farthest) == 1:
        ((depth, numbers),) = scan.farthest.items()
        text = (
            f"depth: many pixels of {len(numbers)} of {len(scan.numbers)} frames read have the same largest {depth:g}"
        )
        out.print(f"{text}; if nothing was hit there, nothing_above in {SETTINGS_NAME} says so", soft_wrap=True)
    if not scan.no_depth:
        return
    causes: dict[str, int] = {}
    for counts in scan.no_depth.values():
        for why, count in counts.items():
            causes[why] = causes.get(why, 0) + count
    pixels, total = sum(causes.values()), sequence.size[0] * sequence.size[1]
    share = pixels / (total * len(scan.numbers))
    why = ", ".join(f"{count} {cause}" for cause, count in causes.items())
    where = f"{pixels} pixels ({share:.1%}) in {len(scan.no_depth)} of {len(scan.numbers)} frames read"
    out.print(f"no depth: {where}, taken for infinitely far, as the sky is: {why}", soft_wrap=True)
    if all_of := [n for n, counts in scan.no_depth.items() if sum(counts.values()) == total]:
        text = f"no depth: nowhere in frames {_listed(all_of[:8])}; distances that are stored as negative numbers need"
        out.print(f"{text} scale = -1 in {SETTINGS_NAME}", soft_wrap=True)


def _print_buffers(scan: Scan, out: Console) -> None:
    table = Table(title="buffers of the frames read")
    for column in ("buffer", "size", "range", "frames", ""):
        table.add_column(column)
    for name, entry in scan.buffers.items():
        size = "x".join(str(s) for s in (entry["shape"][1], entry["shape"][0], entry["shape"][2]))
        remark = "constant" if entry["constant"] else ""
        frames = f"{entry['frames']}/{len(scan.numbers)}"
        table.add_row(name, size, f"{entry['low']:.4g} .. {entry['high']:.4g}", frames, remark)
    out.print(table)
    absent = [n for n in ("color", "motion", *CHANNELS) if n not in scan.buffers]
    if absent:
        out.print(f"absent: {', '.join(absent)}", soft_wrap=True)
    if "motion" in scan.buffers:
        out.print(possible_masks([n for n in CHANNELS if n in scan.buffers]), soft_wrap=True)


def _print_objects(sequence: Sequence, scan: Scan, out: Console) -> None:
    """Which ids of the stencil look static, and what to write for them."""
    if not scan.ids:
        return
    count = f"objects: {len(scan.ids)} id{'s'[: len(scan.ids) != 1]} above 0 in the stencil"
    if sequence.depth != "metric" or "motion" not in scan.buffers:
        lack = "motion vectors are absent" if "motion" not in scan.buffers else f"depth is {sequence.depth}"
        out.print(f"{count}; which of them are static cannot be told, since {lack}", soft_wrap=True)
        return
    if not scan.watched:
        text = "no motion of a camera was found that fits depth and motion vectors"
        out.print(f"{count}; which of them are static cannot be told, since {text}", soft_wrap=True)
        return
    still = sorted(number for number, fits in scan.ids.items() if fits and all(fits))
    unseen = sum(not fits for fits in scan.ids.values())
    rest = f"; {unseen} cover too little to tell" if unseen else ""
    if not still:
        out.print(f"{count}; none moves as the camera does, all are dynamic{rest}", soft_wrap=True)
        return
    frames = f"frame{'s'[: len(scan.watched) != 1]} {_listed(scan.watched)}"
    stated = ", ".join(f'"{s}"' if isinstance(s, str) else str(s) for s in map(sequence.stored_id, still))
    text = f"{len(still)} of them move{'s'[: len(still) == 1]} as the camera does in {frames}{rest}"
    remedy = f"if these are static (walls have ids too), write static_ids = [{stated}] to {SETTINGS_NAME}"
    out.print(f"{count}; {text}; {remedy}", soft_wrap=True)


def _print_conventions(sequence: Sequence, trial: Trial | None, out: Console) -> None:
    if trial is None:
        out.print("motion vectors: none to try, or no two neighbouring frames with colour")
        return
    table = Table(title="a frame warped onto the next, by convention of the motion vectors")
    for column in ("sign", "units", "y axis", "dB", ""):
        table.add_column(column, justify="right" if column == "dB" else "left")
    tried = trial.conventions
    best, most = tried[0]
    in_use = dict(tried)[sequence.convention]
    equal = [c for c, decibels in tried if not most - decibels >= _ALIKE]  # infinite both: NaN
    for convention, decibels in tried:
        marks = [m for m, c in (("best", best), ("in use", sequence.convention)) if c == convention]
        row = convention.sign, convention.units, convention.y_axis, f"{decibels:.2f}", ", ".join(marks)
        table.add_row(*row)
    table.add_row("no motion", "", "", f"{trial.still:.2f}", "")
    out.print(table)
    say = functools.partial(out.print, soft_wrap=True)
    if len(equal) == len(tried):
        say("motion vectors: all conventions are alike, since hardly anything moves here; nothing can be said")
    elif not most - trial.still >= _ALIKE:
        say(
            "motion vectors: no convention is better than no motion at all, so nothing can be said; do they lead to "
            "the frame before, and are these the channels?"
        )
    elif sequence.convention in equal:
        others = [c for c in equal if c != sequence.convention]
        lead = next((most - decibels for c, decibels in tried if c not in equal), 0.0)
        text = f"motion vectors: {sequence.convention}, as in use; {lead:.2f} dB ahead of the next"
        say(text + (f"; {' and '.join(map(str, others))} cannot be told from it here" if others else ""))
    else:
        others = f" (or {' or '.join(str(c) for c in equal if c != best)}, as good here)" if len(equal) > 1 else ""
        say(
            f"motion vectors: {best} is {most - in_use:.2f} dB better than {sequence.convention}, which is in "
            f"use; run with --motion {best}{others}, or write it to {SETTINGS_NAME}"
        )
    if trial.one_number is not None and trial.one_number - max(most, trial.still) >= _ALIKE:
        step, lead = sequence.step, trial.one_number - most
        say(
            f"motion vectors: {step} times as long they are {lead:.2f} dB better: they lead to the frame with the "
            f"number before, not to the one {step} before; scale them by {step} in {SETTINGS_NAME}"
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
            longest, needed = (
                max(map(len, runs(sequence)), default=0),
                2 + (2 * method.future - 1) * bool(method.future),
            )
            table.add_row(name, "no", f"needs {needed} frames without a gap, the longest run has {longest}")
            continue
        window = next(iter(windows(sequence, numbers[:1], past=past, future=method.future)))
        given = arguments(method, window)
        remarks = [f"{stage}: {', '.join(lacks)}" for stage, lacks in method.missing(*given).items()]
        if past < method.past:
            remarks.append(f"history: {past} of {method.past} rendered frames, the runs are too short for more")
        try:
            method.active(*given)
            table.add_row(name, "yes", "; ".join(remarks))
        except ValueError as error:
            table.add_row(name, "no", str(error))
    out.print(table)
