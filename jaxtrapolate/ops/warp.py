"""Gathering: images sampled at a displaced position (backward warp).

Convention:
    `[H, W, C]` images; positions in pixels, x right, y down, an integer is a pixel's centre; motion is a displacement
    to add, so the value at p is image(p + motion[p]). The frame reaches half a pixel beyond the outermost centres:
    -0.5 <= x <= W - 0.5. Between the outermost centres and the frame's edge the border value is repeated.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Inexact, Shaped

from jaxtrapolate.checks import ArrayLike, check_choice, check_image
from jaxtrapolate.precision import widest

Filter = Literal["nearest", "bilinear", "bicubic"]

Outside = Literal["edge", "zero"]

_FARTHEST = 2.0**30  # pixels


def pixel_grid(height: int, width: int, dtype=jnp.float32) -> tuple[Float[Array, "1 w"], Float[Array, "h 1"]]:
    """x `[1, W]` and y `[H, 1]` of the pixel centres; broadcast against each other they span the frame."""
    return jnp.arange(width, dtype=dtype)[None, :], jnp.arange(height, dtype=dtype)[:, None]


def held_motion(motion: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Motion of at most 2^30 pixels, beyond all frames: positions and their squares are then finite.

    What is not finite stays so. The gradient is zero beyond.
    """
    return jnp.where(jnp.abs(motion) < jnp.inf, jnp.clip(motion, -_FARTHEST, _FARTHEST), motion)


def landing(motion: Float[Array, "h w 2"]) -> tuple[Float[Array, "h w"], Float[Array, "h w"], Bool[Array, "h w"]]:
    """x and y of p + motion[p], at least float32, and where that is finite; elsewhere x and y are p itself.

    The motion is `held_motion`. The gradient is zero where it is not finite.
    """
    height, width, _ = motion.shape
    right, down = (motion[..., k].astype(widest(motion)) for k in (0, 1))  # XLA's loops over two numbers are slow
    finite = jnp.isfinite(right) & jnp.isfinite(down)
    x, y = pixel_grid(height, width, right.dtype)
    right, down = (jnp.where(finite, held_motion(v), 0) for v in (right, down))
    return x + right, y + down, finite


def inside(x: Float[Array, "*n"], y: Float[Array, "*n"], height: int, width: int) -> Bool[Array, "*n"]:
    """Whether a position lies in the frame, whose edge is half a pixel beyond the outermost pixel centres."""
    return (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)


def cell(x: Float[Array, "*n"], size: int) -> tuple[Array, Array]:
    """The lower of the two pixels that enclose x along an axis of `size`, and the fraction beyond it, in 0..1.

    x is held to the pixel centres' range 0..size - 1; at its upper end the lower pixel is size - 2 and the fraction 1,
    so that a derivative there is the inner one-sided difference. Beyond the range the derivative is 0.
    """
    last = size - 1
    held = jnp.where(x < 0, 0, jnp.where(x > last, last, x))
    lower = jnp.minimum(jax.lax.stop_gradient(held).astype(jnp.int32), max(size - 2, 0))
    return lower, held - lower.astype(held.dtype)


def take_rows(rows: Shaped[Array, "n c"], index: Array) -> Array:
    """rows[index], for indices that are known to be in bounds."""
    dimensions = jax.lax.GatherDimensionNumbers(
        offset_dims=(index.ndim,), collapsed_slice_dims=(0,), start_index_map=(0,)
    )
    return jax.lax.gather(rows, index[..., None], dimensions, (1, rows.shape[1]), mode="promise_in_bounds")


def take_offsets(
    image: Inexact[Array, "h w c"], row: Array, column: Array, offsets: list[tuple[int, int]]
) -> list[Array]:
    """image[row + j, column + i] for each offset (j, i) >= 0, where all of those are in bounds.

    One index serves all taps, each looking at its own slice of the image: XLA holds an index within the bounds of what
    it gathers from, and shares that work where the index and the bounds are the same.
    """
    height, width, channels = image.shape
    rows = image.reshape(-1, channels)
    index = row * width + column
    shifts = [j * width + i for j, i in offsets]
    count = height * width - max(shifts)
    return [take_rows(rows[shift : shift + count], index) for shift in shifts]


def _plain(value, weight):
    return value * weight


@jax.custom_jvp
def weigh(value: Array, weight: Array) -> Array:
    """value * weight, but 0 where the weight is 0, even of a NaN or an infinity.

    The derivative with respect to the weight is the value where that is finite, also at weight 0; else 0.
    """
    return jnp.where(weight == 0, 0, value * weight)


