"""A picture of lag: which animation time is on the display at which time."""

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxtrapolate.latency import Timeline

_INK, _SOFT, _GRID = "#24292e", "#59616a", "#d5d9dd"
_RENDERED, _GENERATED = "#0b6fb8", "#c4541c"


def plot_latency(timelines: Mapping[str, Timeline], *, steps: int = 4) -> Figure:
    """Animation time (up) against display time (to the right), one panel for each timeline, all on the same axes.

    A frame is a bar at its animation time, from the refresh at which it appears to that of the next; vertical lines are
    the refreshes. The dotted diagonal is a display without lag: the thin line from it to a rendered frame is its way
    from the sampling of its input to the display. Even motion is a stair with equal treads and risers.

    Args:
        timelines: of `jaxtrapolate.latency.simulate`, by the titles of the panels.
        steps: rendered frames drawn of each, at least 1.

    Returns:
        A figure of its own canvas, to be saved with `savefig`; pyplot and the caller's settings are not touched.

    Raises:
        ValueError: no timelines, or less than one step.

    References:
        Yang et al. 2011, Figure 6.
    """
    if not timelines:
        raise ValueError("timelines: expected at least one, got none")
    if steps < 1:
        raise ValueError(f"steps: expected at least 1, got {steps}")
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        return _draw(timelines, steps)


def _draw(timelines: Mapping[str, Timeline], steps: int) -> Figure:
    columns = min(len(timelines), 3)
    rows = -(-len(timelines) // columns)
    figure = Figure(figsize=(3.4 * columns + 0.4, 2.9 * rows + 0.5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes in panels[len(timelines) :]:
        axes.set_axis_off()
    for axes, (title, timeline) in zip(panels, timelines.items(), strict=False):
        _panel(axes, timeline, steps)
        axes.set_title("", fontsize=10, color=_INK, loc="left").set(text=title, parse_math=False)
    for axes in panels[max(0, len(timelines) - columns) : len(timelines)]:
        axes.set_xlabel("display time, ms", color=_INK, fontsize=10)
        axes.tick_params(labelbottom=True)
    for axes in panels[::columns]:
        axes.set_ylabel("animation time, ms", color=_INK, fontsize=10)
    handles = [
        Line2D([], [], color=_RENDERED, linewidth=4, label="rendered"),
        Line2D([], [], color=_GENERATED, linewidth=4, label="generated"),
        Line2D([], [], color=_SOFT, linewidth=1, linestyle=":", label="no lag"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=3, frameon=False, fontsize=9.5)
    return figure


def _panel(axes: Any, timeline: Timeline, steps: int) -> None:
    stop = int(np.searchsorted(timeline.number, timeline.number[0] + steps))
    ends = np.append(timeline.display[1:], timeline.display[-1] + timeline.hold * timeline.interval)
    origin = timeline.input[0]
    start, end = timeline.display[:stop] - origin, ends[:stop] - origin
    height, rendered = timeline.animation[:stop] - origin, timeline.rendered[:stop]
    first, last = (int(np.floor(t / timeline.interval + 1e-9)) for t in (origin, end[-1] + origin))
    for refresh in range(first, last + 1):
        axes.axvline(refresh * timeline.interval - origin, color=_GRID, linewidth=0.7, zorder=0)
    axes.plot([0, end[-1]], [0, end[-1]], color=_SOFT, linewidth=1, linestyle=":", zorder=1)
    axes.hlines(height[rendered], height[rendered], start[rendered], color=_RENDERED, linewidth=0.8, zorder=1)
    for kind, color in ((rendered, _RENDERED), (~rendered, _GENERATED)):
        axes.hlines(height[kind], start[kind], end[kind], color=color, linewidth=4, zorder=2)
    axes.set_ylim(-0.06 * height[-1] - 1, height[-1] * 1.1 + 1)
    axes.tick_params(colors=_INK, labelsize=9, length=0)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(_SOFT)
