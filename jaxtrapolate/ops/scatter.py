"""Scattering: values pushed along the motion of their own pixels (forward splatting).

Convention:
    As in `jaxtrapolate.ops.warp`: the value at p goes to p + motion[p]; pixels, x right, y down, integers are centres.
"""

from functools import partial
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxtrapolate.checks import ArrayLike, check_choice, check_image, check_present
from jaxtrapolate.ops.depth import surface_depth
from jaxtrapolate.ops.warp import landing, take_rows, weigh
from jaxtrapolate.precision import divide, widest

Mode = Literal["sum", "average", "linear", "softmax"]

_NONE = np.uint64(0xFFFFFFFFFFFFFFFF)


def _order(depth: Array) -> Array:
    """Positive float32 depth as unsigned integers of the same order."""
    return jax.lax.bitcast_convert_type(depth, jnp.uint32)


def nearest_keys(cell: Int[Array, " n"], depth: Float[Array, " n"], count: int) -> Array:
    """Of the points that land in each of some cells the nearest, as a key `[count]`; what lands in `count` is lost.

    The keys of `sources_of`; the smaller of two keys is of the nearer point, of equal depths of the one that is first.
    """
    with jax.enable_x64(True):  # one 64-bit key orders by depth, then by source index
        source = jnp.arange(depth.shape[0], dtype=jnp.uint64)
        key = (_order(depth).astype(jnp.uint64) << jnp.uint64(32)) | source
        return jnp.full(count + 1, _NONE, jnp.uint64).at[cell].min(key, mode="promise_in_bounds")[:-1]


def sources_of(keys: Array) -> tuple[Int[Array, "*shape"], Bool[Array, "*shape"]]:
    """Which point a key is of, and whether it is of any; 0 where it is of none."""
    with jax.enable_x64(True):
        covered = keys != _NONE
        index = jnp.where(covered, keys & jnp.uint64(0xFFFFFFFF), jnp.uint64(0)).astype(jnp.int32)
    return index, covered


@partial(jax.jit, static_argnames=("footprint",))
def splat_source(
    motion: Float[Array, "h w 2"], depth: Float[Array, "h w 1"], *, footprint: Literal[1, 4] = 4
) -> tuple[Int[Array, "h w"], Bool[Array, "h w"]]:
    """Which source pixel (its flat index) `splat_nearest` puts at each pixel, and whether there is one.

    The index is 0 where there is none. No gradient: a choice has none.
    """
    height, width = check_image("motion", motion, channels=2)
    check_image("depth", depth, size=(height, width), channels=1)
    x, y, used = landing(jax.lax.stop_gradient(motion))
    depth = surface_depth(jax.lax.stop_gradient(depth)).astype(jnp.float32)[..., 0]
    # The minimum commutes with dilation: scatter once, to the cell of four pixel centres that the point lands in, then
    # let each pixel take the minimum of the four cells around it. Cell (j, i) has pixel (j, i) at its lower right.
    grow = 0 if footprint == 1 else 1
    row, column = (jnp.floor(v + 0.5) if footprint == 1 else jnp.floor(v) + 1 for v in (y, x))
    rows, columns = height + grow, width + grow
    used &= (row >= 0) & (row < rows) & (column >= 0) & (column < columns) & ~jnp.isnan(depth)
    count = rows * columns
    cell = row.astype(jnp.int32) * columns + column.astype(jnp.int32)
    cell = jnp.where(used, cell, count)
    cells = nearest_keys(cell.reshape(-1), depth.reshape(-1), count).reshape(rows, columns)
    with jax.enable_x64(True):
        if grow:
            cells = jnp.minimum(cells[:, :-1], cells[:, 1:])
            cells = jnp.minimum(cells[:-1], cells[1:])
    index, covered = sources_of(cells)
    return index, covered


@partial(jax.jit, static_argnames=("footprint",))
def _splat_nearest(values, motion, depth, *, footprint):
    index, covered = splat_source(motion, depth, footprint=footprint)
    taken = take_rows(values.reshape(-1, values.shape[-1]), index)
    return jnp.where(covered[..., None], taken, 0), covered


def splat_nearest(
    values: Float[ArrayLike, "h w c"],
    motion: Float[ArrayLike, "h w 2"],
    depth: Float[ArrayLike, "h w 1"],
    *,
    footprint: Literal[1, 4] = 4,
) -> tuple[Float[Array, "h w c"], Bool[Array, "h w"]]:
    """Depth-tested forward scatter: each pixel's value goes to p + motion[p], the nearest depth wins.

    Args:
        values: `[H, W, C]`, what is scattered.
        motion: `[H, W, 2]` in pixels.
        depth: `[H, W, 1]`, smaller is nearer; what is not positive is nothing, and as far as +inf
            (`jaxtrapolate.ops.depth`).
        footprint: 4, the four pixel centres around the landing position (a point that lands on a centre also covers the
            next ones right and down, as a cell of pixels does), or 1, the nearest centre (ties right and down).

    Returns:
        The values `[H, W, C]`, 0 where nothing landed, and where something did `[H, W]`.

    Convention:
        Push: `motion` belongs to the source pixels; pixels, x right, y down, integers are centres.

    Edge cases:
        Deterministic: of equal depths the lower source index (row by row) wins. What lands outside the frame is lost,
        except for footprint pixels inside it. Non-finite motion and NaN depth are not scattered.

    Gradient:
        With respect to values. Which pixel wins does not change smoothly, so that motion and depth get a gradient of 0;
        `splat` is differentiable in the motion.

    Raises:
        TypeError, ValueError: no floating-point array, or a shape that does not fit.

    References:
        Zeng et al. 2021 and Guo et al. 2021 (ExtraNet), section 4.2, for the occlusion motion; Mark et al. 1997.
    """
    size = check_image("values", values)
    check_image("motion", motion, size=size, channels=2)
    check_image("depth", depth, size=size, channels=1)
    if footprint not in (1, 4):
        raise ValueError(f"footprint: expected 1 or 4, got {footprint!r}")
    return _splat_nearest(values, motion, depth, footprint=footprint)