@weigh.defjvp
def _weigh_jvp(primals, tangents):
    (value, weight), (d_value, d_weight) = primals, tangents
    used = jnp.where(jnp.isfinite(value), value, 0)
    return weigh(value, weight), used * d_weight + d_value * weight


def root(square: Array) -> Array:
    """The square root, with derivative 0 at 0.

    XLA on a CPU computes a value again in each loop that reads it, and rounds it differently: 0 in one may be 1e-16 in
    another. So what stands in for 0, where a derivative would be infinite, has to be as small as what is near it.
    """
    positive = square > 0
    least = max(1e-20, float(jnp.finfo(square.dtype).tiny))
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, least)), 0)


def all_finite(image):
    """Whether an image may be weighted with the plain product; an overflow of the sum only takes the slower way."""
    return jnp.isfinite(jnp.sum(image))


def where_finite(function, image, motion, finite=None):
    """function(product, image, motion), with the plain product for weighting where the image allows it.

    `weigh` costs half as much again as a product on a CPU, and only a non-finite pixel needs it. So there the image is
    looked through first, at the price of one pass, unless `finite` is what `all_finite` said of it; elsewhere `weigh`
    is free and is always taken.
    """

    def on_cpu(image, motion, finite):
        finite = all_finite(image) if finite is None else finite
        return jax.lax.cond(finite, partial(function, _plain), partial(function, weigh), image, motion)

    def always(image, motion, _):
        return function(weigh, image, motion)

    return jax.lax.platform_dependent(image, motion, finite, cpu=on_cpu, default=always)


def _nearest(product, image, x, y):
    height, width, channels = image.shape
    # held to the frame first, so that cutting off rounds to the nearest
    column, row = (
        (jnp.clip(jax.lax.stop_gradient(v), 0, size - 1) + 0.5).astype(jnp.int32)
        for v, size in ((x, width), (y, height))
    )
    return take_rows(image.reshape(-1, channels), row * width + column)


def bilinear_taps(image: Inexact[Array, "h w c"], x: Array, y: Array) -> list[tuple[Array, Array]]:
    """The four pixels around each position `[..., C]` and their weights `[..., 1]`, row by row."""
    height, width, _ = image.shape
    column, t = cell(x, width)
    row, u = cell(y, height)
    t, u = t[..., None], u[..., None]
    right, down = int(width > 1), int(height > 1)
    taps = take_offsets(image, row, column, [(0, 0), (0, right), (down, 0), (down, right)])
    # a (1 - t) + b t returns a tap bit for bit at t = 0 and t = 1; a + t (b - a) does not
    weights = [(1 - t) * (1 - u), t * (1 - u), (1 - t) * u, t * u]
    return list(zip(taps, weights, strict=True))


def _bilinear(product, image, x, y):
    real = widest(image, x)
    wide = jnp.result_type(image.dtype) if jnp.iscomplexobj(image) else real
    taps = bilinear_taps(image, x, y)
    a, b, c, d = (product(tap.astype(wide), weight.astype(real)) for tap, weight in taps)
    return (a + b) + (c + d)


def _catmull_rom(t, lower, size):
    """Weights of the taps lower - 1 .. lower + 2; one beyond the frame is extrapolated linearly from the two inside."""
    before = t * (-0.5 + t * (1 - 0.5 * t))
    at = 1 + t * t * (1.5 * t - 2.5)
    after = t * (0.5 + t * (2 - 1.5 * t))
    beyond = t * t * (0.5 * t - 0.5)
    if size == 1:
        return [jnp.zeros_like(t), jnp.ones_like(t), jnp.zeros_like(t), jnp.zeros_like(t)]
    first, last = lower == 0, lower == size - 2
    at, after = at + jnp.where(first, 2 * before, 0), after - jnp.where(first, before, 0)
    at, after = at - jnp.where(last, beyond, 0), after + jnp.where(last, 2 * beyond, 0)
    return [jnp.where(first, 0, before), at, after, jnp.where(last, 0, beyond)]


