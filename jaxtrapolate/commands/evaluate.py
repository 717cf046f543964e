"""`jaxtrapolate evaluate`: how good and how fast methods are on an input, or on many."""

import argparse
import dataclasses
import os
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtrapolate._version import __version__
from jaxtrapolate.commands.inputs import (
    Step,
    add_fresh,
    add_input,
    add_weights,
    check_factor,
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
from jaxtrapolate.evaluation.evaluate import Evaluation
from jaxtrapolate.evaluation.pictures import Gallery
from jaxtrapolate.evaluation.resume import Scores
from jaxtrapolate.evaluation.score import DEFAULT_METRICS
from jaxtrapolate.evaluation.video import write_evaluation_video
from jaxtrapolate.evaluation.windows import load
from jaxtrapolate.files import Sequence
from jaxtrapolate.methods import ON_REQUEST, Method, default_methods, method_names
from jaxtrapolate.metrics import Metric, metric_names
from jaxtrapolate.metrics import load as load_metric
from jaxtrapolate.report import write_report
from jaxtrapolate.results import Results
from jaxtrapolate.runtime.output import code, open_output, read_json, writable_folder, write_json
from jaxtrapolate.runtime.timing import machine
from jaxtrapolate.weights import fingerprint


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "evaluate",
        help="hold back every second frame, generate it with each method, and score it",
        description="Holds back N - 1 of every N frames, generates them with each method from the others, and "
        "compares. Several inputs get a folder each below DIR, and DIR sums them up.",
    )
    add_input(parser, several=True)
    parser.add_argument(
        "--methods",
        metavar="A,B,C",
        help=f"separated by commas, of {', '.join(method_names())} ({', '.join(ON_REQUEST)} only where named)",
    )
    add_weights(parser)
    parser.add_argument("--output", required=True, metavar="DIR", help="for results.json, report.html and pictures")
    parser.add_argument(
        "--factor",
        type=int,
        default=2,
        metavar="N",
        help="the first of every N frames counts as rendered, the others are held back (2)",
    )
    parser.add_argument(
        "--metrics",
        default=",".join(DEFAULT_METRICS),
        metavar="A,B,C",
        help=f"of {', '.join(metric_names())} ({','.join(DEFAULT_METRICS)}); psnr is always scored",
    )
    parser.add_argument("--frames", metavar="N,N,...", help="score only these held-back frames")
    parser.add_argument("--pictures", type=int, default=2, metavar="N", help="frames shown in the report (default 2)")
    parser.add_argument(
        "--no-stages",
        dest="stages",
        action="store_false",
        help="do not time the stages of methods one by one: about half of the compilation",
    )
    Video.add_arguments(parser)
    add_fresh(parser)
    parser.set_defaults(run=run)


_OF_INPUTS = ("motion", "strict", "size", "length", "scale", "jitter")


@dataclasses.dataclass(frozen=True)
class Request:
    """What is asked of each input.

    Attributes:
        methods: by name.
        unavailable: methods that were asked for and cannot be had, and why.
        metrics: by name.
        factor: the first of every `factor` frames is rendered.
        frames: the numbers of the held-back frames to be scored; all where it is `None`.
        pictures: how many frames the report shows.
        video: what video is wanted, if any.
        fresh: whether what an earlier run wrote is deleted.
        stages: whether each stage of a method is timed on its own, too, which compiles it once more.
    """

    methods: Mapping[str, Method]
    unavailable: Mapping[str, str] = dataclasses.field(default_factory=dict)
    metrics: Mapping[str, Metric] = dataclasses.field(
        default_factory=lambda: {name: load_metric(name) for name in DEFAULT_METRICS}
    )
    factor: int = 2
    frames: tuple[int, ...] | None = None
    pictures: int = 2
    video: Video | None = None
    fresh: bool = False
    stages: bool = True

    def settings(self, sequence: Sequence) -> dict[str, Any]:
        """What the results depend on, besides the content of the input and the machine."""
        return {
            "version": __version__,
            "code": code(),
            "motion": str(sequence.convention),
            "methods": [*self.methods, *self.unavailable],
            "metrics": list(self.metrics),
            "factor": self.factor,
            "numbers": [*sequence.numbers[:1], *sequence.numbers[-1:], len(sequence.numbers)],
            "frames": None if self.frames is None else list(self.frames),
            "pictures": self.pictures,
            "stages": self.stages,
            "video": None if self.video is None else f"{self.video.path.name}, {self.video.fps:g} fps",
        }


def run(options: argparse.Namespace) -> int:
    """Runs the command; 2 where some of several inputs could not be used, or no method ran."""
    console, out = terminal(stderr=True), terminal()
    named = options.methods is not None
    methods, unavailable = open_methods(options.methods if named else default_methods(), weights=options.weights)
    metrics = open_metrics(options.metrics)
    inputs = named_inputs(options.inputs, **{n: getattr(options, n) for n in _OF_INPUTS})
    if options.pictures < 0:
        raise InputError(f"--pictures: expected 0 or more, got {options.pictures}")
    video = Video.parse(options.video, fps=options.fps, several=len(inputs) > 1)
    request = Request(
        methods,
        unavailable,
        metrics,
        check_factor(options.factor),
        _numbers(options.frames),
        options.pictures,
        video,
        options.fresh,
        options.stages,
    )
    folder = Path(options.output)
    if len(inputs) == 1:
        sequence = inputs[0].open()
        with steps(console) as step:
            results, failed = evaluate_into(sequence, request, folder, step=step), {}
    else:
        with steps(console) as step:
            each = partial(evaluate_into, request=request)
            results, failed = evaluate_many(inputs, each, folder, fresh=options.fresh, step=step)
    if results is not None:
        print_table(results, out)
        console.print(f"{folder / 'results.json'} and {folder / 'report.html'}", soft_wrap=True, highlight=False)
        for name, reason in results.skipped.items() if named else ():
            print(f"jaxtrapolate: {name} was left out: {reason}", file=sys.stderr)
    for reason in failed.values():
        print(f"jaxtrapolate: {reason}", file=sys.stderr)
    return 2 if failed else 0


