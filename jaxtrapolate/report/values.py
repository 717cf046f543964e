"""What the report shows of results, and figures as text: what is absent or odd is a dash, never an error."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from jaxtrapolate.report.colors import method_style
from jaxtrapolate.results import MethodResult, Results

DASH = "–"


@dataclass(frozen=True)
class MetricColumn:
    """A metric besides PSNR: its heading, whether more of it is better, and its unit."""

    name: str
    label: str
    higher: bool
    unit: str
    per_frame: bool


def metric_label(name: str, better: str = "higher") -> str:
    """The heading of a metric's column; an arrow where less is better."""
    return name.replace("_", " ").upper() + (" ↓" if better == "lower" else "")


def metric_text(value: float | None, unit: str = "") -> str:
    """A metric's value with the digits that tell methods apart."""
    return fixed(value, 2 if unit == "dB" or (value is not None and abs(value) >= 10) else 4)


def as_results(results: Results | Mapping[str, Any]) -> Results:
    """Results, or what their JSON file holds."""
    return results if isinstance(results, Results) else Results.from_json(results)


def metric_columns(results: Results) -> list[MetricColumn]:
    """The metrics besides PSNR, in their order."""
    return [
        MetricColumn(name, metric_label(name, m.better), m.better == "higher", m.unit, m.per == "frame")
        for name, m in results.metrics.items()
        if name != "psnr"
    ]


@dataclass(frozen=True)
class NamedMethod(MethodResult):
    """One method's results, with the colour and marker that stand for it throughout the report."""

    name: str = ""
    color: str = ""
    marker: str = ""

    def psnr_of(self, cause: str) -> float | None:
        """The dB of a cause of error, None where it does not occur or is not known."""
        return self.by_cause[cause].psnr if cause in self.by_cause else None


def named_methods(results: Results | Mapping[str, Any]) -> list[NamedMethod]:
    """The methods of the results, in their order."""
    found = []
    for index, (name, method) in enumerate(as_results(results).methods.items()):
        color, marker = method_style(index)
        found.append(NamedMethod(**vars(method), name=name, color=color, marker=marker))
    return found


def best_method(methods: Sequence[NamedMethod]) -> NamedMethod | None:
    """The method with the most dB, of equal ones the fastest; None where none was scored."""
    scored = [m for m in methods if m.psnr is not None]
    return max(scored, key=lambda m: (m.psnr, -(m.ms.median if m.ms.median is not None else math.inf)), default=None)


def reference_method(methods: Sequence[NamedMethod]) -> NamedMethod | None:
    """What the best method is compared with: "warp", else "repeat", else the second best; None where it is alone."""
    best = best_method(methods)
    others = [m for m in methods if m is not best and m.psnr is not None]
    named = [m for name in ("warp", "repeat") for m in others if m.name == name]
    return named[0] if named else best_method(others)


def fixed(value: float | None, digits: int = 1, *, signed: bool = False) -> str:
    """A number with a fixed count of decimals and a typeset sign; ∞ and a dash for what has no digits."""
    if value is None:
        return DASH
    if math.isinf(value):
        return ("+" if signed and value > 0 else "−" if value < 0 else "") + "∞"
    return f"{value:{'+' if signed else ''}.{digits}f}".replace("-", "−")


def milliseconds(value: float | None) -> str:
    """Milliseconds with about three digits."""
    return fixed(value, 0 if value is not None and value >= 100 else 1 if value is not None and value >= 10 else 2)


def duration(value: float | None) -> str:
    """Milliseconds with their unit, from one second on in seconds."""
    if value is None:
        return DASH
    return f"{value / 1e3:.1f} s" if value >= 1e3 else f"{milliseconds(value)} ms"


def percent(value: float | None) -> str:
    """A share as per cent; a small one is not rounded to nothing."""
    if value is None:
        return DASH
    return "< 0.1 %" if 0 < value < 0.0005 else f"{fixed(100 * value)} %"


def gain(method: NamedMethod | None, other: NamedMethod | None) -> float | None:
    """The dB of a method over another's, None where either is unknown or both are infinite."""
    if method is None or other is None or method.psnr is None or other.psnr is None:
        return None
    difference = method.psnr - other.psnr
    return None if math.isnan(difference) else difference


def headline(methods: Sequence[NamedMethod]) -> str:
    """The result in one sentence: the best method, its dB and milliseconds, and what it gains."""
    best, other = best_method(methods), reference_method(methods)
    if best is None:
        return "No method was scored."
    text = f"{best.name}: {fixed(best.psnr)} dB"
    if best.ms.median is not None:
        text += f" at {milliseconds(best.ms.median)} ms"
    difference = gain(best, other)
    if other is not None and difference is not None:
        text += f", {fixed(difference, signed=True)} dB over {other.name}"
    return text


@dataclass(frozen=True)
class InputRow:
    """One of several inputs: its name, the path of its own report, what it is, and each method's dB."""

    name: str
    link: str | None
    detail: str
    psnr: dict[str, float | None]


def input_rows(results: Results) -> list[InputRow]:
    """The inputs of results over several, in their order."""
    rows = []
    for entry in results.inputs:
        details = [f"{entry.size[1]} × {entry.size[0]}"] if entry.size is not None else []
        details += [f"{entry.frames} frames"] if entry.frames is not None else []
        psnr = {name: method.psnr for name, method in entry.methods.items()}
        link = f"{relative_link(entry.folder)}/report.html" if entry.folder else None
        rows.append(InputRow(entry.folder or entry.input or "?", link, ", ".join(details), psnr))
    return rows


def relative_link(path: Any) -> str | None:
    """A file beside the page as a link: quoted, so that it can be no scheme and no host; None for what is no path."""
    return quote(path.lstrip("/").encode("utf-8", "replace")) or None if isinstance(path, str) else None
