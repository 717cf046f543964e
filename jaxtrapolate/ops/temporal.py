"""Accumulation over time: TAA, and TAAU, which also upsamples (Karis et al. 2014; Yang et al. 2020).

Convention:
    The current frame's pixel p shows the screen at p + jitter; the history and the answer are unjittered, `scale` times
    as large. See `jaxtrapolate.ops.upsample`.
"""

from functools import partial, reduce
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrapolate.checks import ArrayLike, check_array, check_choice, check_image
from jaxtrapolate.ops.upsample import upsampled_places, upsampled_size
from jaxtrapolate.ops.warp import root, take_rows
from jaxtrapolate.precision import divide, widest

Rectify = Literal["variance", "clamp", "none"]

_FALL = 2.29  # of the Gaussian that stands for a Blackman-Harris window of 3.3 pixels


def rgb_to_ycocg(image: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Brightness, and orange against blue, and green against violet: Y, Co, Cg."""
    red, green, blue = (image[..., k] for k in range(3))
    middle = (red + blue) / 2
    return jnp.stack([(green + middle) / 2, (red - blue) / 2, (green - middle) / 2], -1)


def ycocg_to_rgb(image: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """The inverse of `rgb_to_ycocg`."""
    bright, orange, green = (image[..., k] for k in range(3))
    return jnp.stack([bright - green + orange, bright + green, bright - green - orange], -1)


def _neighbourhood(image, scale, jitter):
    """The nine pixels around each output pixel's place, each with its weight by how near that its sample is."""
    height, width, _ = image.shape
    x, y = upsampled_places((height, width), scale, jitter, widest(image))
    column, row = jnp.round(x), jnp.round(y)
    rows = image.reshape(height * width, 3)
    taps = []
    for j in (-1, 0, 1):
        for i in (-1, 0, 1):
            c, r = column + i, row + j
            square = (jnp.square(c - x) + jnp.square(r - y)) * scale**2
            c, r = (jnp.clip(v, 0, n - 1).astype(jnp.int32) for v, n in ((c, width), (r, height)))
            taps.append((take_rows(rows, r * width + c).astype(x.dtype), square[..., None]))
    return taps


def _rectified(history, colors, how, gamma):
    """The history, brought into the box of the colours around it: `[..., 3]` in YCoCg."""
    if how == "clamp":
        least, most = reduce(jnp.minimum, colors), reduce(jnp.maximum, colors)
        return jnp.clip(history, least, most)
    mean = reduce(jnp.add, colors) / len(colors)
    variance = reduce(jnp.add, [jnp.square(color - mean) for color in colors]) / len(colors)
    reach, apart = gamma * root(variance), history - mean
    beyond = jnp.max(divide(jnp.abs(apart), reach), -1, keepdims=True)
    outside = jnp.any((reach <= 0) & (apart != 0), -1, keepdims=True)  # a box without a size: its middle
    shorter = divide(apart, jnp.broadcast_to(jnp.maximum(beyond, 1), apart.shape))
    return mean + jnp.where(outside, 0, shorter)


@partial(jax.jit, static_argnames=("scale", "rectify"))
def accumulate(
    current: Float[ArrayLike, "h w 3"],
    history: Float[ArrayLike, "i j 3"],
    valid: Bool[ArrayLike, "i j 1"],
    *,
    scale: int = 1,
    jitter: Float[ArrayLike, "2"] | None = None,
    rectify: Rectify = "variance",
    gamma: float | Float[Array, ""] = 1.0,
    weight: float | Float[Array, ""] = 0.1,
) -> Float[Array, "i j 3"]:
    """A frame mixed into the history of those before it: temporal anti-aliasing, and upsampling with `scale` over 1.

    An output pixel's own colour is a mean of the nine pixels around its place, by a Gaussian of how far their samples
    are. Of it the `weight` is mixed in, times the largest of those nine weights, so that a frame without a sample
    nearby says little. The history is first brought near the nine colours, in YCoCg, so that it leaves no ghosts.

    Args:
        current: `[H, W, 3]`, the frame, in values in which means look right: after a tone curve.
        history: `[scale H, scale W, 3]`, the answer to the frame before, warped, likewise.
        valid: `[scale H, scale W, 1]`, where there is a history; elsewhere the frame's own colour is the answer.
        scale: output size over input size, a whole number.
        jitter: `[2]`, x and y in pixels of the frame, of its samples; `None` = unjittered.
        rectify: "variance": moved towards the nine colours' mean, into `gamma` deviations of it; "clamp": held within
            the least and the largest of each component; "none".
        gamma: see `rectify`.
        weight: of a frame with a sample in the middle of the pixel.

    Returns:
        `[scale H, scale W, 3]` in the dtype of the frame.

    Edge cases:
        Beyond the frame its edge is repeated. A pixel that is not finite reaches the nine around it, and stays in the
        history: fill such pixels before.

    Gradient:
        With respect to both images, the weight and gamma; finite, at flat neighbourhoods too.

    Raises:
        TypeError, ValueError: no floating-point images, shapes that do not fit, a `scale` below 1, an unknown
            `rectify`.

    References:
        Karis et al. 2014 (neighbourhoods in YCoCg, the Gaussian); Salvi 2016 (variance clipping); Yang et al. 2020, A
        survey of temporal antialiasing techniques (upsampling with a confidence by the nearest sample).
    """
    size = check_image("current", current, channels=3)
    if scale < 1:
        raise ValueError(f"scale: expected a whole number from 1 on, got {scale}")
    check_choice("rectify", rectify, get_args(Rectify))
    larger = upsampled_size(size, scale)
    check_image("history", history, size=larger, channels=3)
    if jitter is not None:
        check_array("jitter", jitter, shape=(2,))
    if jnp.shape(valid) != (*larger, 1):
        raise ValueError(f"valid: expected shape {[*larger, 1]}, got {list(jnp.shape(valid))}")
    image = jnp.asarray(current)
    wide = widest(image, history)
    gamma, weight = jnp.asarray(gamma, wide), jnp.asarray(weight, wide)
    taps = _neighbourhood(image.astype(wide), scale, jitter)
    nearest = reduce(jnp.minimum, [square for _, square in taps])
    shares = [jnp.exp(-_FALL * (square - nearest)) for _, square in taps]
    own = reduce(jnp.add, [c * s for (c, _), s in zip(taps, shares, strict=True)]) / reduce(jnp.add, shares)
    before = jnp.where(valid, jnp.asarray(history, wide), own)
    if rectify != "none":
        colors = [rgb_to_ycocg(color) for color, _ in taps]
        before = ycocg_to_rgb(_rectified(rgb_to_ycocg(before), colors, rectify, gamma))
    mixed = before + weight * jnp.exp(-_FALL * nearest) * (own - before)
    return jnp.where(valid, mixed, own).astype(image.dtype)