def _numbers(text: str | None) -> tuple[int, ...] | None:
    if text is None:
        return None
    try:
        return tuple(sorted({int(word) for word in text.split(",") if word.strip()}))
    except ValueError:
        raise InputError(f"--frames: expected numbers separated by commas, got {text!r}") from None


def evaluate_into(sequence: Sequence, request: Request, folder: Path, *, reuse: bool = False, step: Step) -> Results:
    """Scores methods on a sequence; writes results.json, pictures and report.html to `folder`, and returns the results.

    The scores of each frame are kept in `folder/scores` as they come, so that a run that was killed goes on where it
    was, and a run with other methods, metrics or frames computes what is not there yet; see
    `jaxtrapolate.runtime.output` for what has to be equal. With `reuse`, results of the same request that are there
    already are returned unchanged.
    """
    settings = {
        "inputs": "one",
        **sequence.identity(),
        "factor": request.factor,
        "machine": machine_identity(),
    }
    with open_output(folder, "evaluate", settings, fresh=request.fresh) as output:
        trained = {n: m for n, m in request.methods.items() if jax.tree.leaves(m.weights)}
        output.agree("weights", {name: fingerprint(method.weights) for name, method in trained.items()})
        evaluation = Evaluation.prepare(
            sequence,
            request.methods,
            request.metrics,
            factor=request.factor,
            frames=request.frames,
            unavailable=request.unavailable,
        )
        output.agree_frames(sequence, evaluation.reads(), step=step)
        if evaluation.larger and sequence.larger is not None:
            output.agree_frames(sequence.larger, evaluation.reads(), kind="larger frames", step=step)
        if reuse and (there := _finished(output.folder, request.settings(sequence))) is not None:
            return there
        kept = Scores(writable_folder(output.folder / "scores"), request.metrics)
        gallery = Gallery(output.folder, hdr=sequence.hdr)
        pictured = request.pictures > 0 or request.video is not None or _of_clips(request.metrics)
        results = evaluation.run(
            kept=kept,
            gallery=gallery if pictured else None,
            keep_all=request.video is not None,
            stages=request.stages,
            step=step,
        )
        settings = {**results.settings, **request.settings(sequence)}
        results = dataclasses.replace(results, settings=settings)
        results = _illustrated(results, evaluation, request, gallery, output.folder, step)
        write_json(output.folder / "results.json", results.to_json())
        write_report(results, output.folder)
        return results


def _of_clips(metrics: Mapping[str, Metric]) -> bool:
    return any(metric.per == "clip" for metric in metrics.values())


def _illustrated(
    results: Results, evaluation: Evaluation, request: Request, gallery: Gallery, folder: Path, step: Step
) -> Results:
    """The results with the pictures of the frames that are shown, and the video."""
    sequence, count = evaluation.sequence, len(evaluation.numbers)
    if request.video is not None:
        step("video", 0, count)
        labels = {name: f"{name}, {decibels(m.psnr)} dB" for name, m in results.methods.items()}
        slots = [slot for slot in evaluation.slots if slot.number in set(evaluation.numbers)]
        path = folder / request.video.path
        write_evaluation_video(path, sequence, slots, labels, gallery, fps=request.video.fps)
        results = dataclasses.replace(results, video=Path(os.path.relpath(path, folder)).as_posix())
    step("pictures", count, count)
    shown = worst_and_median(results, request.pictures)
    for _, window, generated in evaluation.play(lambda name, n: n in shown and not gallery.has(name, n)):
        for name, result in generated.items():  # scored by an earlier run, which did not show them
            gallery.put(name, window, result.image)
    gallery.keep_only(shown)
    chosen = [slot for slot in evaluation.slots if slot.number in shown]
    windows = load(sequence, chosen, hidden=evaluation.hidden)
    pictures = tuple(gallery.describe(sequence, window, evaluation.methods) for _, window in windows)
    return dataclasses.replace(results, pictures=pictures)


def machine_identity() -> dict[str, Any]:
    """What of the machine and its settings times depend on."""
    keys = ("cpu", "cores_used", "versions", "backend", "gpu", "gpu_driver", "memory_kept", "settings")
    known = machine()
    return {key: known[key] for key in keys}


def _finished(folder: Path, settings: Mapping[str, Any]) -> Results | None:
    """The results in a folder, where they are complete and of these settings."""
    content = read_json(folder / "results.json")
    if not isinstance(content, dict) or not isinstance(content.get("settings"), dict):
        return None
    same = all(k in content["settings"] and content["settings"][k] == v for k, v in settings.items())
    files = ["report.html", *filter(None, [content.get("video")])]
    return Results.from_json(content) if same and all((folder / name).exists() for name in files) else None


def worst_and_median(results: Results, count: int) -> list[int]:
    """The frames to be shown: the best method's worst, then its median frame, then evenly spaced ones."""
    best = max(results.methods.values(), key=lambda m: -np.inf if m.psnr is None else m.psnr)
    order = [f.number for f in sorted(best.frames, key=lambda f: -np.inf if f.psnr is None else f.psnr)]
    ranks = [0, len(order) // 2, *np.linspace(0, len(order) - 1, num=count + 2).round().astype(int)]
    shown: list[int] = []
    for rank in ranks:
        if order[rank] not in shown and len(shown) < count:
            shown.append(order[rank])
    return sorted(shown)
