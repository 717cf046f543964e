"""`jaxtrapolate evaluate`: how good and how fast methods are on an input, or on many."""

import argparse
import os
import sys
import time
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtrapolate import __version__
from jaxtrapolate.checks import check_present
from jaxtrapolate.commands.inputs import (
    Step,
    add_input,
    add_weights,
    named_inputs,
    open_methods,
    open_metrics,
    output_folder,
    steps,
    terminal,
)
from jaxtrapolate.commands.kept import Kept, read_json, write_json
from jaxtrapolate.commands.many import evaluate_many
from jaxtrapolate.commands.pictures import write_pictures
from jaxtrapolate.commands.tables import decibels, print_table
from jaxtrapolate.commands.video import Video
from jaxtrapolate.evaluation import (
    DEFAULT_METRICS,
    Window,
    arguments,
    causes_of,
    display,
    held_back,
    mean_over_frames,
    score,
    time_stages,
    windows,
)
from jaxtrapolate.files import InputError, Sequence, gaps
from jaxtrapolate.methods import Method
from jaxtrapolate.metrics import Metric, metric_names
from jaxtrapolate.metrics import load as load_metric
from jaxtrapolate.report import write_report
from jaxtrapolate.timing import machine
from jaxtrapolate.weights import fingerprint


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "evaluate",
        help="hold back every second frame, make it with each method, and score it",
        description="Holds back the 2nd, 4th, ... frame, makes it with each method from the others, and compares. "
        "Several inputs get a folder each below DIR, and DIR sums them up.",
    )
    add_input(parser, several=True)
    parser.add_argument("--methods", required=True, metavar="A,B,C", help="names of methods, separated by commas")
    add_weights(parser)
    parser.add_argument("--output", required=True, metavar="DIR", help="for results.json, report.html and pictures")
    parser.add_argument(
        "--metrics",
        default=",".join(DEFAULT_METRICS),
        metavar="A,B,C",
        help=f"of {', '.join(metric_names())} ({','.join(DEFAULT_METRICS)}); psnr is always scored",
    )
    parser.add_argument("--frames", metavar="N,N,...", help="score only these held-back frames")
    parser.add_argument("--pictures", type=int, default=2, metavar="N", help="frames shown in the report (default 2)")
    Video.add_arguments(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Runs the command; 2 where some of several inputs could not be used."""
    console, out = terminal(stderr=True), terminal()
    methods, unavailable = open_methods(options.methods, weights=options.weights)
    metrics = open_metrics(options.metrics)
    inputs = named_inputs(options.inputs, **{n: getattr(options, n) for n in ("motion", "strict", "size", "length")})
    video = Video.parse(options.video, fps=options.fps, several=len(inputs) > 1)
    chosen = {
        "metrics": metrics,
        "unavailable": unavailable,
        "frames": options.frames,
        "pictures": options.pictures,
        "video": video,
    }
    if len(inputs) == 1:
        sequence, folder = inputs[0].open(), output_folder(options.output)
        with steps(console) as step:
            results, failed = evaluate(sequence, methods, folder, step=step, **chosen), {}
    else:
        folder = output_folder(options.output)
        with steps(console) as step:
            results, failed = evaluate_many(inputs, partial(evaluate, methods=methods, **chosen), folder, step=step)
    if results is not None:
        print_table(results, out)
        console.print(f"{folder / 'results.json'} and {folder / 'report.html'}", soft_wrap=True, highlight=False)
    for reason in failed.values():
        print(f"jaxtrapolate: {reason}", file=sys.stderr)
    return 2 if failed else 0


def evaluate(
    sequence: Sequence,
    methods: dict[str, Method],
    folder: Path,
    *,
    metrics: dict[str, Metric] | None = None,
    unavailable: dict[str, str] | None = None,
    frames: str | None = None,
    pictures: int = 2,
    video: Video | None = None,
    reuse: bool = False,
    step: Step,
) -> dict[str, Any]:
    """Scores methods on a sequence; writes results.json, pictures and report.html to `folder`, and returns the results.

    The scores of each frame are kept in `folder/scores` as they come, so that a run that was killed goes on where it
    was. `unavailable` says of methods that were asked for and cannot be had why. With `reuse`, results of the same
    settings that are there already are returned as they are.
    """
    metrics = {n: load_metric(n) for n in DEFAULT_METRICS} if metrics is None else metrics
    identity = {
        "version": __version__,
        "input": sequence.name,
        "motion": str(sequence.convention),
        "size": list(sequence.size),
        "methods": [*methods, *(unavailable or {})],
        "weights": {
            name: fingerprint(method.state) for name, method in methods.items() if jax.tree.leaves(method.state)
        },
        "metrics": list(metrics),
    }
    settings = identity | {
        "numbers": [*sequence.numbers[:1], *sequence.numbers[-1:], len(sequence.numbers)],
        "frames": frames,
        "pictures": pictures,
        "video": None if video is None else f"{video.path.name}, {video.fps:g} fps",
    }
    if reuse and (there := _finished(folder, settings)) is not None:
        return there
    usable, skipped, left_out = _usable(sequence, methods, unavailable or {})
    if not usable:
        raise InputError(f"{sequence.name}: no method can run: {'; '.join(f'{n}: {w}' for n, w in skipped.items())}")
    past, future = max(m.past for m in usable.values()), max(m.future for m in usable.values())
    numbers = _chosen(held_back(sequence, past=past, future=future), frames, sequence, past)
    kept = Kept(folder / "scores", identity)
    compile_ms: dict[str, float] = kept.read("compile") or {}
    stages: dict[str, Any] = kept.read("stages") or {}
    scores: dict[int, dict[str, Any]] = {n: s for n in numbers if (s := kept.read(f"{n:04d}")) is not None}
    todo = [n for n in numbers if n not in scores]
    step("evaluate", len(scores), len(numbers))
    for window in windows(sequence, todo, past=past, future=future):
        scores[window.number] = _score_window(sequence, window, usable, compile_ms, list(metrics.values()))
        if not stages:
            step("time stages", len(scores), len(numbers))
            stages = {
                name: {stage: t.summary() for stage, t in time_stages(method, window).items()}
                for name, method in usable.items()
            }
            kept.write("stages", stages)
        kept.write("compile", compile_ms)
        kept.write(f"{window.number:04d}", scores[window.number])
        step("evaluate", len(scores), len(numbers))
    frame_scores = {name: [scores[n][name] for n in numbers] for name in usable}
    clips, unscored = _score_clips(sequence, usable, numbers, metrics, kept, step, past=past, future=future)
    results = {
        "input": sequence.name,
        "machine": machine(),
        "size": list(sequence.size),
        "hdr": sequence.hdr,
        "settings": settings | {"past": past, "future": future},
        "metrics": {n: {"per": m.per, "better": m.better, "unit": m.unit} for n, m in metrics.items()},
        "notes": _notes(sequence, numbers) + _unscored(frame_scores) + unscored,
        "frames": numbers,
        "methods": {
            name: _summary(found, metrics, compile_ms.get(name))
            | clips.get(name, {})
            | {"stages": stages.get(name, {}), "left_out": left_out[name], "frames": found}
            for name, found in frame_scores.items()
        },
        "skipped": skipped,
    }
    step("pictures", len(numbers), len(numbers))
    shown = _worst_and_median(results, pictures)
    results["pictures"] = [
        write_pictures(sequence, window, usable, folder)
        for window in windows(sequence, shown, past=past, future=future)
    ]
    if video is not None:
        labels = {name: f"{name}, {decibels(m['psnr'])} dB" for name, m in results["methods"].items()}
        path = video.write(sequence, numbers, usable, folder, labels=labels, past=past, future=future, step=step)
        results["video"] = Path(os.path.relpath(path, folder)).as_posix()
    write_json(folder / "results.json", results)
    write_report(results, folder)
    return results


def _finished(folder: Path, settings: dict[str, Any]) -> dict[str, Any] | None:
    """The results in a folder, where they are complete and of these settings."""
    results = read_json(folder / "results.json")
    if not isinstance(results, dict) or not isinstance(results.get("settings"), dict):
        return None
    same = all(k in results["settings"] and results["settings"][k] == v for k, v in settings.items())
    files = ["report.html", *filter(None, [results.get("video")])]
    return results if same and all((folder / name).exists() for name in files) else None


def _usable(
    sequence: Sequence, methods: dict[str, Method], unavailable: dict[str, str]
) -> tuple[dict[str, Method], dict[str, str], dict[str, dict[str, list[str]]]]:
    """The methods that the sequence has the buffers for, what the others miss, and what stages are left out of each."""
    if not methods:
        raise InputError("; ".join(unavailable.values()))
    past, future = max(m.past for m in methods.values()), max(m.future for m in methods.values())
    numbers = held_back(sequence, past=past, future=future)
    if not numbers:
        longest = 2 * past + 2 * future - (1 if future else 0)
        raise InputError(
            f"{sequence.name}: too short, {len(sequence.numbers)} frames; these methods need {longest} without a gap"
        )
    window = next(iter(windows(sequence, numbers[:1], past=past, future=future)))
    if window.truth.color is None:
        raise InputError(f"{sequence.name}: frame {window.number} has no colour to compare with; use generate")
    usable, skipped, left_out = {}, dict(unavailable), {}
    for name, method in methods.items():
        given = arguments(method, window)
        try:
            method.active(*given)
            usable[name], left_out[name] = method, method.missing(*given)
        except ValueError as error:
            skipped[name] = str(error)
    return usable, skipped, left_out


def _chosen(numbers: list[int], frames: str | None, sequence: Sequence, past: int) -> list[int]:
    if frames is None:
        return numbers
    try:
        chosen = sorted({int(word) for word in frames.split(",") if word.strip()})
    except ValueError:
        raise InputError(f"--frames: expected numbers separated by commas, got {frames!r}") from None
    wrong = [n for n in chosen if n not in numbers]
    if wrong or not chosen:
        raise InputError(
            f"--frames: {', '.join(map(str, wrong)) or 'none'} of {sequence.name} cannot be scored; with {past} "
            f"rendered frames of history these can: {', '.join(map(str, numbers))}"
        )
    return chosen


def _score_window(sequence, window: Window, methods, compile_ms, metrics) -> dict[str, Any]:
    causes, invalid = causes_of(sequence, window), sequence.invalid(window.number)
    result = {}
    for name, method in methods.items():
        given = arguments(method, window)
        carry = method.init(*given[:2])
        started = time.perf_counter()
        _, image = jax.block_until_ready(method.step(carry, *given))
        first = (time.perf_counter() - started) * 1e3
        started = time.perf_counter()
        _, image = jax.block_until_ready(method.step(carry, *given))
        elapsed = (time.perf_counter() - started) * 1e3
        compile_ms.setdefault(name, max(0.0, first - elapsed))
        result[name] = score(image, window, causes, invalid, hdr=sequence.hdr, metrics=metrics) | {"ms": elapsed}
    return result


def _score_clips(
    sequence, methods, numbers, metrics, kept: Kept, step: Step, *, past, future
) -> tuple[dict, list[str]]:
    """The metrics of clips, over the held-back frames one after the other; and why some could not be had."""
    wanted = [m for m in metrics.values() if m.per == "clip"]
    key = f"clip-{zlib.crc32(repr(numbers).encode()):08x}"
    found: dict[str, dict[str, float]] = kept.read(key) or {}
    notes: dict[str, str] = {}

    def clip(method: Method | None) -> Iterator[Any]:
        for window in windows(sequence, numbers, past=past, future=future):
            truth = check_present("truth.color", window.truth.color, needed_by="evaluate")
            yield display(truth if method is None else method(*arguments(method, window)), hdr=sequence.hdr)

    for name, method in methods.items():
        for metric in wanted:
            if metric.name in found.get(name, {}):
                continue
            step(f"{metric.name} of {name}", len(numbers), len(numbers))
            try:
                found.setdefault(name, {})[metric.name] = metric(clip(method), clip(None))
            except (ValueError, RuntimeError) as error:
                notes[metric.name] = f"{metric.name}: {error}"
            kept.write(key, found)
    return found, list(notes.values())


def _summary(frames: list[dict], metrics: dict[str, Metric], compile_ms: float | None) -> dict[str, Any]:
    low, median, high = (float(q) for q in np.percentile([f["ms"] for f in frames], (25, 50, 75)))
    return mean_over_frames(frames, metrics=metrics) | {
        "ms": {"median": median, "iqr": high - low, "compile": compile_ms},
    }


def _unscored(scores: dict[str, list[dict]]) -> list[str]:
    """Why metrics could not be had for some frames, one line a metric."""
    reasons = {k: v for frames in scores.values() for f in frames for k, v in f.get("unscored", {}).items()}
    return [f"{metric}: {reason}" for metric, reason in reasons.items()]


def _notes(sequence: Sequence, numbers: list[int]) -> list[str]:
    notes = list(sequence.notes)
    missing = [n for gap in gaps(sequence) for n in gap]
    if missing:
        notes.append(f"gaps in the numbering, {len(missing)} frames missing: the history starts anew after each")
    nonfinite = {n: c for n in numbers if (c := sequence.nonfinite(n))}
    if nonfinite:
        notes.append(f"{sum(nonfinite.values())} non-finite pixels in {len(nonfinite)} scored frames: not scored")
    if sequence.depth == "ordinal":
        notes.append("depth is only ordered, not a distance: holes are found by the hole masks")
    return notes


def _worst_and_median(results: dict[str, Any], count: int) -> list[int]:
    """The frames to be shown: the best method's worst, then its median frame, then evenly spaced ones."""
    best = max(results["methods"].values(), key=lambda m: m["psnr"])
    order = [f["number"] for f in sorted(best["frames"], key=lambda f: f["psnr"])]
    ranks = [0, len(order) // 2, *np.linspace(0, len(order) - 1, num=count + 2).round().astype(int)]
    shown: list[int] = []
    for rank in ranks:
        if order[rank] not in shown and len(shown) < count:
            shown.append(order[rank])
    return sorted(shown)
