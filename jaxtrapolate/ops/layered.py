"""What frames have seen and the newest does not show: points behind its surfaces and beyond its border.

One such point for each pixel of a raster, that of the newest frame and a margin around it: the second layer of a
layered depth image (Shade et al. 1998). Points keep their place in the world, so that nothing drifts when the raster
moves on; each frame costs one scatter, however many frames have been seen.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrapolate.checks import Size
from jaxtrapolate.ops._hole_parts import cosine, dot, footprint
from jaxtrapolate.ops.projection import placed
from jaxtrapolate.ops.scatter import nearest_keys, sources_of
from jaxtrapolate.ops.strips import once
from jaxtrapolate.ops.warp import bilinear_taps, take_rows
from jaxtrapolate.precision import divide
from jaxtrapolate.records import record

MARGIN = 8  # the share of a side that the raster has more, on each side: 1 / MARGIN
_SPACINGS = 2.0  # of neighbouring points: so far apart may be what counts as one
_ALIKE = 0.9  # cosine of the normals of one surface
_LEAST = 0.25  # of the weight of the four points around a place


@record
@dataclasses.dataclass(frozen=True)
class Points:
    """Points of the scene.

    Attributes:
        position: `[*N, 3]`, world space.
        normal: `[*N, 3]`; 0 where unknown.
        values: `[*N, C]`, what is known of each.
        known: bool `[*N, 1]`, whether there is one.
    """

    position: Float[Array, "*n 3"]
    normal: Float[Array, "*n 3"]
    values: Float[Array, "*n c"]
    known: Bool[Array, "*n 1"]

    def flat(self) -> "Points":
        """In one row."""
        return jax.tree.map(lambda a: a.reshape(-1, a.shape[-1]), self)


@record
@dataclasses.dataclass(frozen=True)
class HiddenLayer:
    """Points that the newest frame does not show, one for each pixel of its raster and of a margin around it.

    Attributes:
        points: `[I, J, ...]`.
        matrix: of the newest frame, see `fitted_projection`.
    """

    points: Points
    matrix: Float[Array, "3 4"]


class Landed(NamedTuple):
    """Points `[N, ...]` in a frame.

    Attributes:
        values: theirs.
        shown: the values that the frame shows at their place.
        inside: whether that is in the frame.
        same: whether the frame shows them there.
        index: of the pixel, row by row; 0 where it is outside.
    """

    values: Float[Array, "n c"]
    shown: Float[Array, "n c"]
    inside: Bool[Array, " n"]
    same: Bool[Array, " n"]
    index: Int[Array, " n"]


def margins(size: Size) -> Size:
    """How many pixels the raster has more on each side, down and across."""
    return size[0] // MARGIN, size[1] // MARGIN


def no_points(size: Size, channels: int, dtype: Any) -> HiddenLayer:
    """Nothing has been seen yet, by frames of a size."""
    raster = tuple(n + 2 * more for n, more in zip(size, margins(size), strict=True))
    position, normal, values = (jnp.zeros((*raster, count), dtype) for count in (3, 3, channels))
    points = Points(position, normal, values, jnp.zeros((*raster, 1), bool))
    return HiddenLayer(points, jnp.zeros((3, 4), dtype))


def _limit(position: Array, known: Array) -> Array:
    """How far from a pixel's point another may be and count as one."""
    return _SPACINGS * footprint(position, ~known)


def _near(a: Array, b: Array, limit: Array) -> Array:
    apart = a - b
    return dot(apart, apart) <= jnp.square(limit)


