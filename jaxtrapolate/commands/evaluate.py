"""`jaxtrapolate evaluate`: how good and how fast methods are on an input."""

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxtrapolate import __version__
from jaxtrapolate.causes import CAUSES
from jaxtrapolate.commands.inputs import add_input, open_input, open_methods, output_folder, progress
from jaxtrapolate.commands.pictures import write_pictures
from jaxtrapolate.evaluation import (
    Window,
    arguments,
    causes_of,
    held_back,
    mean_over_frames,
    score,
    time_stages,
    windows,
)
from jaxtrapolate.files import InputError, Sequence, gaps
from jaxtrapolate.files.atomic import atomic_path
from jaxtrapolate.methods import Method
from jaxtrapolate.report import write_report
from jaxtrapolate.timing import machine


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "evaluate",
        help="hold back every second frame, make it with each method, and score it",
        description="Holds back the 2nd, 4th, ... frame, makes it with each method from the others, and compares.",
    )
    add_input(parser)
    parser.add_argument("--methods", required=True, metavar="A,B,C", help="names of methods, separated by commas")
    parser.add_argument("--output", required=True, metavar="DIR", help="for results.json, report.html and pictures")
    parser.add_argument("--frames", metavar="N,N,...", help="score only these held-back frames")
    parser.add_argument("--pictures", type=int, default=2, metavar="N", help="frames shown in the report (default 2)")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    console = Console(stderr=True)
    methods = open_methods(options.methods)
    sequence = open_input(options.input, motion=options.motion, strict=options.strict)
    folder = output_folder(options.output)
    results = evaluate(sequence, methods, folder, frames=options.frames, pictures=options.pictures, console=console)
    print_table(results, Console())
    console.print(f"{folder / 'results.json'} and {folder / 'report.html'}", soft_wrap=True, highlight=False)


def evaluate(
    sequence: Sequence,
    methods: dict[str, Method],
    folder: Path,
    *,
    frames: str | None = None,
    pictures: int = 2,
    console: Console,
) -> dict[str, Any]:
    """Scores methods on a sequence; writes results.json, pictures and report.html to `folder`, and returns the results.

    The scores of each frame are kept in `folder/scores` as they come, so that a run that was killed goes on where it
    was.
    """
    usable, skipped = _usable(sequence, methods)
    if not usable:
        raise InputError(f"{sequence.name}: no method can run: {'; '.join(f'{n}: {w}' for n, w in skipped.items())}")
    past, future = max(m.past for m in usable.values()), max(m.future for m in usable.values())
    numbers = _chosen(held_back(sequence, past=past, future=future), frames, sequence, past)
    settings = {
        "version": __version__,
        "input": sequence.name,
        "motion": str(sequence.convention),
        "methods": list(usable),
        "past": past,
        "future": future,
    }
    kept = _Kept(folder / "scores", settings)
    compile_ms: dict[str, float] = kept.read("compile") or {}
    stages: dict[str, Any] = kept.read("stages") or {}
    scores: dict[int, dict[str, Any]] = {n: s for n in numbers if (s := kept.read(f"{n:04d}")) is not None}
    todo = [n for n in numbers if n not in scores]
    with progress(console) as bar:
        task = bar.add_task("evaluate", total=len(numbers), completed=len(scores))
        for window in windows(sequence, todo, past=past, future=future):
            scores[window.number] = _score_window(sequence, window, usable, compile_ms)
            if not stages:
                bar.update(task, description="time stages")
                stages = {
                    name: {stage: t.summary() for stage, t in time_stages(method, window).items()}
                    for name, method in usable.items()
                }
                kept.write("stages", stages)
                bar.update(task, description="evaluate")
            kept.write("compile", compile_ms)
            kept.write(f"{window.number:04d}", scores[window.number])
            bar.advance(task)
        results = {
            "input": sequence.name,
            "machine": machine(),
            "size": list(sequence.size),
            "hdr": sequence.hdr,
            "settings": settings,
            "notes": _notes(sequence, numbers),
            "frames": numbers,
            "methods": {
                name: _summary(name, method, [scores[n][name] for n in numbers], compile_ms, stages)
                for name, method in usable.items()
            },
            "skipped": skipped,
        }
        bar.update(task, description="pictures")
        shown = _worst_and_median(results, pictures)
        results["pictures"] = [
            write_pictures(sequence, window, usable, folder)
            for window in windows(sequence, shown, past=past, future=future)
        ]
    for name, method in usable.items():
        results["methods"][name]["left_out"] = _left_out(sequence, method, past, future, numbers)
    _write_json(folder / "results.json", results)
    write_report(results, folder)
    return results


