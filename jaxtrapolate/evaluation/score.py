"""Scores of frames that were held back: whole and by cause, and their means over frames and inputs."""

import math
from collections.abc import Callable, Iterable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrapolate.checks import ArrayLike, check_present
from jaxtrapolate.evaluation.windows import Window
from jaxtrapolate.files import Sequence, around
from jaxtrapolate.methods.frames import rendered
from jaxtrapolate.metrics import Metric, psnr
from jaxtrapolate.metrics import load as load_metric
from jaxtrapolate.ops.causes import CAUSES, cause_map
from jaxtrapolate.ops.depth import surfaces_of
from jaxtrapolate.ops.jitter import on_own_pixels
from jaxtrapolate.ops.motion import chain_motion
from jaxtrapolate.ops.radiance import srgb_encode, tonemap
from jaxtrapolate.ops.visibility import disoccluded
from jaxtrapolate.records import Frame, replace
from jaxtrapolate.results import CauseScore, FrameScore, MethodResult, RunTime

DEFAULT_METRICS = ("psnr", "ssim")
"""What is scored where nothing else is named; "psnr" always is, for it is told apart by cause."""


def display(color: Float[ArrayLike, "h w 3"], *, hdr: bool) -> Float[Array, "h w 3"]:
    """The image in which scores are taken: HDR after x / (1 + x) and gamma 1 / 2.2, 8-bit input in sRGB."""
    return tonemap(color) if hdr else srgb_encode(jnp.clip(color, 0, 1))


def truth_for(window: Window, image: Float[ArrayLike, "h w 3"]) -> Frame:
    """The true frame of the size of an image.

    Raises:
        ValueError: there is none.
    """
    sizes = []
    for truth in (window.truth, window.larger):
        if truth is not None and truth.color is not None:
            if truth.color.shape[:2] == image.shape[:2]:
                return truth
            sizes.append(f"{truth.color.shape[1]}x{truth.color.shape[0]}")
    raise ValueError(f"image: expected a size of {' or '.join(sizes)}, got {image.shape[1]}x{image.shape[0]}")


def causes_of(sequence: Sequence, window: Window, *, larger: bool = False) -> np.ndarray | None:
    """The `cause_map` of a window: exact holes where the sequence knows its 3D flow, else by the hole masks.

    The source is the newest rendered frame; the exact holes are those between neighbours of the numbering, so several
    held-back frames in a row have their causes by the masks, and so has the size of the output where `larger` is set.
    `None` without motion vectors.
    """
    newest = rendered(window.history)[0]
    between, source_frame = window.history[newest + 1 :], window.history[newest]
    truth, motion = window.truth, window.target.motion
    if larger:
        if sequence.larger is None or window.larger is None:
            raise ValueError("larger: expected a sequence that has larger frames")
        run = around(sequence, window.number, before=len(window.history) - newest)
        source_frame, *between = (jax.device_put(sequence.larger.frame(n)) for n in run[:-1])
        truth, motion = window.larger, window.larger.motion
    if motion is None or any(frame.motion is None for frame in between):
        return None
    frames = on_own_pixels((source_frame, *between, replace(truth, motion=motion)))
    motion = check_present("motion", frames[-1].motion, needed_by="causes")
    for frame in reversed(frames[1:-1]):
        motion = chain_motion(motion, check_present("motion", frame.motion, needed_by="causes"))
    hidden, metric = None, sequence.depth == "metric"
    if metric and not between and not larger:
        previous, number = around(sequence, window.number, before=1)
        target, source = sequence.keyframe(number), sequence.keyframe(previous)
        if target is not None and source is not None:
            exact = target.backward_flow is not None and source.depth is not None
            target, source = surfaces_of(target, truth), surfaces_of(source, source_frame)
            hidden = disoccluded(replace(target, color=None), replace(source, color=None)) if exact else None
    return np.asarray(cause_map(truth, source_frame, motion, hidden=hidden, metric_depth=metric))


def score(
    image: Array,
    window: Window,
    causes: np.ndarray | None,
    invalid: np.ndarray | None,
    *,
    hdr: bool,
    metrics: Iterable[Metric] | None = None,
    distance: int = 1,
    ms: float | None = None,
) -> FrameScore:
    """PSNR of a generated frame, whole and by cause, and its other metrics; psnr and ssim where none are named.

    Pixels that were not finite in the input are left out. A metric that cannot be had (a frame smaller than its window)
    is None, and `unscored` says why. Metrics of clips are not for here.
    """
    color = check_present("truth.color", truth_for(window, image).color, needed_by="score")
    spaces = {"display": (display(image, hdr=hdr), display(color, hdr=hdr)), "linear": (image, color)}
    generated, truth = spaces["display"]
    valid = np.ones((*generated.shape[:2], 1), bool) if invalid is None else ~invalid[..., None]
    found: dict[str, float | None] = {}
    unscored: dict[str, str] = {}
    for metric in map(load_metric, DEFAULT_METRICS) if metrics is None else metrics:
        if metric.name == "psnr" or metric.per == "clip":
            continue
        try:
            found[metric.name] = metric(*spaces[metric.space], mask=None if invalid is None else valid)
        except ValueError as error:
            found[metric.name], unscored[metric.name] = None, str(error)
    by_cause = {}
    for i, cause in enumerate(CAUSES if causes is not None else ()):
        mask = (np.asarray(causes)[..., None] == i) & valid
        if mask.any():
            by_cause[cause] = CauseScore(float(psnr(generated, truth, mask=mask)), float(mask.mean()))
    whole = float(psnr(generated, truth, mask=valid))
    return FrameScore(window.number, distance, whole, found, by_cause, ms, unscored)