def advanced(
    layer: HiddenLayer, before: Points, newest: Points, matrix: Float[Array, "3 4"], lasting: Bool[Array, "h w 1"]
) -> tuple[HiddenLayer, Landed, Landed]:
    """The layer of the newest frame: what that of the frame before had, and what that frame showed and this hides.

    Args:
        layer: of the frame before.
        before: what that frame showed of what does not move by itself, `[H, W, ...]`.
        newest: what the newest frame shows, moving or not; values do not matter but for the third result.
        matrix: the newest frame's, see `fitted_projection`.
        lasting: which points of the frame before may be kept.

    Returns:
        The layer, and where its points and those of the frame before are in the newest frame.

    Edge cases:
        A point that the newest frame does not show where it should, though nothing is in front of it, is gone: it has
        moved. What is nearest is kept where two land in one pixel. With a matrix of zeros nothing is kept.
    """
    height, width = size = newest.known.shape[0], newest.known.shape[1]
    down, across = margins(size)
    rows, columns = layer.points.known.shape[:2]
    points = jax.tree.map(lambda *parts: jnp.concatenate(parts), layer.points.flat(), before.flat())
    place, along = placed(matrix, points.position)
    column, row = (jnp.floor(jnp.clip(place[..., k], -1e6, 1e6) + 0.5).astype(jnp.int32) for k in (0, 1))
    ahead = points.known[..., 0] & (along[..., 0] > 0)
    inside = ahead & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    index = jnp.where(inside, row * width + column, 0)
    depth = jnp.where(newest.known, placed(matrix, newest.position)[1], 0)
    limit = _limit(newest.position, newest.known)
    shown = jax.tree.map(lambda a: take_rows(a.reshape(-1, a.shape[-1]), index), (newest, depth, limit))
    there, nearest, allowed = shown
    same = inside[:, None] & there.known & _near(points.position, there.position, allowed)
    behind = there.known & (nearest < along) & ~same
    on_raster = (row >= -down) & (row < height + down) & (column >= -across) & (column < width + across)
    may = jnp.concatenate([jnp.ones(rows * columns, bool), lasting.reshape(-1)])
    kept = ahead & on_raster & may & (~inside | behind[..., 0])
    cell = jnp.where(kept, (row + down) * columns + column + across, rows * columns)
    taken, known = sources_of(nearest_keys(cell, along[..., 0].astype(jnp.float32), rows * columns))
    laid = jax.tree.map(lambda a: take_rows(a, taken).reshape(rows, columns, -1), points)
    laid = dataclasses.replace(laid, known=known.reshape(rows, columns, 1))
    landed = Landed(points.values, there.values, inside, same[:, 0], index)
    parts = (jax.tree.map(lambda a, k=k: a[k], landed) for k in (slice(rows * columns), slice(rows * columns, None)))
    return HiddenLayer(laid, matrix), *parts


def from_layer(layer: HiddenLayer, surfaces: Points) -> tuple[Float[Array, "h w c"], Bool[Array, "h w 1"]]:
    """What a layer knows of surfaces, and where it does.

    The mean of those of the four points around a surface's place that are it: no farther than two spacings of the
    surface's own neighbours, and with a normal like its.

    Args:
        layer: of the newest frame.
        surfaces: `[H, W, ...]`; values do not matter.
    """
    height, width = surfaces.known.shape[:2]
    down, across = margins((height, width))
    place, along = placed(layer.matrix, surfaces.position)
    # made once: what is all but a whole pixel may be rounded to either side of it, by the taps and by their weights
    place = once(place)
    x, y = place[..., 0] + across, place[..., 1] + down
    points, limit = layer.points, _limit(surfaces.position, surfaces.known)
    rows, columns = points.known.shape[:2]
    ahead = surfaces.known & (along > 0) & ((x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1))[..., None]
    dtype = points.values.dtype
    packed = jnp.concatenate([points.position, points.normal, points.known.astype(dtype), points.values], -1)
    total, count = jnp.zeros((height, width, points.values.shape[-1]), dtype), jnp.zeros((height, width, 1), dtype)
    for tap, weight in bilinear_taps(packed, x, y):
        position, normal, known, values = tap[..., :3], tap[..., 3:6], tap[..., 6:7], tap[..., 7:]
        angle, concerned = cosine(surfaces.normal, normal, unit=True)
        alike = (known > 0.5) & _near(surfaces.position, position, limit) & (~concerned | (angle > _ALIKE))
        weight = jnp.where(alike, weight, 0).astype(dtype)
        total, count = total + weight * jnp.where(alike, values, 0), count + weight
    return divide(total, count), ahead & (count > _LEAST)
