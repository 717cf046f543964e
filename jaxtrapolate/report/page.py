"""The report page: what the results and their pictures hold, filled into `report.html`.

The page is one file: style, script, plots and pictures are in it, and its content security policy lets it load nothing
else and run no other script. Every text is escaped by the template.
"""

import base64
import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.ops.causes import CAUSES
from jaxtrapolate.report import values
from jaxtrapolate.report.colors import CAUSE_COLORS, CAUSE_TEXTS, ERROR_LIMIT, error_gradient
from jaxtrapolate.report.pictures import Pictures
from jaxtrapolate.report.plots import plot_causes, plot_error_time, plot_frames
from jaxtrapolate.report.values import DASH, MetricColumn, NamedMethod
from jaxtrapolate.results import Results, mapping, number


def write_report(results: Results | Mapping[str, Any], folder: str | os.PathLike[str]) -> Path:
    """Writes `folder/report.html`, one self-contained page, in full or not at all.

    Args:
        results: as `evaluate` writes them to results.json; every entry may be absent, infinite dB are the string "inf"
            or infinite.
        folder: holds the pictures, whose paths in the results are relative to it. A picture that is not there, or lies
            elsewhere, is left out, and the page's notes say so.

    Returns:
        The path of the page.

    Raises:
        InputError: the page cannot be written; one line that names it.
    """
    path = Path(folder) / "report.html"
    page = render_report(results, folder).encode("utf-8", "replace")
    with atomic_path(path) as temporary:
        temporary.write_bytes(page)
    return path


def render_report(results: Results | Mapping[str, Any], folder: str | os.PathLike[str]) -> str:
    """The page as text; arguments as of `write_report`."""
    here = files("jaxtrapolate.report")
    sources = {kind: here.joinpath(f"report.{kind}").read_text(encoding="utf-8") for kind in ("html", "css", "js")}
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    digest = base64.b64encode(hashlib.sha256(sources["js"].encode()).digest()).decode()
    return environment.from_string(sources["html"]).render(
        css=Markup(sources["css"]),
        js=Markup(sources["js"]),
        script_hash=f"sha256-{digest}",
        **_content(values.as_results(results), Path(folder)),
    )


def _content(results: Results, folder: Path) -> dict[str, Any]:
    """Everything that the template shows, as text and plain values."""
    methods, metrics = values.named_methods(results), values.metric_columns(results)
    best, reference = values.best_method(methods), values.reference_method(methods)
    pictures = Pictures(folder)
    shown = [_frame(entry, methods, best, reference, pictures) for entry in results.pictures]
    notes = list(results.notes)
    if pictures.missing:
        notes.append(f"pictures that could not be read: {', '.join(pictures.missing)}")
    return {
        "title": results.input or "no name",
        "headline": values.headline(methods),
        "facts": _facts(results, methods),
        "best": best and best.name,
        "reference": reference and reference.name,
        "methods": _method_rows(methods, metrics, best, reference),
        "metrics": [column.label for column in metrics],
        "frame_metrics": [column.label for column in metrics if column.per_frame],
        "inputs": _input_rows(results, methods),
        "failed": list(results.failed.values()),
        "video": _video(results),
        "skipped": dict(results.skipped),
        "causes": _causes(methods),
        "cause_rows": _cause_rows(methods),
        "stages": _stage_rows(methods),
        "frames": [frame for frame in shown if frame["sheet"]],
        "scores": _score_table(methods, [c for c in metrics if c.per_frame]),
        "plots": {
            "time": _svg_uri(plot_error_time(results)),
            "causes": _svg_uri(plot_causes(results)) if _cause_rows(methods) else None,
            "frames": _svg_uri(plot_frames(results)) if any(len(m.frames) > 1 for m in methods) else None,
        },
        "error_limit": f"{ERROR_LIMIT:g}",
        "error_gradient": error_gradient(),
        "machine": _flat(results.machine),
        "settings": _flat(results.settings),
        "notes": notes,
    }


def _facts(results: Results, methods: Sequence[NamedMethod]) -> list[str]:
    facts = []
    if results.inputs:
        facts.append("each input counts as much as another")
    if results.size is not None:
        facts.append(f"{results.size[1]} × {results.size[0]} pixels")
    if results.hdr is not None:
        facts.append("HDR, scored after x/(1+x) and gamma 1/2.2" if results.hdr else "8-bit, scored in sRGB")
    count = len(results.frames) or max((len(m.frames) for m in methods), default=0)
    count = count or sum(i.frames or 0 for i in results.inputs)
    if count:
        facts.append(f"{count} frame{'s' if count > 1 else ''} held back and scored")
    if device := results.machine.get("gpu") or results.machine.get("cpu"):
        facts.append(str(device))
    return facts


