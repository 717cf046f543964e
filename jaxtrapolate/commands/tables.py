"""The results of an evaluation as tables on a terminal."""

import math

from rich.console import Console
from rich.table import Table

from jaxtrapolate.ops.causes import CAUSES
from jaxtrapolate.report.values import metric_label, metric_text
from jaxtrapolate.results import Results


def decibels(value: float | None) -> str:
    """A dB figure for a table; equal images have infinitely many."""
    return "-" if value is None else "inf" if math.isinf(value) else f"{value:.2f}"


def print_table(results: Results, console: Console) -> None:
    """The results as tables: dB by input where there are several, error, run time, error by cause and by distance."""
    if results.inputs:
        _print_inputs(results, console)
    table = Table(title=f"means over {len(results.inputs)} inputs" if results.inputs else _title(results))
    metrics = {name: m for name, m in results.metrics.items() if name != "psnr"}
    table.add_column("method", no_wrap=True)
    for column in ("PSNR", *(metric_label(n, m.better) for n, m in metrics.items()), "ms", "compile ms"):
        table.add_column(column, justify="right", no_wrap=True)
    for name, method in results.methods.items():
        ms = method.ms
        table.add_row(
            name,
            decibels(method.psnr),
            *(metric_text(method.metrics.get(n), m.unit) for n, m in metrics.items()),
            "-" if ms.median is None else f"{ms.median:.1f}",
            "-" if ms.compile is None else f"{ms.compile:.0f}{' (cached)' if ms.cached else ''}",
        )
    console.print(table)
    causes = Table(title="PSNR by cause, with its share of the pixels")
    causes.add_column("method", no_wrap=True)
    shares = next(iter(results.methods.values())).by_cause
    present = [c for c in CAUSES if c in shares]
    for cause in present:
        causes.add_column(f"{cause}\n{100 * (shares[cause].share or 0):.1f} %", justify="right", no_wrap=True)
    for name, method in results.methods.items():
        causes.add_row(name, *(decibels(method.by_cause[c].psnr if c in method.by_cause else None) for c in present))
    console.print(causes)
    if any(method.by_distance for method in results.methods.values()):
        _print_distances(results, console)
    for name, reason in results.skipped.items():
        console.print(f"{name}: left out: {reason}", soft_wrap=True)
    for note in results.notes:
        console.print(f"note: {note}", soft_wrap=True)


def _title(results: Results) -> str:
    size = "" if results.size is None else f"{results.size[1]}x{results.size[0]}, "
    frames = results.frames
    return f"{results.input}  {size}{len(frames)} frames ({frames[0]}-{frames[-1]})"


def _print_distances(results: Results, console: Console) -> None:
    table = Table(title="PSNR by distance from the newest rendered frame, and drift from first to last")
    table.add_column("method", no_wrap=True)
    distances = sorted({d for method in results.methods.values() for d in method.by_distance})
    for distance in (*distances, "drift"):
        table.add_column("rendered" if distance == 0 else str(distance), justify="right", no_wrap=True)
    for name, method in results.methods.items():
        drift = "-" if method.drift is None else f"{method.drift:.2f}"
        found = method.by_distance or {frame.distance: method.psnr for frame in method.frames}
        table.add_row(name, *(decibels(found.get(d)) for d in distances), drift)
    console.print(table)


def _print_inputs(results: Results, console: Console) -> None:
    table = Table(title="PSNR by input")
    table.add_column("input", overflow="fold")
    table.add_column("frames", justify="right", no_wrap=True)
    for name in results.methods:
        table.add_column(name, justify="right")
    for entry in results.inputs:
        found = (entry.methods[name].psnr if name in entry.methods else None for name in results.methods)
        table.add_row(entry.folder, str(entry.frames), *map(decibels, found))
    table.add_section()
    table.add_row("mean", "", *(decibels(m.psnr) for m in results.methods.values()))
    console.print(table)
