"""Where searches start (Yang et al. 2011, section 5.3): by the other I-frame's flow, by the frame interpolated last."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.bidirectional.search import check_flow, only_finite, pair, plane, positions, scaled
from jaxtrapolate.checks import ArrayLike, check_image, check_scalar
from jaxtrapolate.ops.depth import surface_depth
from jaxtrapolate.ops.strips import by_strips, rows_of
from jaxtrapolate.precision import widest


def dual_start(flow: Float[ArrayLike, "h w c"], fraction: float | Float[ArrayLike, ""]) -> Float[Array, "h w 2"]:
    """Where to start a search from by the opposite frame's flow: p + fraction * flow(p).

    It finds a moving object past its silhouette, where the frame searched shows the background at p.

    Args:
        flow: `[H, W, 3]` or `[H, W, 2]` of the other I-frame, toward the one that is searched.
        fraction: of the search: alpha in the frame before, with the backward flow of the one after, and vice versa.

    Returns:
        `[H, W, 2]`, at least float32; the pixel itself where the flow is not finite. No gradient passes a start.

    Raises:
        TypeError, ValueError: no floating-point array, a shape that does not fit.

    References:
        Yang et al. 2011, section 5.3, equations 16 and 17.
    """
    height, _ = check_flow("flow", flow)
    check_scalar("fraction", fraction)
    wide = widest(flow)
    return pair(dual(flow.astype(wide), jnp.asarray(fraction).astype(wide), 0, height))


def dual(flow, fraction, top, rows: int):
    """`dual_start` of some rows, a complex plane."""
    motion = only_finite(plane(rows_of(flow, top, rows)))
    return plane(positions(rows, flow.shape[1], flow.dtype, top=top)) + scaled(motion, fraction)


def _nearest_of(depth, planes, reach, axis):
    """Along one axis, depth and planes where the depth is least within `reach`; ties keep the pixel, then the first.

    All have `reach` more at each end of the axis than the result.
    """
    size = depth.shape[axis] - 2 * reach
    places = [reach, *(k for k in range(2 * reach + 1) if k != reach)]
    (nearest, *chosen), *others = (
        [jax.lax.slice_in_dim(a, k, k + size, axis=axis) for a in (depth, *planes)] for k in places
    )
    for there, *values in others:
        closer = there < nearest
        chosen = [jnp.where(closer, a, b) for a, b in zip(values, chosen, strict=True)]
        nearest = jnp.minimum(nearest, there)
    return nearest, chosen


class LatestOffsets(NamedTuple):
    """Of the frame interpolated last: offsets `[H, W, 2]` (at least float32), its points' depths; the ratio to take."""

    offset: Array
    depth: Any
    ratio: Array


def latest(sources: LatestOffsets, top, rows: int, *, reach: int):
    """`latest_start` of some rows, a complex plane."""
    offset, depth, ratio = sources
    if depth is None or reach == 0:
        chosen = plane(rows_of(offset, top, rows))
    else:
        # with the rows above and below; outside the frame all is far
        number = top - reach + jnp.arange(rows + 2 * reach)
        around, far = (jnp.take(a, number, axis=0, mode="clip") for a in (offset, depth[..., 0]))
        beyond = (number < 0) | (number >= offset.shape[0])
        far = jnp.where(jnp.isnan(far) | beyond[:, None], jnp.inf, far)
        far = jnp.pad(far, [(0, 0), (reach, reach)], constant_values=jnp.inf)
        # components apart, which XLA vectorises on a CPU
        parts = [jnp.pad(around[..., k], [(0, 0), (reach, reach)]) for k in (0, 1)]
        for axis in (1, 0):
            far, parts = _nearest_of(far, parts, reach, axis)
        chosen = jax.lax.complex(*parts)
    return plane(positions(rows, chosen.shape[1], chosen.real.dtype, top=top)) - scaled(only_finite(chosen), ratio)


def latest_start(
    offset: Float[ArrayLike, "h w 2"],
    ratio: float | Float[ArrayLike, ""],
    *,
    depth: Float[ArrayLike, "h w 1"] | None = None,
    reach: int = 1,
) -> Float[Array, "h w 2"]:
    """Where to start a search from by the last interpolated frame: p - ratio * offset of the nearest surface around.

    Args:
        offset: `[H, W, 2]`, p - position of the search in the same I-frame for the frame interpolated last.
        ratio: alpha / alpha' in the I-frame before, (1 - alpha) / (1 - alpha') in the one after; alpha' of that frame.
        depth: `[H, W, 1]` that the points had in that frame, smaller is nearer; infinite, not positive or NaN where the
            search missed, or nothing is, which should not be followed. Without it each pixel keeps its own offset.
        reach: the neighbourhood is a square of 2 reach + 1 pixels; 0 = the pixel itself.

    Returns:
        `[H, W, 2]`; the pixel itself where the offset is not finite. Ties keep the pixel's own column or row.

    Raises:
        TypeError, ValueError: no floating-point array, a shape or option that does not fit.

    References:
        Yang et al. 2011, section 5.3, equations 18 and 19. Departure: offsets of searches that missed are left out,
        where the caller says so by their depth.
    """
    height, width = check_image("offset", offset, channels=2)
    if not isinstance(reach, int) or reach < 0:
        raise ValueError(f"reach: expected an integer of at least 0, got {reach!r}")
    check_scalar("ratio", ratio)
    wide = widest(offset)
    if depth is not None:
        check_image("depth", depth, size=(height, width), channels=1)
        depth = surface_depth(jnp.asarray(depth))
    sources = LatestOffsets(jnp.asarray(offset).astype(wide), depth, jnp.asarray(ratio).astype(wide))
    return pair(by_strips(partial(latest, reach=reach), height, sources))