def _bicubic(product, image, x, y):
    height, width, _ = image.shape
    column, t = cell(x, width)
    row, u = cell(y, height)
    across, along = _catmull_rom(t, column, width), _catmull_rom(u, row, height)
    wide = widest(image, x)
    padded = jnp.pad(image, ((1, 2), (1, 2), (0, 0)), mode="edge")
    taps = take_offsets(padded, row, column, [(j, i) for j in range(4) for i in range(4)])
    total = jnp.zeros((), wide)
    for k, tap in enumerate(taps):
        total = total + product(tap.astype(wide), (along[k // 4] * across[k % 4])[..., None].astype(wide))
    return total


_SAMPLERS = {"nearest": _nearest, "bilinear": _bilinear, "bicubic": _bicubic}


def sample(
    image: Inexact[Array, "h w c"],
    x: Array,
    y: Array,
    *,
    filter: Filter = "bilinear",
    product: Callable | None = weigh,
) -> Array:
    """The image at finite positions x, y of any common shape; beyond the frame the edge is repeated.

    The filter, exactness and gradients are those of `backward_warp`, of which this is the core. `product` (value, real
    weight) may be a plain product where the image is known to be finite, and is one of its own for a complex image.
    """
    return _SAMPLERS[filter](product, image, x, y).astype(image.dtype)


@partial(jax.jit, static_argnames=("filter", "fill"))
def _backward_warp(image, motion, value, *, filter, fill):
    def warp(product, image, motion):
        x, y, finite = landing(motion)
        warped = sample(image, x, y, filter=filter, product=product)
        if not fill:
            return warped
        seen = finite & inside(x, y, *image.shape[:2])
        return jnp.where(seen[..., None], warped, value.astype(image.dtype))

    # a nearest pixel is taken whole, without a product
    return warp(None, image, motion) if filter == "nearest" else where_finite(warp, image, motion)


def backward_warp(
    image: Float[ArrayLike, "h w c"],
    motion: Float[ArrayLike, "i j 2"],
    *,
    filter: Filter = "bilinear",
    outside: Outside | int | float | Float[ArrayLike, ""] = "edge",
) -> Float[Array, "i j c"]:
    """The image fetched along the motion: result[p] = image(p + motion[p]).

    Args:
        image: `[H, W, C]`, any floating dtype; the result has the same. Sums are taken in at least float32.
        motion: `[I, J, 2]` in pixels; the result has its size, which may differ from the image's.
        filter: "nearest" (ties to the right and down), "bilinear", or "bicubic" (Catmull-Rom, Keys 1981 with
            a = -1/2; beyond the border the image goes on linearly).
        outside: what lies beyond the frame: "edge" (the nearest border pixel), "zero", or a number (differentiable).

    Returns:
        `[I, J, C]`.

    Convention:
        Pull: `motion` belongs to the result's grid and is added to p; pixels, x right, y down, integers are centres.
        The frame ends half a pixel beyond the outermost centres.

    Exactness:
        Zero motion returns the image bit for bit; an integer shift returns the shifted image bit for bit (a negative
        zero may lose its sign, and a number below 2^-126 may become 0). A pixel contributes only where its weight is
        not 0: a NaN or infinity beside a displaced position on a pixel does not spread.

    Edge cases:
        NaN or infinite motion gives the outside value, with "edge" the pixel p itself (of the nearest place in the
        image where the sizes differ).

    Gradient:
        With respect to image, motion and an outside number. At kinks (a coordinate is an integer) it is the difference
        to the next pixel right or down, at the last row or column the inner difference; 0 beyond the centres of the
        border pixels, for motion that is not finite, and for "nearest" (motion only).

    Raises:
        TypeError: image or motion is no floating-point array.
        ValueError: a shape does not fit, or an option is not one of those listed.

    References:
        Guo et al. 2021 (ExtraNet), section 4.2; Nehab et al. 2007.
    """
    check_image("image", image)
    check_image("motion", motion, channels=2)
    check_choice("filter", filter, get_args(Filter))
    if isinstance(outside, str):
        check_choice("outside", outside, get_args(Outside))
    fill = not (isinstance(outside, str) and outside == "edge")
    value = jnp.asarray(0.0 if isinstance(outside, str) else outside)
    return _backward_warp(image, motion, value, filter=filter, fill=fill)


@jax.jit
def in_frame(motion: Float[Array, "h w 2"]) -> Bool[Array, "h w"]:
    """Whether p + motion[p] lies in the frame: finite, and at most half a pixel beyond the outermost centres.

    Args:
        motion: `[H, W, 2]` in pixels; the frame it leads to has the same size.

    Raises:
        TypeError: no floating-point array. ValueError: not of shape `[H, W, 2]`.
    """
    height, width = check_image("motion", motion, channels=2)
    x, y, finite = landing(motion)
    return finite & inside(x, y, height, width)
