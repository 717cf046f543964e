"""Scoring methods on a sequence: the 2nd, 4th, ... frame of each run is held back, made from the others, and compared.

A held-back frame's colour, shadow and sky colour are never seen by a method. The history is what was rendered; motion
chains over the held-back frames between by their buffers.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrapolate.causes import CAUSES, cause_map, disoccluded
from jaxtrapolate.checks import ArrayLike, check_present
from jaxtrapolate.files import Sequence, prefetch, runs
from jaxtrapolate.methods.method import Method
from jaxtrapolate.metrics import psnr, ssim
from jaxtrapolate.radiance import srgb_encode, tonemap
from jaxtrapolate.records import Frame, replace
from jaxtrapolate.timing import Timing, measure


def hide(frame: Frame) -> Frame:
    """A frame as a method sees it before it is rendered: its buffers, without colour, shadow and sky colour."""
    buffers = frame.gbuffer
    if buffers is not None:
        buffers = replace(buffers, shadow=None, sky_color=None)
    return replace(frame, color=None, gbuffer=buffers)


@dataclasses.dataclass(frozen=True)
class Window:
    """A held-back frame and what surrounds it: the true frame, and history, target and future as methods see them."""

    number: int
    truth: Frame
    history: tuple[Frame, ...]
    target: Frame
    future: tuple[Frame, ...]


def held_back(sequence: Sequence, *, past: int, future: int = 0) -> list[int]:
    """The numbers of the held-back frames that have `past` rendered frames before them and `future` behind them."""
    numbers = []
    for run in runs(sequence):
        numbers += [run[i] for i in range(1, len(run), 2) if i >= 2 * past - 1 and i + 2 * future - 1 < len(run)]
    return numbers


def windows(sequence: Sequence, numbers: list[int], *, past: int, future: int = 0) -> Iterator[Window]:
    """The held-back frames `numbers` with the frames around them, on the device; each frame is read once."""
    before, behind = 2 * past - 1, max(0, 2 * future - 1)
    needed = sorted({i for n in numbers for i in range(n - before, n + behind + 1)})
    wanted = iter(numbers)
    number = next(wanted, None)
    cached: dict[int, Frame] = {}
    for i, frame in prefetch(sequence, needed):
        cached[i] = jax.device_put(frame)
        while number is not None and i == number + behind:
            rendered = {k: f if (k - number) % 2 else hide(f) for k, f in cached.items()}
            yield Window(
                number=number,
                truth=cached[number],
                history=tuple(rendered[k] for k in range(number - before, number)),
                target=rendered[number],
                future=tuple(rendered[k] for k in range(number + 1, number + behind + 1)),
            )
            number = next(wanted, None)
        if number is not None:
            cached = {k: f for k, f in cached.items() if k >= number - before}


def arguments(method: Method, window: Window) -> tuple[tuple[Frame, ...], Frame, tuple[Frame, ...]]:
    """History, target and future for a method: as many rendered frames as it wants, and no more."""
    history = window.history[-(2 * method.past - 1) :]
    return history, window.target, window.future[: max(0, 2 * method.future - 1)]


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
    target, source = sequence.keyframe(window.number), sequence.keyframe(window.number - 1)
    hidden, metric = None, sequence.depth == "metric"
    if metric and target is not None and source is not None:
        exact = target.backward_flow is not None and source.depth is not None
        hidden = disoccluded(replace(target, color=None), replace(source, color=None)) if exact else None
    return np.asarray(cause_map(window.truth, window.history[-1], motion, hidden=hidden, metric_depth=metric))


def score(image: Array, window: Window, causes: np.ndarray | None, invalid: np.ndarray | None, *, hdr: bool) -> dict:
    """PSNR and SSIM of a made frame, whole and by cause; pixels that were not finite in the input are left out."""
    color = check_present("truth.color", window.truth.color, needed_by="score")
    made, truth = display(image, hdr=hdr), display(color, hdr=hdr)
    valid = np.ones((*made.shape[:2], 1), bool) if invalid is None else ~invalid[..., None]
    result: dict[str, Any] = {"number": window.number, "psnr": float(psnr(made, truth, mask=valid)), "ssim": None}
    if min(made.shape[:2]) >= 11:
        result["ssim"] = float(ssim(made, truth, mask=valid))
    result["by_cause"] = {}
    if causes is None:
        return result
    for i, cause in enumerate(CAUSES):
        mask = (causes[..., None] == i) & valid
        if mask.any():
            decibels = float(psnr(made, truth, mask=mask))
            result["by_cause"][cause] = {"psnr": decibels, "share": float(mask.mean())}
    return result


def mean_over_frames(frames: list[dict]) -> dict[str, Any]:
    """Means of the scores of several frames; a cause's dB over the frames in which it occurs, its share over all."""

    def mean(values):
        values = [v for v in values if v is not None]
        return float(np.mean(values)) if values else None

    by_cause = {}
    for cause in CAUSES:
        found = [f["by_cause"][cause] for f in frames if cause in f["by_cause"]]
        if found:
            share = sum(f["share"] for f in found) / len(frames)
            by_cause[cause] = {"psnr": mean([f["psnr"] for f in found]), "share": share}
    return {"psnr": mean([f["psnr"] for f in frames]), "ssim": mean([f["ssim"] for f in frames]), "by_cause": by_cause}


def time_stages(method: Method, window: Window, *, repeats: int = 5) -> dict[str, Timing]:
    """Each stage of a method on its own; their sum exceeds the whole, in which XLA fuses across stages."""
    history, target, future = arguments(method, window)
    values = {"carry": method.init(history, target), "history": history, "target": target, "future": future}
    timings = {}
    for stage in method.active(history, target, future):
        run = method.jitted_stages[stage.name]
        timings[stage.name] = measure(run, method.state, dict(values), repeats=repeats)
        values |= run(method.state, dict(values))
    return timings


__all__ = [
    "Window",
    "arguments",
    "causes_of",
    "display",
    "held_back",
    "hide",
    "mean_over_frames",
    "score",
    "time_stages",
    "windows",
]
