"""Scores of frames that were held back: whole and by cause, and their means over frames and inputs."""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrapolate.checks import ArrayLike, check_present
from jaxtrapolate.evaluation.windows import Window
from jaxtrapolate.files import Sequence, around
from jaxtrapolate.metrics import Metric, psnr
from jaxtrapolate.metrics import load as load_metric
from jaxtrapolate.ops.causes import CAUSES, cause_map, disoccluded
from jaxtrapolate.ops.depth import surfaces_of
from jaxtrapolate.ops.radiance import srgb_encode, tonemap
from jaxtrapolate.records import replace

DEFAULT_METRICS = ("psnr", "ssim")
"""What is scored where nothing else is named; "psnr" always is, for it is told apart by cause."""


def display(color: Float[ArrayLike, "h w 3"], *, hdr: bool) -> Float[Array, "h w 3"]:
    """The image in which scores are taken: HDR after x / (1 + x) and gamma 1 / 2.2, 8-bit input in sRGB."""
    return tonemap(color) if hdr else srgb_encode(jnp.clip(color, 0, 1))


def causes_of(sequence: Sequence, window: Window) -> np.ndarray | None:
    """The `cause_map` of a window: exact holes where the sequence knows its 3D flow, else by the hole masks.

    `None` without motion vectors.
    """
    motion = window.target.motion
    if motion is None:
        return None
    previous, number = around(sequence, window.number, before=1)
    target, source = sequence.keyframe(number), sequence.keyframe(previous)
    hidden, metric = None, sequence.depth == "metric"
    if metric and target is not None and source is not None:
        exact = target.backward_flow is not None and source.depth is not None
        target, source = surfaces_of(target, window.truth), surfaces_of(source, window.history[-1])
        hidden = disoccluded(replace(target, color=None), replace(source, color=None)) if exact else None
    return np.asarray(cause_map(window.truth, window.history[-1], motion, hidden=hidden, metric_depth=metric))


def score(
    image: Array,
    window: Window,
    causes: np.ndarray | None,
    invalid: np.ndarray | None,
    *,
    hdr: bool,
    metrics: Iterable[Metric] | None = None,
) -> dict[str, Any]:
    """PSNR of a made frame, whole and by cause, and its other metrics; psnr and ssim where none are named.

    Pixels that were not finite in the input are left out. A metric that cannot be had (a frame smaller than its window)
    is None, and "unscored" says why. Metrics of clips are not for here.
    """
    color = check_present("truth.color", window.truth.color, needed_by="score")
    spaces = {"display": (display(image, hdr=hdr), display(color, hdr=hdr)), "linear": (image, color)}
    made, truth = spaces["display"]
    valid = np.ones((*made.shape[:2], 1), bool) if invalid is None else ~invalid[..., None]
    result: dict[str, Any] = {"number": window.number, "psnr": float(psnr(made, truth, mask=valid))}
    for metric in map(load_metric, DEFAULT_METRICS) if metrics is None else metrics:
        if metric.name == "psnr" or metric.per == "clip":
            continue
        try:
            result[metric.name] = metric(*spaces[metric.space], mask=None if invalid is None else valid)
        except ValueError as error:
            result[metric.name] = None
            result.setdefault("unscored", {})[metric.name] = str(error)
    result["by_cause"] = {}
    if causes is None:
        return result
    for i, cause in enumerate(CAUSES):
        mask = (causes[..., None] == i) & valid
        if mask.any():
            decibels = float(psnr(made, truth, mask=mask))
            result["by_cause"][cause] = {"psnr": decibels, "share": float(mask.mean())}
    return result


def _mean(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def mean_over_frames(frames: list[dict], *, metrics: Iterable[str] = DEFAULT_METRICS) -> dict[str, Any]:
    """Means of the scores of several frames; a cause's dB over the frames in which it occurs, its share over all."""
    by_cause = {}
    for cause in CAUSES:
        found = [f["by_cause"][cause] for f in frames if cause in f["by_cause"]]
        if found:
            share = sum(f["share"] for f in found) / len(frames)
            by_cause[cause] = {"psnr": _mean(f["psnr"] for f in found), "share": share}
    names = dict.fromkeys(("psnr", *metrics))
    return {n: _mean(f.get(n) for f in frames) for n in names} | {"by_cause": by_cause}


def mean_over_inputs(
    inputs: list[Mapping[str, Any]], *, metrics: Iterable[str] = DEFAULT_METRICS
) -> dict[str, dict[str, Any]]:
    """Means of what `mean_over_frames` gave for each method on several inputs, on equal footing.

    Args:
        inputs: for each input its methods' scores by name, with "ms" as {"median", "iqr", "compile"}.
        metrics: names.

    Returns:
        For each method what it had for one input. Only inputs on which all methods ran and none was exact (still
        frames: infinite dB) count; where there is none such, those on which all ran, or else all inputs. "inputs" is
        how many. Where a score of some method is infinite or not there, the input has no part in the mean of that score
        for all methods. A cause's dB is the mean over the inputs in which it occurs, its share over all that count.
        Compilation is the sum over all inputs.
    """
    names = list(dict.fromkeys(name for methods in inputs for name in methods))
    shared = [i for i in inputs if all(name in i for name in names)] or inputs
    shared = [i for i in shared if not any(m["psnr"] == math.inf for m in i.values())] or shared

    def means(pick: Callable[[Any], float | None]) -> dict[str, float | None]:
        rows = [{n: pick(i[n]) for n in names if n in i} for i in shared]
        rows = [r for r in rows if all(v is not None for v in r.values())]
        rows = [r for r in rows if all(v is not None and math.isfinite(v) for v in r.values())] or rows
        return {n: _mean(r[n] for r in rows if n in r) for n in names}

    result: dict[str, dict[str, Any]] = {n: {"inputs": sum(n in i for i in shared), "by_cause": {}} for n in names}
    for metric in dict.fromkeys(("psnr", *metrics)):
        for name, value in means(lambda m, metric=metric: m.get(metric)).items():
            result[name][metric] = value
    for cause in CAUSES:
        here = [i for i in shared if any(cause in m["by_cause"] for m in i.values())]
        for name, value in means(lambda m, cause=cause: m["by_cause"].get(cause, {}).get("psnr")).items():
            if here:
                shares = [i[name]["by_cause"].get(cause, {}).get("share", 0.0) for i in shared if name in i]
                result[name]["by_cause"][cause] = {"psnr": value, "share": _mean(shares)}
    for name in names:
        spent = [i[name]["ms"] for i in shared if name in i]
        result[name]["ms"] = {key: _mean(s.get(key) for s in spent) for key in ("median", "iqr")}
        compiled = [i[name]["ms"].get("compile") for i in inputs if name in i]
        result[name]["ms"]["compile"] = sum(c for c in compiled if c is not None)
    return result