@partial(jax.jit, static_argnames=("mode",))
def _splat(values, motion, weights, *, mode):
    height, width, channels = values.shape
    wide = widest(values, motion)
    x, y, finite = landing(motion.astype(wide))
    finite &= (jnp.abs(x) < 2.0**30) & (jnp.abs(y) < 2.0**30)
    x, y = jnp.where(finite, x, 0), jnp.where(finite, y, 0)
    left, top = (jnp.floor(jax.lax.stop_gradient(v)) for v in (x, y))
    t, u = x - left, y - top
    column, row = left.astype(jnp.int32), top.astype(jnp.int32)
    values = values.astype(wide)
    count = height * width
    taps = []
    for j, i in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = (t if i else 1 - t) * (u if j else 1 - u)
        used = finite & (row + j >= 0) & (row + j < height) & (column + i >= 0) & (column + i < width)
        taps.append((jnp.where(used, (row + j) * width + column + i, count).reshape(-1), share.reshape(-1), used))
    if mode in ("linear", "softmax"):
        # the largest weight at each target keeps the sums in range there, and drops out of the quotient
        z = weights.astype(wide).reshape(-1)
        fixed = jax.lax.stop_gradient(z)
        largest = jnp.full(count + 1, -jnp.inf, wide)
        for index, share, _ in taps:
            largest = largest.at[jnp.where(share > 0, index, count)].max(fixed, mode="promise_in_bounds")
        importance = []
        for index, _, _ in taps:
            at = take_rows(largest[:, None], index)[:, 0]
            at = jnp.where(jnp.isfinite(at), at, fixed)
            # a tap without a share may lie above the largest: its weight does not matter, but must be finite
            held = jnp.where(fixed > at, at, z)
            importance.append(jnp.exp(held - at) if mode == "softmax" else divide(held, at))
    else:
        importance = [jnp.ones(count, wide)] * 4
    normalised = mode != "sum"
    total = jnp.zeros((count + 1, channels + normalised), wide)
    flat = values.reshape(-1, channels)
    for (index, share, _), factor in zip(taps, importance, strict=False):
        weight = (share * factor)[:, None]
        pushed = weigh(flat, weight)
        if normalised:
            pushed = jnp.concatenate([pushed, weight], -1)
        total = total.at[index].add(pushed, mode="promise_in_bounds")
    total = total[:-1].reshape(height, width, -1)
    if not normalised:
        return total
    summed, weight = total[..., :-1], total[..., -1:]
    return divide(summed, weight)


def splat(
    values: Float[ArrayLike, "h w c"],
    motion: Float[ArrayLike, "h w 2"],
    *,
    weights: Float[ArrayLike, "h w 1"] | None = None,
    mode: Mode = "average",
) -> Float[Array, "h w c"]:
    """Bilinear forward splatting: each pixel's value is shared among the four pixels around p + motion[p].

    With b the bilinear shares and z the weights, a target gets
    "sum": sum(b v); "average": sum(b v) / sum(b); "linear": sum(b z v) / sum(b z);
    "softmax": sum(b exp(z) v) / sum(b exp(z)).

    Args:
        values: `[H, W, C]`.
        motion: `[H, W, 2]` in pixels.
        weights: `[H, W, 1]`, for "linear" (not negative) and "softmax" (any; larger is more important) only.
        mode: as above.

    Returns:
        `[H, W, C]` of the dtype of `values`; 0 where nothing landed. Sums are taken in at least float32.

    Convention:
        Push: `motion` belongs to the source pixels; pixels, x right, y down, integers are centres.

    Edge cases:
        What lands outside the frame is lost. Non-finite motion and weights are not scattered. A pixel contributes only
        where its share is not 0. Weights are taken relative to the largest at each target, so that no size of them
        over- or underflows there.

    Gradient:
        With respect to values, motion and weights, exact away from kinks; at a landing position on a pixel centre, that
        of the move to the right and down. 0 in holes and for what lands outside.

    Raises:
        TypeError, ValueError: no floating-point array, a shape that does not fit, an unknown mode, or weights that are
            missing for a mode or given to one that has none.

    References:
        Niklaus and Liu 2020 (softmax splatting), equations 4-8. Departure: the largest weight is taken per target.
    """
    size = check_image("values", values)
    check_image("motion", motion, size=size, channels=2)
    check_choice("mode", mode, get_args(Mode))
    if mode in ("linear", "softmax"):
        weights = check_present("weights", weights, needed_by=f"mode={mode!r}")
        check_image("weights", weights, size=size, channels=1)
        finite = jnp.isfinite(weights)
        motion = jnp.where(finite, motion, jnp.nan)
        weights = jnp.where(finite, weights, 0)
    elif weights is not None:
        raise ValueError(f"weights: expected None for mode={mode!r}, got an array; use 'linear' or 'softmax'")
    return _splat(values, motion, weights, mode=mode).astype(values.dtype)
