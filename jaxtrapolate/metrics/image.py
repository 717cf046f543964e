"""Image metrics: PSNR and SSIM, of whole images and of the pixels of a mask.

Both compare display values in 0..1: see `jaxtrapolate.tonemap` and `srgb_encode`.
"""

from collections.abc import Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrapolate.checks import ArrayLike, check_image
from jaxtrapolate.precision import divide, widest

_SIGMA = 1.5
_RADIUS = 5  # an 11 x 11 window


def counted(mask: ArrayLike) -> ArrayLike:
    """Where a mask, bool or weights, is more than nothing."""
    return mask if mask.dtype == bool else mask > 0


def _mean(values, mask):
    if mask is None:
        return jnp.mean(values)
    mask = jnp.broadcast_to(mask, values.shape).astype(values.dtype)
    count = jnp.sum(mask)
    total = jnp.sum(mask * jnp.where(mask > 0, values, 0))
    return divide(total, count, otherwise=jnp.nan)


def _difference(first, second, mask):
    wide = widest(first, second)
    first, second = first.astype(wide), second.astype(wide)
    if mask is not None:  # before the square, so that what is left out has no part in the gradient either
        first, second = (jnp.where(counted(mask), image, 0) for image in (first, second))
    return first - second


def _unit(largest, least=0.0):
    """What images are divided by before they are squared: the largest value where a square may overflow, else 1.

    Also where it is below `least`, for squares that may not underflow. Held fixed: it has no part in a gradient.
    """
    unusual = ((largest > 1e15) & (largest < jnp.inf)) | ((largest > 0) & (largest < least))
    return jax.lax.stop_gradient(jnp.where(unusual, largest, 1))


def check_pair(first: ArrayLike, second: ArrayLike, mask: ArrayLike | None) -> None:
    """Raises where two images and a mask do not fit each other.

    Args:
        first: `[H, W, C]`.
        second: of the same shape.
        mask: `[H, W, 1]`, or `None`.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that differ.
    """
    size = check_image("first", first)
    check_image("second", second, size=size, channels=first.shape[-1])
    if mask is not None and tuple(mask.shape) != (*size, 1):
        raise ValueError(f"mask: expected shape {[*size, 1]}, got {list(mask.shape)}")


@jax.jit
def mse(first: Float[Array, "h w c"], second: Float[Array, "h w c"], *, mask: Array | None = None) -> Float[Array, ""]:
    """The mean squared difference over all channels.

    Args:
        first: `[H, W, C]`; the sum is taken in at least float32.
        second: of the same shape.
        mask: `[H, W, 1]`, bool or weights: the pixels that count.

    Returns:
        A scalar; NaN for an empty mask, infinite where a square is: differences beyond 1e19 in float32.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that differ.
    """
    check_pair(first, second, mask)
    return _mean(jnp.square(_difference(first, second, mask)), mask)


@jax.jit
def psnr(
    first: Float[Array, "h w c"],
    second: Float[Array, "h w c"],
    *,
    peak: float | Float[Array, ""] = 1.0,
    mask: Array | None = None,
) -> Float[Array, ""]:
    """Peak signal-to-noise ratio in dB: 10 log10(peak^2 / mse).

    Args:
        first: `[H, W, C]`.
        second: of the same shape.
        peak: the largest value.
        mask: `[H, W, 1]`, bool or weights: the pixels that count.

    Returns:
        A scalar; infinite for equal images, NaN for an empty mask.

    Gradient:
        0 where the images are equal.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that differ.
    """
    check_pair(first, second, mask)
    difference = _difference(first, second, mask)
    unit = _unit(jnp.max(jnp.abs(difference)), 1e-15)
    error = _mean(jnp.square(difference / unit), mask)
    positive = error > 0
    decibels = 20 * (jnp.log10(jnp.asarray(peak, error.dtype)) - jnp.log10(unit))
    decibels = decibels - 10 * jnp.log10(jnp.where(positive, error, 1))
    return jnp.where(positive, decibels, jnp.where(jnp.isnan(error), jnp.nan, jnp.inf))


def _check_window(image: Array) -> None:
    height, width, _ = image.shape
    if height <= 2 * _RADIUS or width <= 2 * _RADIUS:
        raise ValueError(f"first: expected at least 11 x 11 pixels for SSIM's window, got {height} x {width}")


