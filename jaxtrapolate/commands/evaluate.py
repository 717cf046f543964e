"""`jaxtrapolate evaluate`: how good and how fast methods are on an input, or on many."""

import argparse
import os
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtrapolate._version import __version__
from jaxtrapolate.checks import check_present
from jaxtrapolate.commands.inputs import (
    Step,
    add_fresh,
    add_input,
    add_weights,
    named_inputs,
    open_methods,
    open_metrics,
    steps,
    terminal,
)
from jaxtrapolate.commands.many import evaluate_many
from jaxtrapolate.commands.tables import decibels, print_table
from jaxtrapolate.commands.video import Video
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.pictures import write_pictures
from jaxtrapolate.evaluation.resume import Scores
from jaxtrapolate.evaluation.runnable import history_costs, runnable
from jaxtrapolate.evaluation.score import DEFAULT_METRICS, causes_of, display, mean_over_frames, score
from jaxtrapolate.evaluation.stages import time_stages
from jaxtrapolate.evaluation.windows import Window, arguments, held_back, windows
from jaxtrapolate.files import Sequence, gaps, runs
from jaxtrapolate.methods import Method, method_names
from jaxtrapolate.metrics import Metric, metric_names
from jaxtrapolate.metrics import load as load_metric
from jaxtrapolate.report import write_report
from jaxtrapolate.runtime.output import Output, code, open_output, read_json, writable_folder, write_json
from jaxtrapolate.runtime.timing import machine
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
    parser.add_argument(
        "--methods", metavar="A,B,C", help=f"separated by commas, of {', '.join(method_names())} (all that can run)"
    )
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
    add_fresh(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Runs the command; 2 where some of several inputs could not be used, or no method ran."""
    console, out = terminal(stderr=True), terminal()
    named = options.methods is not None
    methods, unavailable = open_methods(options.methods if named else method_names(), weights=options.weights)
    metrics = open_metrics(options.metrics)
    inputs = named_inputs(options.inputs, **{n: getattr(options, n) for n in ("motion", "strict", "size", "length")})
    if options.pictures < 0:
        raise InputError(f"--pictures: expected 0 or more, got {options.pictures}")
    video = Video.parse(options.video, fps=options.fps, several=len(inputs) > 1)
    chosen = {
        "metrics": metrics,
        "unavailable": unavailable,
        "frames": options.frames,
        "pictures": options.pictures,
        "video": video,
        "fresh": options.fresh,
    }
    folder = Path(options.output)
    if len(inputs) == 1:
        sequence = inputs[0].open()
        with steps(console) as step:
            results, failed = evaluate(sequence, methods, folder, step=step, **chosen), {}
    else:
        with steps(console) as step:
            results, failed = evaluate_many(
                inputs, partial(evaluate, methods=methods, **chosen), folder, fresh=options.fresh, step=step
            )
    if results is not None:
        print_table(results, out)
        console.print(f"{folder / 'results.json'} and {folder / 'report.html'}", soft_wrap=True, highlight=False)
        for name, reason in results["skipped"].items() if named else ():
            print(f"jaxtrapolate: {name} was left out: {reason}", file=sys.stderr)
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
    fresh: bool = False,
    reuse: bool = False,
    step: Step,
) -> dict[str, Any]:
    """Scores methods on a sequence; writes results.json, pictures and report.html to `folder`, and returns the results.

    The scores of each frame are kept in `folder/scores` as they come, so that a run that was killed goes on where it
    was, and a run with other methods, metrics or frames computes what is not there yet; see
    `jaxtrapolate.runtime.output` for what has to be equal.
    `unavailable` says of methods that were asked for and cannot be had why. `fresh` starts anew.
    With `reuse`, results of the same request that are there already are returned as they are.
    """
    metrics = {n: load_metric(n) for n in DEFAULT_METRICS} if metrics is None else metrics
    settings = {"inputs": "one", **sequence.identity(), "machine": machine_identity()}
    with open_output(folder, "evaluate", settings, fresh=fresh) as output:
        output.agree(
            "weights",
            {name: fingerprint(method.weights) for name, method in methods.items() if jax.tree.leaves(method.weights)},
        )
        requested = {
            "version": __version__,
            "code": code(),
            "motion": str(sequence.convention),
            "methods": [*methods, *(unavailable or {})],
            "metrics": list(metrics),
            "numbers": [*sequence.numbers[:1], *sequence.numbers[-1:], len(sequence.numbers)],
            "frames": frames,
            "pictures": pictures,
            "video": None if video is None else f"{video.path.name}, {video.fps:g} fps",
        }
        usable, skipped, left_out = runnable(sequence, methods, unavailable or {})
        past, future = max(m.past for m in usable.values()), max(m.future for m in usable.values())
        numbers = _chosen(held_back(sequence, past=past, future=future), frames, sequence, past)
        output.agree_frames(sequence, _needed(sequence, numbers, past, future), step=step)
        if reuse and (there := _finished(output.folder, requested)) is not None:
            return there
        return _evaluate(
            sequence, usable, numbers, output, metrics, requested, skipped, left_out, pictures, video, step
        )


def machine_identity() -> dict[str, Any]:
    """What of the machine and its settings times depend on."""
    keys = ("cpu", "cores_used", "versions", "backend", "gpu", "gpu_driver", "memory_kept", "settings")
    known = machine()
    return {key: known[key] for key in keys}


def _needed(sequence: Sequence, numbers: list[int], past: int, future: int) -> list[int]:
    """The frames that the windows of the held-back frames `numbers` consist of."""
    before, behind = 2 * past - 1, max(0, 2 * future - 1)
    found: set[int] = set()
    for run in runs(sequence):
        for number in set(numbers) & set(run):
            at = run.index(number)
            found |= set(run[max(0, at - before) : at + behind + 1])
    return sorted(found)


def _evaluate(
    sequence: Sequence,
    methods: dict[str, Method],
    numbers: list[int],
    output: Output,
    metrics: dict[str, Metric],
    requested: dict[str, Any],
    skipped: dict[str, str],
    left_out: dict[str, Any],
    pictures: int,
    video: Video | None,
    step: Step,
) -> dict[str, Any]:
    """The results, of frames and methods that are scored here or were in an earlier run."""
    folder = output.folder
    past, future = max(m.past for m in methods.values()), max(m.future for m in methods.values())
    kept = Scores(writable_folder(folder / "scores"), metrics)
    scores = {number: kept.frame(number) for number in numbers}
    todo = [n for n in numbers if any(name not in scores[n] for name in methods)]
    step("evaluate", len(numbers) - len(todo), len(numbers))
    for window in windows(sequence, todo, past=past, future=future):
        lacking = {name: m for name, m in methods.items() if name not in scores[window.number]}
        scores[window.number] |= _score_window(sequence, window, lacking, kept.compile_ms, list(metrics.values()))
        unmeasured = {name: m for name, m in lacking.items() if name not in kept.stages}
        if unmeasured:
            step("time stages", numbers.index(window.number), len(numbers))
            for name, method in unmeasured.items():
                kept.stages[name] = {stage: t.summary() for stage, t in time_stages(method, window).items()}
        kept.write(window.number, scores[window.number])
        step("evaluate", numbers.index(window.number) + 1, len(numbers))
    frame_scores = {name: [scores[n][name] for n in numbers] for name in methods}
    clips, unscored = _score_clips(sequence, methods, numbers, metrics, kept, step, past=past, future=future)
    results = {
        "input": sequence.name,
        "machine": machine(),
        "size": list(sequence.size),
        "hdr": sequence.hdr,
        "settings": requested | {"past": past, "future": future},
        "metrics": {n: {"per": m.per, "better": m.better, "unit": m.unit} for n, m in metrics.items()},
        "notes": _notes(sequence, numbers) + history_costs(sequence, methods) + _unscored(frame_scores) + unscored,
        "frames": numbers,
        "methods": {
            name: _summary(found, metrics, kept.compile_ms.get(name))
            | clips.get(name, {})
            | {"stages": kept.stages.get(name, {}), "left_out": left_out[name], "frames": found}
            for name, found in frame_scores.items()
        },
        "skipped": skipped,
    }
    step("pictures", len(numbers), len(numbers))
    shown = _worst_and_median(results, pictures)
    results["pictures"] = [
        write_pictures(sequence, window, methods, folder)
        for window in windows(sequence, shown, past=past, future=future)
    ]
    if video is not None:
        labels = {name: f"{name}, {decibels(m['psnr'])} dB" for name, m in results["methods"].items()}
        path = video.write(sequence, numbers, methods, folder, labels=labels, past=past, future=future, step=step)
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
    sequence, methods, numbers, metrics, kept: Scores, step: Step, *, past, future
) -> tuple[dict, list[str]]:
    """The metrics of clips, over the held-back frames one after the other; and why some could not be had."""
    wanted = [m for m in metrics.values() if m.per == "clip"]
    found = kept.clips(numbers)
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
            kept.write_clips(numbers, found)
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
