"""The report's plots as SVG: error against run time, error by cause, error over the frames.

Each is drawn with a transparent ground, and follows the viewer's light or dark theme by a style sheet of its own. Text
is drawn as outlines, so that no font is needed; nothing of matplotlib's state is changed for the caller.
"""

import io
import itertools
import math
import threading
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from matplotlib.transforms import Bbox, BboxBase

from jaxtrapolate.ops.causes import CAUSES
from jaxtrapolate.report.values import NamedMethod, fixed, named_methods, percent
from jaxtrapolate.results import Results

_INK, _SOFT, _GRID = "#24292e", "#59616a", "#d5d9dd"
_DARK = {_INK: "#e8ebee", _SOFT: "#a5adb6", _GRID: "#3a4149"}
_FONT = "DejaVu Sans"
_WIDTH = 5.4
_LOCK = threading.Lock()

_NEAR = 9  # points from a point's centre to a label beside it
_RINGS = (_NEAR, 16, 26, 38, 52, 68, 88, 112, 140, 175, 215, 260)  # points, where labels are tried
_DIRECTIONS = 16
_MOST_LABELS = 24


def _style_sheet() -> str:
    rules = [f'[style*="{kind}: {a}"]{{{kind}:{b}!important}}' for a, b in _DARK.items() for kind in ("fill", "stroke")]
    return f"<style>@media (prefers-color-scheme:dark){{{''.join(rules)}}}</style>"


def _svg(figure: Figure) -> bytes:
    """The figure as a stand-alone SVG, the same bytes for the same figure."""
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "path", "svg.hashsalt": "jaxtrapolate"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue().decode()
    start = text.index(">", text.index("<svg ")) + 1
    return (text[:start] + _style_sheet() + text[start:]).encode()


def _drawable(text: str, limit: int = 26) -> str:
    """The text as the font can draw it: without line breaks and unknown signs, and not longer than `limit`."""
    font = get_font(findfont(FontProperties(family=_FONT)))
    text = "".join(c if font.get_char_index(ord(c)) else "?" for c in " ".join(text.split()))
    return text if len(text) <= limit else text[: limit - 1] + "…"


def _axes(height: float) -> tuple[Figure, Any]:
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.grid(True, color=_GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=_INK, labelsize=10, length=0)
    axes.tick_params(which="minor", length=0)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(_SOFT)
    return figure, axes


def _labels(axes: Any, x: str, y: str) -> None:
    axes.set_xlabel(x, color=_INK, fontsize=10.5)
    axes.set_ylabel(y, color=_INK, fontsize=10.5)


def _say(axes: Any, text: str) -> None:
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, color=_SOFT, fontsize=11, ha="center", va="center", transform=axes.transAxes)


def _nothing(figure: Figure, axes: Any, text: str) -> bytes:
    _say(axes, text)
    return _svg(figure)


def _legend(figure: Figure, methods: Sequence[NamedMethod], *, line: Literal["-", "none"]) -> int:
    """One entry a method above the axes; returns in how many rows.

    Names may hold any sign, so the labels are set afterwards, as plain text.
    """
    handles = [Line2D([], [], color=m.color, marker=m.marker, markersize=6, linestyle=line) for m in methods]
    fitting = max(1, int(66 / (max(len(_drawable(m.name)) for m in methods) + 5)))
    columns = math.ceil(len(methods) / math.ceil(len(methods) / fitting))
    legend = figure.legend(
        handles, ["?"] * len(handles), loc="outside upper left", ncols=columns, frameon=False, fontsize=9.5
    )
    for text, method in zip(legend.get_texts(), methods, strict=True):
        text.set(text=_drawable(method.name), color=_INK, parse_math=False)
    return math.ceil(len(methods) / columns)


