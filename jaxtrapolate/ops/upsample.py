"""Images at a larger size, from one frame alone: nearest, bilinear and bicubic, and FSR 1's edge-adaptive upsampling.

Convention:
    Output pixel q shows the screen at (q + 1/2) / scale - 1/2 in pixels of the input, along each axis. A frame with
    jitter j shows at its pixel p the screen at p + j, so that q is fetched at that place minus j. The output is
    unjittered.
"""

from functools import partial, reduce
from typing import Any, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.checks import ArrayLike, Size, check_array, check_choice, check_image
from jaxtrapolate.ops.warp import Filter, sample, take_rows, where_finite
from jaxtrapolate.precision import divide, widest


def upsampled_size(size: Size, scale: int | float) -> Size:
    """`(H, W)` times the scale, rounded, and at least one pixel."""
    height, width = (max(1, round(n * scale)) for n in size)
    return height, width


def upsampled_places(size: Size, scale: int | float, jitter: ArrayLike | None, dtype: Any) -> tuple[Array, Array]:
    """x and y `[scale H, scale W]` in the input, of every pixel of the output."""
    larger = upsampled_size(size, scale)
    y, x = ((jnp.arange(n, dtype=dtype) + 0.5) * (m / n) - 0.5 for n, m in zip(larger, size, strict=True))
    if jitter is not None:
        shift = jnp.asarray(jitter, dtype)
        x, y = x - shift[0], y - shift[1]
    return jnp.broadcast_to(x[None, :], larger), jnp.broadcast_to(y[:, None], larger)


def _checked(image, scale, jitter) -> Size:
    size = check_image("image", image)
    if jitter is not None:
        check_array("jitter", jitter, shape=(2,))
    if not 0 < scale < float("inf"):
        raise ValueError(f"scale: expected a positive number, got {scale}")
    return size


@partial(jax.jit, static_argnames=("scale", "filter"))
def upsample(
    image: Float[ArrayLike, "h w c"],
    *,
    scale: int | float = 2,
    filter: Filter = "bilinear",
    jitter: Float[ArrayLike, "2"] | None = None,
) -> Float[Array, "i j c"]:
    """An image at a larger size, each pixel fetched where it lies in the input.

    Args:
        image: `[H, W, C]`.
        scale: output size over input size; the output's is rounded, and the places are those of the rounded size.
        filter: "nearest", "bilinear", or "bicubic" (Catmull-Rom), as in `backward_warp`.
        jitter: `[2]`, x and y in pixels of the input, of its samples; `None` = unjittered.

    Returns:
        `[scale H, scale W, C]` in the dtype of the image. Beyond the outermost pixel centres the edge is repeated.

    Gradient:
        With respect to the image, and to the jitter as `backward_warp`'s to its motion.

    Raises:
        TypeError, ValueError: no floating-point image, a jitter of another shape, a `scale` that is not positive, or an
            unknown filter.
    """
    size = _checked(image, scale, jitter)
    check_choice("filter", filter, get_args(Filter))
    image = jnp.asarray(image)
    x, y = upsampled_places(size, scale, jitter, widest(image))

    def fetch(product, image, places):
        return sample(image, *places, filter=filter, product=product)

    return fetch(None, image, (x, y)) if filter == "nearest" else where_finite(fetch, image, (x, y))


_TAPS = {  # offsets (x, y) from the pixel f above and left of a place
    **{"b": (0, -1), "c": (1, -1), "e": (-1, 0), "f": (0, 0), "g": (1, 0), "h": (2, 0)},
    **{"i": (-1, 1), "j": (0, 1), "k": (1, 1), "l": (2, 1), "n": (0, 2), "o": (1, 2)},
}
_CROSSES = ("befgj", "cfghk", "fijkn", "gjklo")  # above, left, centre, right, below, of f, g, j and k
_FLAT = 1 / 32768


