"""What depth says about which of a frame's surfaces another frame shows.

1 / depth is linear on the screen along any plane. So between pixels it is not depth that is interpolated, which would
mix surfaces at their silhouettes, but each pixel's own plane is followed to where it is looked at.
"""

from typing import cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrapolate.checks import ArrayLike, check_image, check_present
from jaxtrapolate.ops.depth import changed, held, surface_depth
from jaxtrapolate.ops.scatter import splat_nearest
from jaxtrapolate.ops.warp import backward_warp, in_frame, landing, pixel_grid, take_rows
from jaxtrapolate.precision import divide, widest
from jaxtrapolate.records import Keyframe

NEARER = 0.05
"""How much nearer, relatively, a depth has to be to be another surface's."""

_TARGET = 0.8  # the weight of the target's pixels beside that of the source's, which are what was seen
_SAMPLES = 4096  # pixels that the change of depth is fitted to
_ROUNDS = 6


def planes(depth: Float[Array, "h w 1"]) -> Float[Array, "h w 3"]:
    """Each pixel's nearness 1 / depth, 0 where nothing is, and its slopes along x and y, those of its own plane.

    A slope is the smaller of the differences to both neighbours, 0 where these have opposite signs, so that one beside
    a silhouette is that of the surface, and a pixel that is no surface's but its own has none.
    """
    nearness = divide(1, depth, where=~(depth == jnp.inf))
    slopes = []
    for axis in (1, 0):
        if nearness.shape[axis] == 1:
            slopes.append(jnp.zeros_like(nearness))
            continue
        steps = jnp.diff(nearness, axis=axis)
        first, last = (jax.lax.slice_in_dim(steps, *ends, axis=axis) for ends in ((0, 1), (-1, None)))
        before, after = jnp.concatenate([first, steps], axis), jnp.concatenate([steps, last], axis)
        smaller = jnp.where(jnp.abs(before) < jnp.abs(after), before, after)
        slopes.append(jnp.where(jnp.sign(before) * jnp.sign(after) > 0, smaller, 0))
    return jnp.concatenate([nearness, *slopes], -1)


