"""Image metrics: PSNR and SSIM, of whole images and of the pixels of a mask.

Both compare display values in 0..1: see `jaxtrapolate.tonemap` and `srgb_encode`.
"""

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


def _squared_error(first, second, mask):
    wide = widest(first, second)
    first, second = first.astype(wide), second.astype(wide)
    if mask is not None:  # before the square, so that what is left out has no part in the gradient either
        first, second = (jnp.where(counted(mask), image, 0) for image in (first, second))
    return _mean(jnp.square(first - second), mask)


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
        A scalar; NaN for an empty mask.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that differ.
    """
    check_pair(first, second, mask)
    return _squared_error(first, second, mask)


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
    error = _squared_error(first, second, mask)
    positive = error > 0
    decibels = 10 * jnp.log10(jnp.asarray(peak, error.dtype) ** 2 / jnp.where(positive, error, 1))
    return jnp.where(positive, decibels, jnp.where(jnp.isnan(error), jnp.nan, jnp.inf))


def _blur(image):
    """The Gaussian of an 11 x 11 window at the positions where it fits, `[H - 10, W - 10, C]`."""
    offsets = np.arange(-_RADIUS, _RADIUS + 1)
    kernel = np.exp(-0.5 * (offsets / _SIGMA) ** 2)
    kernel = kernel / kernel.sum()
    height, width, _ = image.shape
    terms = (float(w) * image[k : k + height - 2 * _RADIUS] for k, w in enumerate(kernel))
    rows = cast(Array, sum(terms))  # the kernel is not empty, so that it is not the int 0
    return sum(float(w) * rows[:, k : k + width - 2 * _RADIUS] for k, w in enumerate(kernel))


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
    height, width, _ = first.shape
    if height <= 2 * _RADIUS or width <= 2 * _RADIUS:
        raise ValueError(f"first: expected at least 11 x 11 pixels for SSIM's window, got {height} x {width}")
    wide = widest(first)
    first, second = first.astype(wide), second.astype(wide)
    peak = jnp.asarray(peak, wide)
    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    mean1, mean2 = _blur(first), _blur(second)
    variance1 = _blur(first * first) - mean1 * mean1
    variance2 = _blur(second * second) - mean2 * mean2
    covariance = _blur(first * second) - mean1 * mean2
    luminance = (2 * mean1 * mean2 + c1) / (mean1 * mean1 + mean2 * mean2 + c1)
    structure = (2 * covariance + c2) / (variance1 + variance2 + c2)
    return jnp.mean(luminance * structure, -1, keepdims=True)


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
    values = ssim_map(first, second, peak=peak)
    return _mean(values, None if mask is None else mask[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS])