def _mean(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def mean_over_frames(
    frames: list[FrameScore],
    *,
    rendered: Iterable[FrameScore] = (),
    metrics: Iterable[str] = DEFAULT_METRICS,
) -> MethodResult:
    """Means of the scores of several frames; a cause's dB over the frames in which it occurs, its share over all.

    Args:
        frames: generated ones.
        rendered: those that were super sampled: they count for `by_distance` alone, as distance 0.
        metrics: names.
    """
    by_cause = {}
    for cause in CAUSES:
        found = [f.by_cause[cause] for f in frames if cause in f.by_cause]
        if found:
            share = sum(c.share or 0.0 for c in found) / len(frames)
            by_cause[cause] = CauseScore(_mean(c.psnr for c in found), share)
    rendered = tuple(rendered)
    every = (*rendered, *frames)
    apart = {d: _mean(f.psnr for f in every if f.distance == d) for d in sorted({f.distance for f in every})}
    spent = [f.ms for f in frames if f.ms is not None]
    low, median, high = (float(q) for q in np.percentile(spent, (25, 50, 75))) if spent else (None, None, None)
    return MethodResult(
        psnr=_mean(f.psnr for f in frames),
        metrics={n: _mean(f.metrics.get(n) for f in frames) for n in metrics if n != "psnr"},
        ms=RunTime(median, None if high is None or low is None else high - low),
        by_cause=by_cause,
        by_distance=apart if len(apart) > 1 else {},
        frames=tuple(frames),
        rendered=rendered,
    )


def mean_over_inputs(
    inputs: list[Mapping[str, MethodResult]], *, metrics: Iterable[str] = DEFAULT_METRICS
) -> dict[str, MethodResult]:
    """Means of what `mean_over_frames` gave for each method on several inputs, on equal footing.

    Args:
        inputs: for each input its methods' scores by name.
        metrics: names.

    Returns:
        For each method what it had for one input. Only inputs on which all methods ran and none was exact (still
        frames: infinite dB) count; where there is none such, those on which all ran, or else all inputs. `inputs` is
        how many. Where a score of some method is infinite or not there, the input has no part in the mean of that score
        for all methods. A cause's dB is the mean over the inputs in which it occurs, its share over all that count.
        Compilation is the sum over all inputs.
    """
    names = list(dict.fromkeys(name for methods in inputs for name in methods))
    shared = [i for i in inputs if all(name in i for name in names)] or inputs
    shared = [i for i in shared if not any(m.psnr == math.inf for m in i.values())] or shared

    def means(pick: Callable[[MethodResult], float | None], of: list[str] = names) -> dict[str, float | None]:
        rows = [{n: pick(i[n]) for n in of if n in i} for i in shared]
        rows = [r for r in rows if all(v is not None for v in r.values())]
        rows = [r for r in rows if all(v is not None and math.isfinite(v) for v in r.values())] or rows
        return {n: _mean(r[n] for r in rows if n in r) for n in of}

    whole = means(lambda m: m.psnr)
    others = {k: means(lambda m, k=k: m.metrics.get(k)) for k in dict.fromkeys(metrics) if k != "psnr"}
    found: dict[str, dict[str, CauseScore]] = {n: {} for n in names}
    for cause in CAUSES:
        here = [i for i in shared if any(cause in m.by_cause for m in i.values())]
        decibels = means(lambda m, c=cause: m.by_cause[c].psnr if c in m.by_cause else None)
        for name in names if here else ():
            shares = [
                (i[name].by_cause[cause].share if cause in i[name].by_cause else 0.0) for i in shared if name in i
            ]
            found[name][cause] = CauseScore(decibels[name], _mean(shares))
    distances = sorted({d for i in shared for m in i.values() for d in m.by_distance})
    having = {d: [n for n in names if any(d in i[n].by_distance for i in shared if n in i)] for d in distances}
    apart = {d: means(lambda m, d=d: m.by_distance.get(d), having[d]) for d in distances}

    def result(name: str) -> MethodResult:
        spent = [i[name].ms for i in shared if name in i]
        compiled = [i[name].ms.compile or 0.0 for i in inputs if name in i]
        cached = any(i[name].ms.cached for i in inputs if name in i)
        return MethodResult(
            psnr=whole[name],
            metrics={k: v[name] for k, v in others.items()},
            ms=RunTime(_mean(s.median for s in spent), _mean(s.iqr for s in spent), sum(compiled), cached=cached),
            by_cause=found[name],
            by_distance={d: v[name] for d, v in apart.items() if name in v},
            inputs=sum(name in i for i in shared),
        )

    return {name: result(name) for name in names}
