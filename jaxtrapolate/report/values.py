"""Reading results robustly, and figures as text: what is absent or odd is shown as a dash, never an error."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from jaxtrapolate.ops.causes import CAUSES
from jaxtrapolate.report.colors import method_style

DASH = "–"


def number(value: Any) -> float | None:
    """A float, infinite where the value says so ("inf" too); None for anything that is no number, and for NaN."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        result = float(value)
    except (ValueError, OverflowError):
        return None
    return None if math.isnan(result) else result


def mapping(value: Any) -> Mapping[str, Any]:
    """The value where it is a mapping, else an empty one."""
    return value if isinstance(value, Mapping) else {}


def items(value: Any) -> Sequence[Any]:
    """The value where it is a list or tuple, else an empty one."""
    return value if isinstance(value, (list, tuple)) else ()


@dataclass(frozen=True)
class Spread:
    """Milliseconds, each None where it is not known."""

    median: float | None = None
    iqr: float | None = None
    compile: float | None = None

    @staticmethod
    def read(value: Any) -> "Spread":
        """From a mapping; a bare number is a median."""
        if not isinstance(value, Mapping):
            return Spread(_positive(number(value)))
        return Spread(*(_positive(number(value.get(key))) for key in ("median", "iqr", "compile")))


def _positive(value: float | None) -> float | None:
    return value if value is not None and 0 <= value < math.inf else None


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


def read_metrics(results: Mapping[str, Any]) -> list[MetricColumn]:
    """The metrics besides PSNR, in their order; SSIM where the results do not say."""
    stated = mapping(results.get("metrics")) if "metrics" in results else {"ssim": {"better": "higher"}}
    columns = []
    for name, entry in stated.items():
        entry = mapping(entry)
        higher = entry.get("better") != "lower"
        label = metric_label(str(name), "higher" if higher else "lower")
        if name != "psnr":
            unit, per_frame = str(entry.get("unit") or ""), entry.get("per") != "clip"
            columns.append(MetricColumn(str(name), label, higher, unit, per_frame))
    return columns


@dataclass(frozen=True)
class Score:
    """The scores of one frame."""

    number: int
    psnr: float | None
    others: dict[str, float | None]
    ms: float | None


@dataclass(frozen=True)
class MethodResult:
    """One method's entry in the results, with the colour and marker that stand for it throughout the report."""

    name: str
    psnr: float | None
    others: dict[str, float | None]
    ms: Spread
    by_cause: dict[str, tuple[float | None, float | None]]
    stages: dict[str, Spread]
    left_out: dict[str, list[str]]
    frames: list[Score]
    color: str
    marker: str


def _psnr(entry: Mapping[str, Any]) -> float | None:
    """The dB of an entry; where there are none but the images are the same (SSIM 1), infinite."""
    value = number(entry.get("psnr"))
    return math.inf if value is None and number(entry.get("ssim")) == 1 else value


def _frames(entries: Any, metrics: Sequence[MetricColumn]) -> list[Score]:
    scores = []
    for entry in map(mapping, items(entries)):
        index = number(entry.get("number"))
        if index is not None and math.isfinite(index):
            spent = Spread.read(entry.get("ms")).median
            others = {m.name: number(entry.get(m.name)) for m in metrics}
            scores.append(Score(int(index), _psnr(entry), others, spent))
    return sorted(scores, key=lambda score: score.number)


def read_methods(results: Mapping[str, Any]) -> list[MethodResult]:
    """The methods of the results, in their order."""
    methods, metrics = [], read_metrics(results)
    for index, (name, entry) in enumerate(mapping(results.get("methods")).items()):
        entry = mapping(entry)
        by_cause = {}
        for cause in CAUSES:
            found = mapping(mapping(entry.get("by_cause")).get(cause))
            if found:
                by_cause[cause] = (number(found.get("psnr")), number(found.get("share")))
        color, marker = method_style(index)
        left_out = mapping(entry.get("left_out")).items()
        method = MethodResult(
            name=str(name),
            psnr=_psnr(entry),
            others={m.name: number(entry.get(m.name)) for m in metrics},
            ms=Spread.read(entry.get("ms")),
            by_cause=by_cause,
            stages={str(k): Spread.read(v) for k, v in mapping(entry.get("stages")).items()},
            left_out={str(k): [str(i) for i in (v if isinstance(v, (list, tuple)) else [v])] for k, v in left_out},
            frames=_frames(entry.get("frames"), metrics),
            color=color,
            marker=marker,
        )
        methods.append(method)
    return methods


def best_method(methods: Sequence[MethodResult]) -> MethodResult | None:
    """The method with the most dB, of equal ones the fastest; None where none was scored."""
    scored = [m for m in methods if m.psnr is not None]
    return max(scored, key=lambda m: (m.psnr, -(m.ms.median if m.ms.median is not None else math.inf)), default=None)


def reference_method(methods: Sequence[MethodResult]) -> MethodResult | None:
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


def gain(method: MethodResult | None, other: MethodResult | None) -> float | None:
    """The dB of a method over another's, None where either is unknown or both are infinite."""
    if method is None or other is None or method.psnr is None or other.psnr is None:
        return None
    difference = method.psnr - other.psnr
    return None if math.isnan(difference) else difference


def headline(methods: Sequence[MethodResult]) -> str:
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


def read_inputs(results: Mapping[str, Any]) -> list[InputRow]:
    """The inputs of results over several, in their order."""
    rows = []
    for entry in map(mapping, items(results.get("inputs"))):
        folder, size = entry.get("folder"), [number(v) for v in items(entry.get("size"))]
        count = number(entry.get("frames"))
        details = [f"{size[1]:g} × {size[0]:g}"] if len(size) == 2 and None not in size else []
        details += [f"{count:g} frames"] if count is not None else []
        psnr = {str(name): _psnr(mapping(scores)) for name, scores in mapping(entry.get("methods")).items()}
        link = f"{relative_link(folder)}/report.html" if isinstance(folder, str) and folder else None
        rows.append(InputRow(str(folder or entry.get("input") or "?"), link, ", ".join(details), psnr))
    return rows


def relative_link(path: Any) -> str | None:
    """A file beside the page as a link: quoted, so that it can be no scheme and no host; None for what is no path."""
    return quote(path.lstrip("/").encode("utf-8", "replace")) or None if isinstance(path, str) else None