def _usable(sequence: Sequence, methods: dict[str, Method]) -> tuple[dict[str, Method], dict[str, str]]:
    """The methods that the sequence has the buffers for, and what the others miss."""
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
    usable, skipped = {}, {}
    for name, method in methods.items():
        try:
            method.active(*arguments(method, window))
            usable[name] = method
        except ValueError as error:
            skipped[name] = str(error)
    return usable, skipped


def _left_out(sequence, method, past, future, numbers) -> dict[str, list[str]]:
    window = next(iter(windows(sequence, numbers[:1], past=past, future=future)))
    return method.missing(*arguments(method, window))


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


def _score_window(sequence, window: Window, methods, compile_ms) -> dict[str, Any]:
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
        result[name] = score(image, window, causes, invalid, hdr=sequence.hdr) | {"ms": elapsed}
    return result


def _summary(name, method, frames, compile_ms, stages) -> dict[str, Any]:
    low, median, high = (float(q) for q in np.percentile([f["ms"] for f in frames], (25, 50, 75)))
    return mean_over_frames(frames) | {
        "ms": {"median": median, "iqr": high - low, "compile": compile_ms.get(name)},
        "stages": stages.get(name, {}),
        "frames": frames,
    }


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


class _Kept:
    """Small JSON files that outlive a killed run, as long as the settings are the same."""

    def __init__(self, folder: Path, settings: dict[str, Any]):
        self.folder = output_folder(str(folder))
        if self.read("settings") != settings:
            for path in self.folder.glob("*.json"):
                path.unlink()
            self.write("settings", settings)

    def read(self, name: str) -> Any:
        path = self.folder / f"{name}.json"
        try:
            return json.loads(path.read_text()) if path.exists() else None
        except ValueError:
            return None

    def write(self, name: str, value: Any) -> None:
        _write_json(self.folder / f"{name}.json", value)


def _write_json(path: Path, value: Any) -> None:
    def plain(v):
        if isinstance(v, dict):
            return {k: plain(x) for k, x in v.items()}
        if isinstance(v, list | tuple):
            return [plain(x) for x in v]
        if isinstance(v, float) and not math.isfinite(v):
            return "inf" if v > 0 else None  # JSON has neither
        return v

    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(plain(value), indent=1))


def decibels(value: Any) -> str:
    """A dB figure for a table; equal images have infinitely many."""
    return "-" if value is None else "inf" if value == "inf" or math.isinf(value) else f"{value:.2f}"


def print_table(results: dict[str, Any], console: Console) -> None:
    """The results as a table: error, run time, error by cause."""
    height, width = results["size"]
    frames = results["frames"]
    title = f"{results['input']}  {width}x{height}, {len(frames)} frames ({frames[0]}-{frames[-1]})"
    table = Table(title=title)
    table.add_column("method", no_wrap=True)
    for column in ("PSNR", "SSIM", "ms", "compile ms"):
        table.add_column(column, justify="right", no_wrap=True)
    for name, method in results["methods"].items():
        ms, ssim = method["ms"], method["ssim"]
        table.add_row(
            name,
            decibels(method["psnr"]),
            "-" if ssim is None else f"{ssim:.4f}",
            f"{ms['median']:.1f}",
            "-" if ms["compile"] is None else f"{ms['compile']:.0f}",
        )
    console.print(table)
    causes = Table(title="PSNR by cause, with its share of the pixels")
    causes.add_column("method", no_wrap=True)
    shares = next(iter(results["methods"].values()))["by_cause"]
    present = [c for c in CAUSES if c in shares]
    for cause in present:
        causes.add_column(f"{cause}\n{100 * shares[cause]['share']:.1f} %", justify="right", no_wrap=True)
    for name, method in results["methods"].items():
        causes.add_row(name, *(decibels(method["by_cause"].get(c, {}).get("psnr")) for c in present))
    console.print(causes)
    for name, reason in results["skipped"].items():
        console.print(f"{name}: left out: {reason}", soft_wrap=True)
    for note in results["notes"]:
        console.print(f"note: {note}", soft_wrap=True)