def _tops(columns: Sequence[Sequence[float | None]], *, least: Sequence[int] = ()) -> list[float | None]:
    """The best value of each column, the largest or, for those in `least`, the smallest; None where all are alike."""
    found = [{v for v in column if v is not None} for column in columns]
    return [((min if i in least else max)(c) if len(c) > 1 else None) for i, c in enumerate(found)]


def _method_rows(methods, metrics: Sequence[MetricColumn], best, reference) -> list[dict[str, Any]]:
    def row_values(m):
        return (m.psnr, *(m.metrics[c.name] for c in metrics), m.ms.median)

    least = [i for i, c in enumerate(metrics, 1) if not c.higher] + [len(metrics) + 1]
    tops = _tops(list(zip(*map(row_values, methods), strict=True)), least=least)
    rows = []
    for m in methods:
        marks = [top is not None and value == top for value, top in zip(row_values(m), tops, strict=True)]
        texts = [values.metric_text(m.metrics[c.name], c.unit) for c in metrics]
        rows.append(
            {
                "name": m.name,
                "color": m.color,
                "best": m is best and len(methods) > 1,
                "psnr": values.fixed(m.psnr, 2),
                "gain": DASH if m is reference else values.fixed(values.gain(m, reference), 2, signed=True),
                "others": list(zip(texts, marks[1:-1], strict=True)),
                "ms": values.milliseconds(m.ms.median),
                "iqr": values.milliseconds(m.ms.iqr),
                "compile": values.duration(m.ms.compile) + (" (cached)" if m.ms.cached else ""),
                "marks": marks,
            }
        )
    return rows


def _occurring(methods: Sequence[NamedMethod]) -> list[str]:
    """The causes that occur; all of them where nothing is known."""
    return [c for c in CAUSES if any(c in m.by_cause for m in methods)] or list(CAUSES)


def _causes(methods: Sequence[NamedMethod]) -> list[dict[str, str | None]]:
    """The legend of the causes that occur; shares are the pixels', so any method's are everyone's."""
    legend = []
    for cause in _occurring(methods):
        shares = [s for m in methods if cause in m.by_cause and (s := m.by_cause[cause].share) is not None]
        share = values.percent(shares[0]) if shares else None
        legend.append({"name": cause, "color": CAUSE_COLORS[cause], "text": CAUSE_TEXTS[cause], "share": share})
    return legend


def _cause_rows(methods: Sequence[NamedMethod]) -> list[dict[str, Any]]:
    causes = _occurring(methods)
    tops = _tops([[m.psnr_of(c) for m in methods] for c in causes])
    rows = []
    for m in methods:
        if m.by_cause:
            found = [m.psnr_of(c) for c in causes]
            marks = [v is not None and v == top for v, top in zip(found, tops, strict=True)]
            cells = list(zip([values.fixed(v) for v in found], marks, strict=True))
            rows.append({"name": m.name, "color": m.color, "cells": cells})
    return rows


def _stage_rows(methods: Sequence[NamedMethod]) -> list[dict[str, Any]]:
    groups = []
    for m in methods:
        total = sum(s.median or 0.0 for s in m.stages.values())
        rows = [
            {
                "name": name,
                "ms": values.milliseconds(s.median),
                "iqr": values.milliseconds(s.iqr),
                "compile": values.duration(s.compile),
                "share": round(100 * (s.median or 0.0) / total, 1) if total else 0,
                "missing": None,
            }
            for name, s in m.stages.items()
        ]
        left_out = [{"name": name, "missing": ", ".join(lacks)} for name, lacks in m.left_out.items()]
        if rows or left_out:
            total_ms = values.milliseconds(total) if rows else DASH
            whole = values.milliseconds(m.ms.median)
            groups.append(
                {"name": m.name, "color": m.color, "rows": rows + left_out, "total": total_ms, "whole": whole}
            )
    return groups


def _input_rows(results: Results, methods: Sequence[NamedMethod]) -> list[dict[str, Any]]:
    """dB by input and method, the best of each input marked, and a last row of their means."""
    rows = []
    for row in values.input_rows(results):
        found = [row.psnr.get(m.name) for m in methods]
        top = _tops([found])[0]
        cells = [(values.fixed(v, 2), v is not None and v == top) for v in found]
        rows.append({"name": row.name, "link": row.link, "detail": row.detail, "cells": cells})
    if rows:
        top = _tops([[m.psnr for m in methods]])[0]
        means = [(values.fixed(m.psnr, 2), m.psnr is not None and m.psnr == top) for m in methods]
        rows.append({"name": "mean", "link": None, "detail": "", "cells": means})
    return rows