def _ceiling(values: Sequence[float]) -> tuple[list[float], float | None]:
    """The values with infinite ones put above the finite ones, and the height of those, None where there are none."""
    finite = [v for v in values if math.isfinite(v)]
    low, high = (min(finite), max(finite)) if finite else (0.0, 40.0)
    top = high + max(1.0, 0.2 * (high - low))
    lowest = low - max(1.0, 0.2 * (high - low))
    placed = [v if math.isfinite(v) else top if v > 0 else lowest for v in values]
    return placed, top if any(v == math.inf for v in values) else None


def _pareto(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points for which no other is at most as slow and at least as good, in the order of time."""
    front: list[tuple[float, float]] = []
    for x, y in sorted(points, key=lambda p: (p[0], -p[1])):
        if not front or y > front[-1][1]:
            front.append((x, y))
    return front


def _candidates(width: float, height: float) -> list[tuple[float, float, float]]:
    """Where a label of a size may have its lower left corner, relative to its point, and how far off that is."""
    places = []
    for radius in _RINGS:
        for i in sorted(range(_DIRECTIONS), key=lambda i: (i % 4 > 0, i % 2)):  # beside, above and below before askew
            angle = 2 * math.pi * i / _DIRECTIONS
            x, y = (round(f(angle), 9) for f in (math.cos, math.sin))
            # the label's nearest edge or corner is on the ring
            left = radius * x - (0.5 if x == 0 else float(x < 0)) * width
            low = radius * y - (0.5 if y == 0 else float(y < 0)) * height
            places.append((left, low, float(radius)))
    return sorted(places, key=lambda place: place[2])


def _place_labels(
    figure: Figure,
    axes: Any,
    points: Sequence[tuple[float, float]],
    texts: Sequence[str],
    stairs: Sequence[tuple[float, float]],
) -> list[Any] | None:
    """A label near each point, inside the axes, over no point and no other label; the crowded ones choose first.

    Of the free places the nearest is taken, but rather none over the stairs, or with a leader through a label. `None`,
    and no label, where there are too many for all to have a place.
    """
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()
    inner = axes.get_window_extent(renderer)
    unit = figure.dpi / 72
    centers = [tuple(axes.transData.transform(point)) for point in points]
    marks = [Bbox.from_bounds(x - 5 * unit, y - 5 * unit, 10 * unit, 10 * unit) for x, y in centers]
    corners_of_stairs = axes.transData.transform(stairs)
    lines = []
    for (left, low), (right, high) in itertools.pairwise(corners_of_stairs):
        lines += [Bbox([[left, low - 2], [right, low + 2]]), Bbox([[right - 2, low], [right + 2, high]])]
    order = sorted(range(len(points)), key=lambda i: _room(centers, i))
    if len(points) > _MOST_LABELS:
        return None
    labels: dict[int, Any] = {}
    boxes: list[Bbox] = []
    leaders: list[tuple[Any, Any]] = []
    for index in order:
        x, y = centers[index]
        label = axes.annotate(
            texts[index], points[index], (0, 0), textcoords="offset points", color=_INK, fontsize=10, ha="left"
        )
        label.set(parse_math=False, in_layout=False, va="bottom")
        labels[index] = label
        size = Text.get_window_extent(label, renderer)
        best: tuple[float, tuple[float, float] | None, Bbox, float] = (math.inf, None, size, 0.0)
        for left, low, radius in _candidates(size.width / unit, size.height / unit):
            if radius >= best[0]:
                break  # all others are further off
            box = Bbox.from_bounds(x + left * unit, y + low * unit, size.width, size.height)
            near = box.expanded(1 + 2 * unit / box.width, 1 + 2 * unit / box.height)
            if _overlap(box, inner) < 0.999 * box.width * box.height:
                continue
            if any(_overlap(near, other) for other in (*marks, *boxes)):
                continue
            if any(_crosses(box, *leader) for leader in leaders):
                continue
            far = radius > _NEAR
            through = far and any(_crosses(other, (x, y), _nearest(box, x, y)) for other in boxes)
            cost = radius + 0.15 * sum(_overlap(box, line) for line in lines) / unit**2 + 150 * through
            if cost < best[0]:
                best = (cost, (left, low), box, radius)
        if best[1] is None:
            for other in labels.values():
                other.remove()
            return None
        label.set_position(best[1])
        boxes.append(best[2])
        if best[3] > _NEAR:
            end = _nearest(best[2], x, y)
            leaders.append(((x, y), end))
            shift = ((end[0] - x) / unit, (end[1] - y) / unit)
            arrow = {"arrowstyle": "-", "color": _SOFT, "linewidth": 0.7, "shrinkA": 0, "shrinkB": 4}
            line = axes.annotate(
                "", points[index], shift, textcoords="offset points", arrowprops=arrow, annotation_clip=False
            )
            line.set(in_layout=False)
    return [labels[i] for i in range(len(points))]


def _room(centers: Sequence[tuple[float, float]], index: int) -> float:
    """How far a point is from the nearest other one."""
    return min((math.dist(centers[index], c) for i, c in enumerate(centers) if i != index), default=math.inf)


def _nearest(box: Bbox, x: float, y: float) -> tuple[float, float]:
    """The point of a box that is nearest to another."""
    return min(max(x, box.x0), box.x1), min(max(y, box.y0), box.y1)


def _crosses(box: Bbox, start: tuple[float, float], end: tuple[float, float]) -> bool:
    """Whether a line from one point to another runs through a box."""
    steps = (i / 32 for i in range(33))
    return any(box.contains(s * end[0] + (1 - s) * start[0], s * end[1] + (1 - s) * start[1]) for s in steps)


def _overlap(first: BboxBase, second: BboxBase) -> float:
    common = Bbox.intersection(first, second)
    return 0.0 if common is None else common.width * common.height


def _isolated(function: Any, *arguments: Any) -> bytes:
    """A drawing under matplotlib's own defaults, whatever the caller's settings are, which stay as they were."""
    with _LOCK, matplotlib.rc_context():
        matplotlib.rcdefaults()
        return function(*arguments)


def plot_error_time(results: Results | Mapping[str, Any]) -> bytes:
    """dB against milliseconds a frame (logarithmic), a labelled point for each method, and the Pareto front.

    On the front are the methods that no other beats in both. Infinite dB are drawn above the others and labelled so;
    methods without dB or time are not drawn. Labels cover neither points nor each other; where they are too many for
    that, a legend takes their place.

    Returns:
        SVG, UTF-8.
    """
    return _isolated(lambda methods: _svg(_error_time(methods)[0]), named_methods(results))


def _error_time(methods: Sequence[NamedMethod]) -> tuple[Figure, list[Any]]:
    """The figure, and its labels: none where a legend says which point is whose."""
    figure, axes = _axes(3.8)
    known = [(m, m.psnr, m.ms.median) for m in methods if m.psnr is not None and m.ms.median]
    if not known:
        _say(axes, "no method with both dB and run time")
        return figure, []
    drawn = [method for method, _, _ in known]
    heights, _ = _ceiling([psnr for _, psnr, _ in known])
    times = [time for _, _, time in known]
    points = list(zip(times, heights, strict=True))
    span = max(max(heights) - min(heights), 1.0)
    low, high = min(times), max(times)
    widen = max((high / low) ** 0.18, 1.6)
    axes.set_xscale("log")
    axes.set_xlim(low / widen, high * widen)
    axes.set_ylim(min(heights) - 0.18 * span, max(heights) + 0.18 * span)
    front = _pareto(points)
    stairs = [*front, (high * widen, front[-1][1])]
    axes.plot(*zip(*stairs, strict=True), drawstyle="steps-post", color=_SOFT, linewidth=1.3, dashes=(4, 3), zorder=2)
    for method, (x, y) in zip(drawn, points, strict=True):
        axes.plot([x], [y], marker=method.marker, color=method.color, markersize=9, linestyle="none", zorder=3)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high / low < 300 else (1,)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10], min_n_ticks=4))
    _labels(axes, "milliseconds a frame (median, log)", "PSNR, dB")
    texts = [_drawable(m.name) + (f" ({fixed(psnr)} dB)" if math.isinf(psnr) else "") for m, psnr, _ in known]
    axes.set_title("dashed: Pareto front", loc="right", color=_SOFT, fontsize=8.5, pad=4)
    labels = _place_labels(figure, axes, points, texts, stairs)
    if labels is None:
        rows = _legend(figure, drawn, line="none")
        figure.set_figheight(figure.get_figheight() + 0.2 * rows)
    return figure, labels or []


def plot_causes(results: Results | Mapping[str, Any]) -> bytes:
    """dB by cause: a row for each cause that occurs, with its share of the pixels, and a mark for each method.

    Returns:
        SVG, UTF-8.
    """
    return _isolated(_causes, named_methods(results))


def _causes(methods: Sequence[NamedMethod]) -> bytes:
    drawn = [m for m in methods if any(m.psnr_of(c) is not None for c in CAUSES)]
    causes = [c for c in CAUSES if any(m.psnr_of(c) is not None for m in drawn)]
    if not causes:
        return _nothing(*_axes(1.6), "no dB by cause")
    figure, axes = _axes(0.42 * len(causes) + 1.0 + 0.12 * len(drawn))
    placed, top = _ceiling([v for m in drawn for c in causes if (v := m.psnr_of(c)) is not None])
    heights = iter(placed)
    marks = {(m.name, c): next(heights) for m in drawn for c in causes if m.psnr_of(c) is not None}
    for row, cause in enumerate(causes):
        found = [marks[m.name, cause] for m in drawn if (m.name, cause) in marks]
        axes.plot([min(found), max(found)], [row, row], color=_SOFT, linewidth=1.2, zorder=2)
    for index, method in enumerate(drawn):
        rows = [row for row, cause in enumerate(causes) if (method.name, cause) in marks]
        values = [marks[method.name, causes[row]] for row in rows]
        axes.plot(
            values, rows, marker=method.marker, color=method.color, markersize=8, linestyle="none", zorder=3 + index
        )
    names = []
    for cause in causes:
        shares = [s for m in drawn if cause in m.by_cause and (s := m.by_cause[cause].share) is not None]
        names.append(f"{cause}, {percent(shares[0])}" if shares else cause)
    axes.set_yticks(range(len(causes)), names)
    axes.set_ylim(len(causes) - 0.5, -0.5)
    axes.grid(False, axis="y")
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10], min_n_ticks=4))
    _labels(axes, "PSNR, dB" + ("" if top is None else " (rightmost: infinite)"), "")
    _legend(figure, drawn, line="none")
    return _svg(figure)


def plot_frames(results: Results | Mapping[str, Any]) -> bytes:
    """dB over the scored frames, a line for each method; a gap where a frame has none.

    Returns:
        SVG, UTF-8.
    """
    return _isolated(_frames, named_methods(results))


def _frames(methods: Sequence[NamedMethod]) -> bytes:
    figure, axes = _axes(3.4)
    drawn = [m for m in methods if any(f.psnr is not None for f in m.frames)]
    if not drawn:
        return _nothing(figure, axes, "no dB by frame")
    placed, top = _ceiling([f.psnr for m in drawn for f in m.frames if f.psnr is not None])
    heights = iter(placed)
    for method in drawn:
        values = [math.nan if f.psnr is None else next(heights) for f in method.frames]
        size = 6 if len(values) <= 30 else 0
        numbers = [f.number for f in method.frames]
        axes.plot(numbers, values, color=method.color, marker=method.marker, markersize=size, linewidth=1.8)
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True, min_n_ticks=1))
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10], min_n_ticks=4))
    _labels(axes, "frame", "PSNR, dB" + ("" if top is None else " (top: infinite)"))
    _legend(figure, drawn, line="-")
    return _svg(figure)
