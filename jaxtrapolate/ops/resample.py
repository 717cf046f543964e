"""Images at another size, and windows over them: linear, separable, and known when tracing.

What a row of the result is made of is a row of a matrix, most of which is 0. On a CPU each row is a small product of
its window with the rows under it; elsewhere, and for derivatives, it is one product of matrices.
"""

import operator
from functools import cache, partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrapolate.checks import ArrayLike, Size
from jaxtrapolate.ops.fill import fill_pyramid
from jaxtrapolate.ops.strips import once
from jaxtrapolate.ops.warp import all_finite, sample
from jaxtrapolate.precision import widest

_SCALE = 255.0  # of grey levels: constants of both flows are for images of 8 bits
BRIGHTEST = 1000.0
"""Images of which a flow is found are held to this: fourth powers of their levels are finite."""


class Resampling(NamedTuple):
    """Along one axis, from `size` to `new` pixels.

    Attributes:
        size, new: pixels before and after.
        kind: "linear" interpolates between pixel centres, and repeats the outermost ones beyond them; "area" takes the
            mean of what a pixel of the result covers.
        sigma, taps: of a Gaussian window of so many pixels, which the image is blurred with before; the image is
            reflected about its outermost centres. 0 taps: no window.
    """

    size: int
    new: int
    kind: str = "linear"
    sigma: float = 0.0
    taps: int = 0


def gaussian(taps: int, sigma: float) -> np.ndarray:
    """An odd number of weights of a Gaussian, whose sum is 1."""
    offset = np.arange(taps) - taps // 2
    weights = np.exp(-np.square(offset) / (2 * sigma**2))
    return weights / weights.sum()


def _matrix(how: Resampling) -> np.ndarray:
    size, new, kind, sigma, taps = how
    matrix = np.zeros((new, size))
    row, step = np.arange(new), size / new
    if kind == "linear":
        at = np.clip((row + 0.5) * step - 0.5, 0, size - 1)
        lower = np.minimum(np.floor(at).astype(int), max(size - 2, 0))
        matrix[row, np.minimum(lower + 1, size - 1)] = at - lower
        matrix[row, lower] += 1 - (at - lower)
    else:
        ends = np.stack([row * step, (row + 1) * step])[..., None]
        covered = np.minimum(ends[1], np.arange(size) + 1) - np.maximum(ends[0], np.arange(size))
        matrix = np.maximum(covered, 0) / step
    if taps:
        index = np.pad(np.arange(size), taps // 2, mode="reflect" if size > 1 else "edge")
        window = np.zeros((size, size))
        for k, weight in enumerate(gaussian(taps, sigma)):
            np.add.at(window, (np.arange(size), index[k : k + size]), weight)
        matrix = matrix @ window
    return matrix


@cache
def _band(how: Resampling) -> tuple[np.ndarray, np.ndarray]:
    """Where the window of each row begins, and its weights `[new, taps]`."""
    matrix = _matrix(how)
    used = matrix != 0
    first, last = used.argmax(1), how.size - 1 - used[:, ::-1].argmax(1)
    taps = int((last - first).max()) + 1
    first = np.minimum(first, how.size - taps)
    return first.astype(np.int32), np.take_along_axis(matrix, first[:, None] + np.arange(taps), 1)


def _dense(how: Resampling, image):
    matrix = jnp.asarray(_matrix(how), image.dtype)
    return jnp.matmul(matrix, image, precision="highest")


def _rows(how: Resampling, image):
    first, weights = _band(how)

    def row(given):
        start, weight = given
        return weight @ jax.lax.dynamic_slice_in_dim(image, start, weight.shape[0])

    return jax.lax.map(row, (jnp.asarray(first), jnp.asarray(weights, image.dtype)))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _along_rows(how, image):
    return jax.lax.platform_dependent(image, cpu=partial(_rows, how), default=partial(_dense, how))


@_along_rows.defjvp
def _along_rows_jvp(how, primals, tangents):
    return _along_rows(how, *primals), _dense(how, *tangents)


def resample(image: Float[Array, "h w"], rows: Resampling, columns: Resampling) -> Float[Array, "i j"]:
    """The image with other numbers of rows and columns."""
    for how in (rows, columns):
        if how.new != how.size or how.taps:
            image = _along_rows(how, image)
        image = image.T
    return image


def resize(image: Float[Array, "h w"], size: Size, *, kind: str = "linear") -> Float[Array, "i j"]:
    """The image `[H, W]` at another size."""
    height, width = image.shape
    return resample(image, Resampling(height, size[0], kind), Resampling(width, size[1], kind))


def gray_levels(image: Float[ArrayLike, "h w 1"]) -> Float[Array, "h w"]:
    """0..255 where the image is 0..1, at least float32; what is not finite is filled from around it.

    The image is held to -1000..1000.
    """
    image = jnp.asarray(image).astype(widest(image))

    def fill(image):
        return fill_pyramid(jnp.where(jnp.isfinite(image), image, 0), jnp.all(jnp.isfinite(image), -1))

    scaled = jax.lax.cond(all_finite(image), lambda i: i, fill, image)[..., 0] * _SCALE
    # held also so that no product is fused into a difference of two images: equal ones would differ by its rounding
    return jnp.clip(scaled, -BRIGHTEST * _SCALE, BRIGHTEST * _SCALE)


def fetch(image: Float[Array, "h w"], x: Float[Array, "i j"], y: Float[Array, "i j"]) -> Float[Array, "i j"]:
    """The image, all finite, at positions between its pixels, bilinear; computed once."""
    return once(sample(image[..., None], x, y, product=jnp.multiply)[..., 0])


def bordered(image: Float[Array, "h w"], margin: int, axis: int) -> Float[Array, "i j"]:
    """The image with `margin` more pixels at both ends of an axis, which repeat its edge; computed once."""
    padding = [(0, 0), (0, 0)]
    padding[axis] = (margin, margin)
    return once(jnp.pad(image, padding, mode="edge"))


def window(padded: Float[Array, "h w"], weights: np.ndarray, axis: int) -> Float[Array, "i j"]:
    """Sums over a window along an axis; the image has a margin of the window's radius there, the result has not."""
    size = padded.shape[axis] - len(weights) + 1
    terms = [
        jax.lax.slice_in_dim(padded, k, k + size, axis=axis) * jnp.asarray(weight, padded.dtype)
        for k, weight in enumerate(weights)
        if weight != 0
    ]
    return reduce(operator.add, terms)
