"""Lag and pacing: when frames that are rendered and generated reach the display, and what they show there.

A GPU works on one thing at a time, the display swaps at its refreshes only, and each rendered frame is shown as `shown`
frames: itself and what is generated around it. `simulate` plays that through, `summarize` measures it,
`presentation_latency` and `additional_lag` are the closed formulas of the papers, `jaxtrapolate.latency.plot` draws.

Convention: milliseconds; t counts rendered frames, t + j / shown names a generated one. Host code in NumPy.

References:
    Yang et al. 2011 (Bidirectional Scene Reprojection), section 7, Figures 5 and 6: animation time, render-ahead queue,
    partitioned rendering. PatchEX 2024, section 2.2, Figure 2, Table 1: presentation latency.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxtrapolate.checks import check_choice

Generation = Literal["none", "interpolation", "extrapolation"]
Clock = Literal["vsync", "printed"]
Number = float | int

_METHODS = ("none", "interpolation", "extrapolation")
_EPSILON = 1e-9  # of a refresh: work that ends on a refresh is in time for it


@dataclass(frozen=True)
class Timeline:
    """The shown frames in their order, in milliseconds.

    Attributes:
        number: t of a rendered frame, t + j / shown of a generated one.
        rendered: whether the frame was rendered.
        animation: the time that the frame depicts. For a rendered frame that is when its input was sampled; between
            two of them for an interpolated one; behind one, by the planned steps, for an extrapolated one.
        input: when the newest input was sampled that has a part in the frame.
        finished: when the GPU had finished it; for a rendered frame, its rendering.
        display: the refresh at which it appears.
        interval: between two refreshes.
        hold: for how many refreshes a frame is planned to stay.
        busy: the GPU's share of the time from the first to the last of the frames, 1 = always at work.
    """

    number: Float[np.ndarray, " frames"]
    rendered: Bool[np.ndarray, " frames"]
    animation: Float[np.ndarray, " frames"]
    input: Float[np.ndarray, " frames"]
    finished: Float[np.ndarray, " frames"]
    display: Float[np.ndarray, " frames"]
    interval: float
    hold: int
    busy: float

    @property
    def lag(self) -> Float[np.ndarray, " frames"]:
        """Display time minus animation time: how old what is seen looks."""
        return self.display - self.animation

    @property
    def latency(self) -> Float[np.ndarray, " frames"]:
        """Display time minus input time: how old the newest input is that is seen."""
        return self.display - self.input

    @property
    def waiting(self) -> Float[np.ndarray, " frames"]:
        """Display time minus the time when the frame was finished: P of PatchEX, for rendered frames."""
        return self.display - self.finished

    @property
    def late(self) -> Int[np.ndarray, " steps"]:
        """For how many refreshes too long each frame but the last stayed."""
        stayed = np.rint(np.diff(self.display) / self.interval).astype(int)
        return np.maximum(stayed - self.hold, 0)


@dataclass(frozen=True)
class Summary:
    """Measures of a timeline; times in milliseconds, rates in frames per second.

    "All frames" are those behind the first, so that each rendered frame counts with what was generated for it.

    Attributes:
        latency_mean, latency_worst: from the sampling of the newest input in a frame to its display, over all frames.
        lag_mean, lag_worst: from a frame's animation time to its display, over all frames.
        waiting_mean, waiting_worst: of rendered frames between being finished and being displayed.
        reaction_mean, reaction_worst: from an event to the first frame that knows of it: it waits for the next sampling
            of the input, then for the display. The mean is over events at any time, the worst comes just too late.
        missed: refreshes at which a frame stayed for longer than planned.
        irregularity: standard deviation of the step of the animation minus the step of the display; 0 = even motion.
        shown_rate, rendered_rate: frames that are shown, and rendered, in a second.
        busy: the GPU's share of the time.
    """

    latency_mean: float
    latency_worst: float
    lag_mean: float
    lag_worst: float
    waiting_mean: float
    waiting_worst: float
    reaction_mean: float
    reaction_worst: float
    missed: int
    irregularity: float
    shown_rate: float
    rendered_rate: float
    busy: float


def additional_lag(shown: int, *, ahead: int = 0) -> float:
    """What partitioned interpolation adds to the lag of rendered frames, in steps from one of them to the next.

    (shown - 1) / shown with double buffering; with a render-ahead queue (1 - ahead) times that: each place in the queue
    costs a whole step where only rendered frames are shown, and the time of one shown frame where generated ones are
    between. So it vanishes for `ahead=1`, and is a gain beyond.

    Args:
        shown: frames shown for each rendered one.
        ahead: places in the render-ahead queue, 0 = double buffering.

    Raises:
        ValueError: `shown` is less than 1, or `ahead` negative.

    References:
        Yang et al. 2011, section 7, for 0 and 1; the rest follows from the same schedule.
    """
    _check_count("shown", shown, 1)
    _check_count("ahead", ahead, 0)
    return (1 - ahead) * (shown - 1) / shown


def presentation_latency(
    render: Number, *, refresh_rate: Number, method: Generation, shown: int = 2, clock: Clock = "vsync"
) -> float:
    """From the end of a frame's rendering to its display, in milliseconds, where every frame is in time.

    With D the time between refreshes and R that of rendering, rendering starts at a refresh, and the frame is shown
    shown * D later: P = shown D - R. Interpolation shows the shown - 1 frames before it first:
    P = (2 shown - 1) D - R.

    Args:
        render: R, at most shown * D.
        refresh_rate: in Hz, 1000 / D.
        method: "none" is as "extrapolation" of one frame.
        shown: frames shown for each rendered one; 1 for "none".
        clock: "vsync", as above; "printed": as in PatchEX, where interpolation is shown at refreshes (3 D - R), but
            extrapolation as soon as it is rendered (0, "without slack"), for two frames.

    Raises:
        ValueError: an unknown method or clock, a time that is not positive, a rendering that takes longer than its
            frames are shown, or "printed" with another `shown` than 2.

    References:
        PatchEX 2024, Table 1: its two rows are measured by different clocks.
    """
    check_choice("method", method, _METHODS)
    check_choice("clock", clock, ("vsync", "printed"))
    _check_count("shown", shown, 1)
    _check_time("refresh_rate", refresh_rate, positive=True)
    _check_time("render", render, positive=True)
    if clock == "printed" and (shown != 2 or method == "none"):
        raise ValueError(f"clock: 'printed' is for two frames shown, generated one of them, got {shown} and {method!r}")
    interval, shown = 1000 / refresh_rate, 1 if method == "none" else shown
    if render > shown * interval * (1 + _EPSILON):
        raise ValueError(
            f"render: expected at most {shown * interval:g} ms, the time of {shown} frames, got {render:g}"
        )
    if method == "interpolation":
        return (2 * shown - 1) * interval - render
    return 0.0 if clock == "printed" else shown * interval - render


def simulate(
    render: Number | Float[np.ndarray, " rendered"],
    *,
    refresh_rate: Number,
    method: Generation = "none",
    shown: int = 2,
    generate: Number = 0.0,
    partitioned: bool = True,
    ahead: int = 0,
    hold: int | None = None,
    frames: int = 64,
) -> Timeline:
    """Plays rendering, generation and display of a sequence through.

    Partitioned, each refresh period holds one share of a rendering and the generation of one frame, shares being such
    that the periods are as even as they can be; the GPU begins with the next when a frame is displayed, as there are
    two buffers. Not partitioned, a frame is rendered in one go, the frames generated with it follow at once and wait
    for their refreshes in a queue of buffers; the GPU begins with the next when the first of them is displayed, or when
    it has finished, if that is later. The sequence starts in the steady state: the first render time holds before it.

    Args:
        render: milliseconds for each rendered frame `[rendered]`, or one number for all.
        refresh_rate: of the display, in Hz.
        method: "interpolation" shows what is generated between a frame and the one before it ahead of the frame,
            "extrapolation" after it, "none" shows rendered frames alone.
        shown: frames shown for each rendered one, 1 generates none; "none" means 1.
        generate: milliseconds to generate a frame.
        partitioned: whether rendering is split over the frames that are shown; it needs an engine that can.
        ahead: places in the driver's render-ahead queue: input is sampled when the GPU begins the work that many
            submissions before: frames shown if partitioned, frames rendered if not. 0 is double buffering.
        hold: for how many refreshes a frame is planned to stay; by default as few as the mean work allows.
        frames: how many are rendered, where `render` is one number.

    Returns:
        The shown frames from the first to the last rendered one. A frame that is late stays away until it is there, and
        the one before it stays on the display: a missed refresh. Nothing is left out, and nothing generated in excess.

    Raises:
        TypeError, ValueError: times that are not finite and positive (`generate`: not negative), counts below 1
            (`ahead`: 0), less than two rendered frames, an unknown method.
    """
    check_choice("method", method, _METHODS)
    for name, value, least in (("shown", shown, 1), ("ahead", ahead, 0), ("frames", frames, 2)):
        _check_count(name, value, least)
    _check_time("refresh_rate", refresh_rate, positive=True)
    _check_time("generate", generate)
    times = np.full(frames, float(render)) if np.ndim(render) == 0 else np.asarray(render, np.float64)
    if times.ndim != 1 or len(times) < 2:
        raise ValueError(f"render: expected a number or [rendered], at least 2, got shape {list(times.shape)}")
    for value in times:
        _check_time("render", float(value), positive=True)
    count, interval = 1 if method == "none" else shown, 1000 / float(refresh_rate)
    work = times.mean() + (count - 1) * generate
    if hold is None:
        hold = max(1, _refreshes(work / count / interval))
    _check_count("hold", hold, 1)
    run = _slots if partitioned else _batches
    interpolates = method == "interpolation" and count > 1
    # refresh of each frame from t = 0 on, when it was finished, and when each rendered frame's input was sampled
    refresh, finished, sampled, busy = run(
        times, count, float(generate), interpolates, ahead, hold=hold, interval=interval
    )
    begin = math.floor(sampled[0] / interval + _EPSILON)  # the clock starts at the refresh before the first input
    refresh, finished, sampled = refresh - begin, finished - begin * interval, sampled - begin * interval
    number = np.arange((len(times) - 1) * count + 1)
    before, step = np.divmod(number, count)
    rendered, after = step == 0, np.minimum(before + 1, len(times) - 1)
    if interpolates:
        animation = sampled[before] + step / count * (sampled[after] - sampled[before])
        newest = np.where(rendered, sampled[before], sampled[after])
    else:
        animation, newest = sampled[before] + step * hold * interval, sampled[before]
    return Timeline(
        number / count, rendered, animation, newest, finished, refresh * interval, interval, int(hold), float(busy)
    )


def _slots(times, count, generate, interpolates, ahead, *, hold, interval):
    """Partitioned: one shown frame s = t * count + j after the other; t's rendering ends with the frame that needs it
    first: itself, or the first that is interpolated before it."""
    lead = 2 if interpolates else 1
    last = (len(times) - 1) * count
    refresh, begun, shares, works = 0, {}, {}, {}
    found, finished = {}, {}
    for s in range(count * -lead + lead - ahead, last + 1):
        t = (s - lead) // count + lead
        render = times[min(max(t, 0), len(times) - 1)]
        even = max(0.0, (render + (count - 1) * generate) / count - generate)
        shares[s] = even if s % count else render - (count - 1) * even
        works[s] = shares[s] + (generate if s % count else 0.0)
        begun[s] = refresh * interval
        refresh += max(hold, _refreshes(works[s] / interval))
        found[s], finished[s] = refresh, begun[s] + works[s]
    for t in range(len(times)):
        s = count * (t - lead + 1) + lead - 1
        finished[t * count] = begun[s] + shares[s]
    first = [count * (t - lead) + lead - ahead for t in range(len(times))]
    sampled = np.array([begun[s] for s in first])
    numbers = range(last + 1)
    busy = sum(works[s] for s in numbers[1:]) / ((found[last] - found[0]) * interval)
    return *(np.array([values[s] for s in numbers]) for values in (found, finished)), sampled, busy


def _batches(times, count, generate, interpolates, ahead, *, hold, interval):
    """In one go: a frame is rendered, then those that are generated with it, and all wait for their refreshes."""
    refresh, start, free = 0, 0.0, 0.0
    begun, found, finished = {}, {}, {}
    for t in range(-2 - ahead, len(times)):
        render = times[max(t, 0)]
        begun[t] = start = max(free, start)
        free = start + render + (count - 1) * generate
        ready = {t * count: start + render}
        base = (t - 1) * count if interpolates else t * count
        ready |= {base + j: start + render + j * generate for j in range(1, count)}
        finished |= ready
        for i, s in enumerate(sorted(ready)):
            refresh = max(refresh + hold, _refreshes(ready[s] / interval))
            found[s] = refresh
            start = refresh * interval if i == 0 else start
    sampled = np.array([begun[t - ahead] for t in range(len(times))])
    numbers = range((len(times) - 1) * count + 1)
    work = sum(times[1:]) + (len(times) - 1) * (count - 1) * generate
    busy = work / ((found[numbers[-1]] - found[0]) * interval)
    return *(np.array([values[s] for s in numbers]) for values in (found, finished)), sampled, busy


def summarize(timeline: Timeline) -> Summary:
    """Latency, lag, missed refreshes and pacing of a timeline.

    Args:
        timeline: of `simulate`, or measured on an engine.

    Raises:
        ValueError: less than two rendered frames, or a first frame that was generated.
    """
    rendered = timeline.rendered
    if rendered.sum() < 2:
        raise ValueError(f"timeline: expected at least 2 rendered frames, got {int(rendered.sum())}")
    if not rendered[0]:
        raise ValueError("timeline: expected a rendered frame first, got a generated one")
    sampled = timeline.input[rendered]
    seen = np.array([timeline.display[timeline.input >= s].min() for s in sampled[1:]])  # first frame that knows of it
    gaps = np.diff(sampled)
    uneven = np.diff(timeline.animation) - np.diff(timeline.display)
    seconds = (timeline.display[-1] - timeline.display[0]) / 1000
    latency, lag, waiting = timeline.latency[1:], timeline.lag[1:], timeline.waiting[1:][rendered[1:]]
    return Summary(
        latency_mean=float(latency.mean()),
        latency_worst=float(latency.max()),
        lag_mean=float(lag.mean()),
        lag_worst=float(lag.max()),
        waiting_mean=float(waiting.mean()),
        waiting_worst=float(waiting.max()),
        reaction_mean=float(np.sum((seen - sampled[1:] + gaps / 2) * gaps) / gaps.sum()),
        reaction_worst=float(np.max(seen - sampled[:-1])),
        missed=int(timeline.late.sum()),
        irregularity=float(uneven.std()),
        shown_rate=float((len(timeline.number) - 1) / seconds),
        rendered_rate=float((rendered.sum() - 1) / seconds),
        busy=timeline.busy,
    )


def _refreshes(periods: float) -> int:
    return math.ceil(periods - _EPSILON)


def _check_count(name: str, value: Any, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name}: expected an integer, got {value!r}")
    if value < least:
        raise ValueError(f"{name}: expected at least {least}, got {value}")


def _check_time(name: str, value: Number, *, positive: bool = False) -> None:
    if not math.isfinite(value) or value < 0 or (positive and value == 0):
        raise ValueError(f"{name}: expected a {'positive' if positive else 'non-negative'} number, got {value}")


__all__ = [
    "Clock",
    "Generation",
    "Summary",
    "Timeline",
    "additional_lag",
    "presentation_latency",
    "simulate",
    "summarize",
]