def expected_depth(
    depth: Float[ArrayLike, "h w 1"], source_depth: Float[ArrayLike, "h w 1"], motion: Float[ArrayLike, "h w 2"]
) -> Float[Array, "h w 1"]:
    """The depth that a target's surfaces had in the source frame, if they moved as most of the frame did.

    A point of a static scene at pixel (x, y) has the depth z' = z (a x + b y + c) + d in another frame, whatever the
    cameras. These four numbers are fitted to the depths that the motion leads to, by least squares with the weights of
    Geman & McClure, 1 / (1 + (r / 2s)^2)^2, r the residual and s the median of its size: what is hidden or moves by
    itself has no part in them. So it needs neither cameras nor a unit; where depth is only ordinal it says how the
    frame's depths changed as a whole.

    Args:
        depth: `[H, W, 1]` of the target; +inf where nothing is.
        source_depth: `[H, W, 1]` of the source, likewise.
        motion: `[H, W, 2]` from target to source.

    Returns:
        `[H, W, 1]`, at least float32; the ratio to `depth` is held to 1/10 to 10. +inf and NaN stay.

    Gradient:
        With respect to depth, with the four numbers held fixed.
    """
    depth, source_depth, motion = (jnp.asarray(a) for a in (depth, source_depth, motion))
    wide = widest(depth, motion)
    depth, source_depth = depth.astype(wide), source_depth.astype(wide)
    height, width, _ = depth.shape
    x, y = pixel_grid(height, width, wide)
    x, y = (jnp.broadcast_to((v + 0.5) / n - 0.5, (height, width)) for v, n in ((x, width), (y, height)))
    step = max(1, round((height * width / _SAMPLES) ** 0.5))

    def thin(a):
        return jax.lax.stop_gradient(a[step // 2 :: step, step // 2 :: step])

    found = thin(backward_warp(source_depth, motion, filter="nearest")[..., 0])
    here = thin(depth[..., 0])
    seen = thin(in_frame(motion)) & (here < jnp.inf) & (found < jnp.inf)
    count = jnp.sum(seen.astype(wide))
    nearness = divide(1, here, where=seen)
    unit = divide(count, jnp.sum(nearness), otherwise=1)  # the harmonic mean
    ratio = jnp.where(seen, found * nearness, 1)
    features = jnp.stack([thin(x), thin(y), jnp.ones_like(ratio), nearness * unit], -1).reshape(-1, 4)
    target, seen = ratio.reshape(-1) - 1, seen.reshape(-1)

    def improve(_, coefficients):
        off = jnp.abs(jnp.sum(features * coefficients[None, :], -1) - target)
        typical = jnp.nanquantile(jnp.where(seen, off, jnp.nan), jnp.asarray(0.5, wide))  # nanmedian takes float64
        typical = jnp.where(typical > 1e-4, typical, 1e-4)  # also where nothing is seen: NaN
        weight = jnp.where(seen, 1 / jnp.square(1 + jnp.square(off / (2 * typical))), 0)
        # a pull towards no change decides what the frame leaves open: all at one depth, or nothing there
        pull = (1e-4 * jnp.sum(weight) + 1e-6) * jnp.eye(4, dtype=wide)
        normal = jnp.sum(weight[:, None, None] * features[:, :, None] * features[:, None, :], 0) + pull
        return jnp.linalg.solve(normal, jnp.sum((weight * target)[:, None] * features, 0))

    a, b, c, d = jax.lax.fori_loop(0, _ROUNDS, improve, jnp.zeros(4, wide))
    ratio = (1 + a * x + b * y + c)[..., None] + d * unit * divide(1, depth, where=depth < jnp.inf)
    return depth * jnp.clip(jax.lax.stop_gradient(ratio), 0.1, 10)


def _votes(image: Array, x: Array, y: Array, expected: Array, least: float) -> tuple[Array, Array]:
    """How much of the 16 pixels around positions is in front of a surface of an expected nearness; and of how much.

    A pixel at distance r weighs exp(-r^2 / 2) / r: the inverse of its distance (Shepard 1968), so that one that is hit
    decides alone, and less of those that are farther off than silhouettes are straight.
    """
    height, width, _ = image.shape
    rows, column, row = image.reshape(-1, 3), jnp.floor(x), jnp.floor(y)

    def add(k, sums):
        j, i = (jnp.asarray(n - 1, x.dtype) for n in (k // 4, k % 4))
        inside = (column + i >= 0) & (column + i < width) & (row + j >= 0) & (row + j < height)
        index = jnp.where(inside, (row + j) * width + column + i, 0).astype(jnp.int32)
        near, along, down = jnp.moveaxis(take_rows(rows, index), -1, 0)
        dx, dy = x - column - i, y - row - j
        there = jnp.clip(near + along * dx + down * dy, 0.5 * near, 1.5 * near)
        front = (there > least * expected) | ((near == 0) & (expected > 0))
        squared = dx * dx + dy * dy
        weight = jnp.where(inside, jnp.exp(-0.5 * squared) * jax.lax.rsqrt(squared + 1e-6), 0)
        return sums[0] + jnp.where(front, weight, 0), sums[1] + weight

    return jax.lax.fori_loop(0, 16, add, (jnp.zeros_like(x), jnp.zeros_like(x)))


@jax.jit
def disoccluded(target: Keyframe, source: Keyframe) -> Bool[Array, "h w"]:
    """Whether the surface at a target pixel was hidden in the source frame, by depth.

    The surface had the depth z' = depth + the backward flow's change in the source frame, at the position x that the
    flow leads to. The 16 source pixels around x vote: by their own planes they are more than 5 % nearer at x, or not,
    the nearer ones with more weight. Where what hides it is seen in the target too, so do the 16 target
    pixels around the place that x has beside it there (x less the occluder's own flow): the same silhouette, sampled a
    fraction of a pixel further. More than half hides. `experiments/hole_masks.py` measures its precision and recall on
    embedded scenes; what is left are silhouettes that pass between pixels.

    False beyond the frame. A pixel that shows nothing (depth that is not positive, or infinite) is behind all surfaces;
    where the source shows nothing and the target a surface that was not there, as if hidden.

    Args:
        target: with depth and backward_flow.
        source: the I-frame before it, with depth; both in one metric unit.

    Returns:
        Bool `[H, W]`. A NaN depth hides nothing and is not hidden.

    Raises:
        TypeError, ValueError: a field is absent, no floating-point array, or of another size.
    """
    flow = check_present("target.backward_flow", target.backward_flow, needed_by="disoccluded")
    size = check_image("target.backward_flow", flow, channels=3)
    check_image("target.depth", target.depth, size=size, channels=1)
    check_image("source.depth", source.depth, size=size, channels=1)
    wide = widest(flow)
    depth, source_depth = (
        surface_depth(jnp.asarray(cast(Array, d), wide))  # `check_image` has refused None
        for d in (target.depth, source.depth)
    )
    flow = jnp.asarray(flow, wide)
    height, width = size
    motion, least = flow[..., :2], 1 + NEARER
    x, y, _ = landing(motion)
    x, y = jnp.clip(x, -0.5, width - 0.5), jnp.clip(y, -0.5, height - 0.5)
    then = changed(depth, flow[..., 2:])
    carried = planes(then)
    expected = carried[..., 0]
    hidden, whole = _votes(planes(source_depth), x, y, expected, least)

    occluder, _ = splat_nearest(jnp.concatenate([motion, held(then)], -1), motion, then)
    cell = [jnp.clip(jnp.floor(v), 0, n - 1).astype(jnp.int32) for v, n in ((x, width), (y, height))]
    over_x, over_y, over = jnp.moveaxis(take_rows(occluder.reshape(-1, 3), cell[1] * width + cell[0]), -1, 0)
    known = (over > 0) & (least * expected * over < 1)
    own, all_of_them = _votes(carried, x - over_x, y - over_y, expected, least)
    hidden = hidden + jnp.where(known, _TARGET * own, 0)
    whole = whole + jnp.where(known, _TARGET * all_of_them, 0)
    return in_frame(motion) & (2 * hidden > whole)


__all__ = ["NEARER", "disoccluded", "expected_depth", "planes"]