def _edges(bright, t, u):
    """The direction across an edge, of length 1, and how much of an edge there is, in 0..1."""
    weights = ((1 - t) * (1 - u), t * (1 - u), (1 - t) * u, t * u)
    across, along, amount = jnp.zeros_like(t), jnp.zeros_like(t), jnp.zeros_like(t)
    for (a, b, c, d, e), weight in zip(_CROSSES, weights, strict=True):
        above, left, centre, right, below = (bright[name] for name in (a, b, c, d, e))
        for before, after in ((left, right), (above, below)):
            most = jnp.maximum(jnp.abs(after - centre), jnp.abs(centre - before))
            amount += weight * jnp.square(jnp.clip(divide(jnp.abs(after - before), most), 0, 1))
        across, along = across + weight * (right - left), along + weight * (below - above)
    square = across * across + along * along
    flat = square < _FLAT
    length = jnp.sqrt(jnp.where(flat, 1, square))
    return jnp.where(flat, 1, across) / length, along / length, jnp.square(amount / 2)


@partial(jax.jit, static_argnames=("scale",))
def easu(
    image: Float[ArrayLike, "h w 3"], *, scale: int | float = 2, jitter: Float[ArrayLike, "2"] | None = None
) -> Float[Array, "i j 3"]:
    """Edge-adaptive spatial upsampling: a Lanczos-like kernel of 12 pixels, turned and stretched along edges.

    Each pixel is held within the least and the largest of the four pixels around it.

    Args:
        image: `[H, W, 3]`, display values in 0..1.
        scale: as in `upsample`; the kernel is meant for 1 to 2.
        jitter: as in `upsample`.

    Returns:
        `[scale H, scale W, 3]` in the dtype of the image; beyond the frame the edge is repeated.

    Edge cases:
        A pixel that is not finite reaches all that it is one of the 12 of.

    Gradient:
        With respect to the image: finite for a finite one, but the direction of edges jumps where there is none.

    Raises:
        TypeError, ValueError: no floating-point image of three channels, or as `upsample`.

    References:
        AMD FidelityFX Super Resolution 1.0, the pass EASU as published (`FsrEasuF`), with exact reciprocals and square
        roots where that has approximate ones. Its second pass, sharpening (RCAS), is left out.
    """
    height, width = _checked(image, scale, jitter)
    image = jnp.asarray(image)
    check_image("image", image, channels=3)
    wide = widest(image)
    x, y = upsampled_places((height, width), scale, jitter, wide)
    column, row = jnp.floor(x), jnp.floor(y)
    t, u = x - column, y - row
    rows = image.reshape(-1, 3)

    def tap(i, j):
        r, c = (jnp.clip(v + k, 0, n - 1).astype(jnp.int32) for v, k, n in ((row, j, height), (column, i, width)))
        return take_rows(rows, r * width + c).astype(wide)

    taps = {name: tap(*offset) for name, offset in _TAPS.items()}
    bright = {name: v[..., 2] * 0.5 + (v[..., 0] * 0.5 + v[..., 1]) for name, v in taps.items()}
    across, along, edge = _edges(bright, t, u)
    stretch = 1 / jnp.maximum(jnp.abs(across), jnp.abs(along)) * (across * across + along * along)
    wider, narrower = 1 + (stretch - 1) * edge, 1 - 0.5 * edge
    lobe = 0.5 + (0.25 - 0.04 - 0.5) * edge
    total, weights = jnp.zeros((*t.shape, 3), wide), jnp.zeros_like(t)
    for name, (i, j) in _TAPS.items():
        right, down = i - t, j - u
        turned = wider * (right * across + down * along), narrower * (down * across - right * along)
        square = jnp.minimum(turned[0] * turned[0] + turned[1] * turned[1], 1 / lobe)
        base, window = jnp.square(0.4 * square - 1), jnp.square(lobe * square - 1)
        weight = (25 / 16 * base - (25 / 16 - 1)) * window
        total, weights = total + taps[name] * weight[..., None], weights + weight
    nearest = [taps[name] for name in "fgjk"]
    least, most = reduce(jnp.minimum, nearest), reduce(jnp.maximum, nearest)
    return jnp.clip(total / weights[..., None], least, most).astype(image.dtype)