def _moments(image: Array) -> tuple[Array, Array]:
    """Mean and variance by the Gaussian of an 11 x 11 window where it fits, each `[H - 10, W - 10, C]`.

    Along one axis after the other, by the law of total variance: of an almost flat image the mean of the squares less
    the square of the mean would be nothing but rounding.
    """
    kernel = np.exp(-0.5 * (np.arange(-_RADIUS, _RADIUS + 1) / _SIGMA) ** 2)
    kernel = [float(w) for w in kernel / kernel.sum()]

    def weighted(images: Sequence[Array], axis: int) -> tuple[Array, Array]:
        size = images[0].shape[axis] - 2 * _RADIUS
        windows = [[jax.lax.slice_in_dim(i, k, k + size, axis=axis) for i in images] for k in range(len(kernel))]
        means = cast(Array, sum(w * window[0] for w, window in zip(kernel, windows, strict=True)))
        spreads = [jnp.square(window[0] - means) + sum(window[1:]) for window in windows]
        return means, cast(Array, sum(w * spread for w, spread in zip(kernel, spreads, strict=True)))

    return weighted(weighted([image], 0), 1)


def _dissimilarity(first: Array, second: Array, peak: float | Array) -> Array:
    """1 - SSIM `[H - 10, W - 10, 1]`: small for like images: its mean is not rounded as one of numbers near 1."""
    wide = widest(first)
    first, second = first.astype(wide), second.astype(wide)
    peak = jnp.asarray(peak, wide)
    unit = _unit(jnp.maximum(jnp.max(jnp.abs(first)), jnp.max(jnp.abs(second))))
    first, second, peak = first / unit, second / unit, peak / unit
    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    (mean1, variance1), (mean2, variance2) = _moments(first), _moments(second)
    mean, variance = _moments(first - second)
    # (2 a b + c) / (a^2 + b^2 + c) = 1 - (a - b)^2 / (a^2 + b^2 + c), likewise of variances
    scales = mean1 * mean1 + mean2 * mean2 + c1, variance1 + variance2 + c2
    luminance, structure = (
        divide(apart, scale, where=scale != 0) for apart, scale in zip((mean * mean, variance), scales, strict=True)
    )
    return jnp.mean(luminance + structure - luminance * structure, -1, keepdims=True)


@jax.jit
def ssim_map(
    first: Float[Array, "h w c"], second: Float[Array, "h w c"], *, peak: float | Float[Array, ""] = 1.0
) -> Float[Array, "i j 1"]:
    """SSIM at each pixel that is at least 5 from the border, mean over channels; `ssim` is its mean over pixels.

    Args:
        first: `[H, W, C]`, at least 11 x 11.
        second: of the same shape.
        peak: the largest value.

    Returns:
        `[H - 10, W - 10, 1]`.

    Raises:
        TypeError, ValueError: no floating-point array, shapes that differ, or images smaller than the window.
    """
    check_pair(first, second, None)
    _check_window(first)
    return 1 - _dissimilarity(first, second, peak)


@jax.jit
def ssim(
    first: Float[Array, "h w c"],
    second: Float[Array, "h w c"],
    *,
    peak: float | Float[Array, ""] = 1.0,
    mask: Array | None = None,
) -> Float[Array, ""]:
    """Structural similarity, mean over pixels and channels.

    Args:
        first: `[H, W, C]`, at least 11 x 11.
        second: of the same shape.
        peak: the largest value.
        mask: `[H, W, 1]`, bool or weights: the pixels that count, the five at each border left out.

    Returns:
        A scalar, 1 for equal images; NaN where the mask leaves no pixel.

    Gradient:
        Everywhere finite, 0 where the images are equal.

    Raises:
        TypeError, ValueError: no floating-point array, shapes that differ, or images smaller than the window.

    References:
        Wang et al. 2004: Gaussian window 11 x 11, sigma 1.5, population covariance, K = 0.01 and 0.03, windows that fit
        in the image; as skimage.metrics.structural_similarity(gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False).
    """
    check_pair(first, second, mask)
    _check_window(first)
    values = _dissimilarity(first, second, peak)
    return 1 - _mean(values, None if mask is None else mask[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS])