def _video(results: Results) -> dict[str, str] | None:
    """The link to the video."""
    link = values.relative_link(results.video)
    return {"link": link, "name": str(results.video)} if link else None


def _score_table(methods: Sequence[NamedMethod], metrics: Sequence[MetricColumn]) -> list[dict[str, Any]]:
    scores = {(m.name, f.number): f for m in methods for f in m.frames}
    rows = []
    for index in sorted({f.number for m in methods for f in m.frames}):
        found = [scores.get((m.name, index)) for m in methods]
        cells = [
            (
                values.fixed(f and f.psnr, 2),
                *(values.metric_text(f and f.metrics[c.name], c.unit) for c in metrics),
                values.milliseconds(f and f.ms),
            )
            for f in found
        ]
        rows.append({"number": index, "cells": cells})
    return rows


def _frame(entry, methods, best, reference, pictures: Pictures) -> dict[str, Any]:
    """One chosen frame: a sheet of pictures, in pairs one above the other, and which two the slider starts with."""
    index = number(entry.get("number"))
    label = f"{index:g}" if index is not None and math.isfinite(index) else "?"
    scores = {m.name: f for m in methods for f in m.frames if f.number == index}
    made = mapping(entry.get("methods"))
    known = [m for m in methods if m.name in made]
    colors = {m.name: m.color for m in methods}

    def picture(key: str, path: Any, name: str, text: str) -> dict[str, str] | None:
        uri = pictures.uri(path)
        return {"key": key, "uri": uri, "name": name, "alt": f"Frame {label}: {text}"} if uri else None

    def pair(name: str, detail: str, color: str | None, *found: dict[str, str] | None) -> dict[str, Any] | None:
        there = [p for p in found if p]
        return {"name": name, "detail": detail, "color": color, "pictures": there} if there else None

    truth = picture("truth", entry.get("truth"), "truth", "the true image")
    causes = picture("causes", entry.get("causes"), "causes", "cause map, colours as in the legend")
    previous = picture("previous", entry.get("previous"), "previous", "the rendered image before it")
    holes = picture("holes", entry.get("holes"), "holes", "hole mask")
    sheet = [
        pair("truth", "below: causes", None, truth, causes),
        pair("previous", "below: holes", None, previous, holes),
    ]
    for name in [m.name for m in known] + [str(n) for n in made if str(n) not in {m.name for m in known}]:
        paths = mapping(made.get(name))
        score = scores.get(name)
        detail = f"{values.fixed(score.psnr)} dB" if score else ""
        image = picture(f"image:{name}", paths.get("image"), f"{name} {detail}".strip(), f"image by {name}, {detail}")
        error = picture(f"error:{name}", paths.get("error"), f"error of {name}", f"error map of {name}")
        sheet.append(pair(name, detail, colors.get(name), image, error))
    buffers = [
        picture(f"buffer:{name}", path, str(name), f"buffer {name}")
        for name, path in mapping(entry.get("buffers")).items()
    ]
    sheet, buffers = [p for p in sheet if p], [b for b in buffers if b]
    keys = [p["key"] for card in sheet for p in card["pictures"]]
    wishes = [f"image:{m.name}" for m in (best, reference) if m is not None] + ["truth", "previous", *keys]
    right, left = ([key for key in dict.fromkeys(wishes) if key in keys] * 2)[:2] if keys else (None, None)
    winner = max((s for s in scores.items() if s[1].psnr is not None), key=lambda s: s[1].psnr, default=None)
    summary = f"best: {winner[0]}, {values.fixed(winner[1].psnr)} dB" if winner else ""
    return {"label": label, "sheet": sheet, "buffers": buffers, "left": left, "right": right, "summary": summary}


def _svg_uri(svg: bytes) -> str:
    return f"data:image/svg+xml;base64,{base64.b64encode(svg).decode()}"


def _flat(value: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested settings as rows of name and text; what is not known is left out."""
    rows: list[tuple[str, str]] = []
    for key, entry in value.items():
        if isinstance(entry, Mapping):
            rows += _flat(entry, f"{prefix}{key} ")
        elif entry is not None:
            text = ", ".join(map(str, entry)) if isinstance(entry, (list, tuple)) else str(entry)
            rows.append((f"{prefix}{key}".replace("_", " "), text))
    return rows
