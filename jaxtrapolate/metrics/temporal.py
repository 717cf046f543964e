"""Temporal stability of a clip: flicker of what stands still, and the difference of consecutive frames after warping.

On display values, frame by frame, as they are shown: plain NumPy but for the warp.
"""

from collections.abc import Iterable, Iterator
from itertools import pairwise, zip_longest
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxtrapolate.checks import check_image
from jaxtrapolate.metrics.perceptual import ClipScore
from jaxtrapolate.ops.warp import backward_warp, in_frame

Frames = Iterable[Any]
"""`[T, H, W, 3]`, or any iterable of `[H, W, 3]`: uint8, or display values in 0..1."""

_STILL = 1.5 / 255  # a change of one code, and its rounding


def _values(name: str, frames: Frames) -> Iterator[np.ndarray]:
    """Each frame as float32 in 0..1, all of one size."""
    size = None
    for k, frame in enumerate(frames):
        values = np.asarray(frame)
        given = values.astype(np.float32) / 255 if values.dtype == np.uint8 else values
        size = check_image(f"{name}[{k}]", given, size=size, channels=3)
        yield np.asarray(given, np.float32)


def _score(name: str, values: list[float]) -> ClipScore:
    if not values:
        raise ValueError(f"{name}: expected at least two frames")
    known = [value for value in values if np.isfinite(value)]
    return ClipScore(float(np.mean(known)) if known else float("nan"), np.array(values))


def flicker(frames: Frames, reference: Frames, *, still: float = _STILL) -> ClipScore:
    """How much more what stands still changes from frame to frame than it does in the reference: 0 is best.

    The mean over pixels, and channels, of the absolute difference between both clips' changes, where no channel of the
    reference changes by more than `still`.

    Args:
        frames: the generated clip, `[T, H, W, 3]` or an iterable of `[H, W, 3]`: uint8, or display values in 0..1.
        reference: the ground truth, likewise.
        still: the largest change of a pixel that stands still; the default is that of one 8-bit code.

    Returns:
        The mean over pairs of frames, and of each pair `[T - 1]`: NaN where nothing stands still, or nothing that is
        finite in both; such pairs are left out of the mean.

    Raises:
        TypeError, ValueError: frames of other kinds, sizes or numbers, or fewer than two.
    """
    found = []
    for own, true in zip_longest(pairwise(_values("frames", frames)), pairwise(_values("reference", reference))):
        if own is None or true is None:
            raise ValueError("frames: expected as many as in the reference")
        (before, after), (first, second) = own, true
        if before.shape != first.shape:
            raise ValueError(f"frames: expected shape {list(first.shape)}, as the reference, got {list(before.shape)}")
        change, expected = after - before, second - first
        where = np.all(np.abs(expected) <= still, -1) & np.all(np.isfinite(change), -1)
        found.append(
            float(np.mean(np.abs(change - expected)[where], dtype=np.float64)) if where.any() else float("nan")
        )
    return _score("frames", found)


def warped_difference(frames: Frames, motions: Iterable[Any], masks: Iterable[Any] | None = None) -> ClipScore:
    """How much each frame differs from the one before, warped to it by the true motion: 0 is best.

    The mean absolute difference over pixels whose motion leads into the frame, and channels. Shading that rightly
    changes counts too: compare methods on one clip, and with the reference's own.

    Args:
        frames: the clip, `[T, H, W, 3]` or an iterable of `[H, W, 3]`: uint8, or display values in 0..1.
        motions: of each frame but the first the motion to the frame before, `[H, W, 2]` in pixels.
        masks: of each frame but the first what counts, bool `[H, W, 1]`, as what is not disoccluded, or what lies near
            silhouettes; `None` = all.

    Returns:
        The mean over pairs of frames, and of each pair `[T - 1]`: NaN where nothing counts; such pairs are left out of
        the mean. A value that is not finite counts nowhere.

    Raises:
        TypeError, ValueError: frames of other kinds or sizes, fewer than two, or not a motion (and mask) for each but
            the first.

    References:
        Lai et al. 2018 (Learning blind video temporal consistency), the warping error, with absolute differences.
    """
    found, images, given = [], pairwise(_values("frames", frames)), iter(motions)
    counted = None if masks is None else iter(masks)
    for before, after in images:
        motion = next(given, None)
        mask = True if counted is None else next(counted, None)
        if motion is None or mask is None:
            raise ValueError("motions: expected a motion, and a mask where any is given, for each frame but the first")
        check_image("motions", motion, size=after.shape[:2], channels=2)
        warped = np.asarray(backward_warp(jnp.asarray(before), jnp.asarray(motion)))
        difference = np.abs(after - warped)
        where = np.asarray(in_frame(jnp.asarray(motion))) & np.all(np.isfinite(difference), -1)
        if mask is not True:
            where &= np.asarray(mask)[..., 0] > 0
        found.append(float(np.mean(difference[where], dtype=np.float64)) if where.any() else float("nan"))
    return _score("frames", found)
