"""Grid warp: a coarse grid laid over a rendered frame, moved along its motion and drawn anew (Didyk et al. 2010).

Convention:
    As in `jaxtrapolate.ops.scatter`: the flow belongs to the rendered frame's pixels and is added; pixels, x right,
    y down, integers are centres.
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrapolate.checks import ArrayLike, check_image
from jaxtrapolate.ops.depth import held, surface_depth
from jaxtrapolate.ops.scatter import splat_source
from jaxtrapolate.ops.warp import landing, pixel_grid, sample, take_rows
from jaxtrapolate.precision import divide, widest

_STEP = 0.1  # relative: a neighbour farther by more is another surface
_LONGEST = 2.8  # cells: drawn at two samples a pixel, a longer edge would leave gaps


def _axis(size: int, cell: int) -> np.ndarray:
    """Pixels of the vertices along an axis, from the first to the last pixel, as even as can be, at least two."""
    count = max(1, -(-(size - 1) // cell))
    return np.round(np.arange(count + 1) * ((size - 1) / count)).astype(np.int32)


def _reach(axis: np.ndarray, cell: int) -> int:
    """How far vertices may be moved without passing each other."""
    return max(0, (min(cell, int(np.diff(axis).min())) - 1) // 2)


def _rims(depth: Array) -> Array:
    """Pixels `[H, W]` of which a neighbour is another surface, farther away."""
    near = depth[..., 0]
    wide = jnp.pad(near, 1, mode="edge")
    farthest = jnp.maximum(jnp.maximum(wide[:-2, 1:-1], wide[2:, 1:-1]), jnp.maximum(wide[1:-1, :-2], wide[1:-1, 2:]))
    return farthest - near > _STEP * jnp.abs(near)


def _corners(values: Array) -> list[Array]:
    """Of values at the vertices, those at each cell's four corners: (u, v) = (0, 0), (1, 0), (0, 1), (1, 1)."""
    return [values[:-1, :-1], values[:-1, 1:], values[1:, :-1], values[1:, 1:]]


def _turns(corners: list[Array]) -> Array:
    """The smallest of the cross products of the edges at a cell's corners: below 0 where it is folded or not convex."""
    a, b, c, d = corners

    def cross(at, along, down):
        p, q = along - at, down - at
        return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]

    first, second = jnp.minimum(cross(a, b, c), cross(b, d, a)), jnp.minimum(cross(c, a, d), cross(d, c, b))
    return jnp.minimum(first, second)


def _snapped(depth: Array, x: np.ndarray, y: np.ndarray, cell: int) -> Array:
    """Vertices `[J, I, 2]` (x, y), whole pixels: the closest rim of a near surface in reach, else the regular position.

    Vertices at the border stay there, and a vertex whose cell would no longer be convex goes back.
    """
    height, width, _ = depth.shape
    across, down = _reach(x, cell), _reach(y, cell)
    regular = jnp.stack(jnp.broadcast_arrays(jnp.asarray(x)[None, :], jnp.asarray(y)[:, None]), -1)
    offsets = [(j, i) for j in range(-down, down + 1) for i in range(-across, across + 1)]
    offsets = np.array(sorted(offsets, key=lambda o: (o[0] ** 2 + o[1] ** 2, o)))  # the closest first
    j, i = (offsets[:, k].reshape(-1, 1, 1) for k in (0, 1))
    inner_x, inner_y = (((v > 0) & (v < v[-1])) for v in (x, y))
    allowed = (inner_x[None, None, :] | (i == 0)) & (inner_y[None, :, None] | (j == 0))
    row, column = np.clip(y[None, :, None] + j, 0, height - 1), np.clip(x[None, None, :] + i, 0, width - 1)
    rim = _rims(depth).reshape(-1, 1)
    found = take_rows(rim, jnp.asarray(row * width + column))[..., 0] & jnp.asarray(allowed)
    first = jnp.argmax(found, 0)
    moved = regular + jnp.where(jnp.any(found, 0)[..., None], jnp.asarray(offsets[:, ::-1].astype(np.int32))[first], 0)

    def bad(vertices):
        """The vertices of cells that are not convex, where those cells can still be mended."""
        wrong = _turns(_corners(vertices)) < 0
        grown = jnp.pad(wrong, 1)
        touched = grown[:-1, :-1] | grown[:-1, 1:] | grown[1:, :-1] | grown[1:, 1:]
        return touched & jnp.any(vertices != regular, -1)

    def back(vertices):
        return jnp.where(bad(vertices)[..., None], regular, vertices)

    return jax.lax.while_loop(lambda v: jnp.any(bad(v)), back, moved)


def _bilinear(corners: Sequence[Array], u: Array, v: Array) -> Array:
    """Between values at four corners; exactly the value where all are equal."""
    a, b, c, d = corners
    upper, lower = a + u * (b - a), c + u * (d - c)
    return upper + v * (lower - upper)


def _inverse(corners: Array, target: tuple[Array, Array], start: tuple[Array, Array]) -> tuple[Array, Array]:
    """Where (u, v) in a cell a point (x, y) is, by Newton's method from a position near by; corners `[4, 2, ...]`."""
    x, y = ([corners[k, axis] for k in range(4)] for axis in (0, 1))

    def slopes(p, u, v):
        a, b, c, d = p
        return b - a + v * (d - c - b + a), c - a + u * (d - b - c + a)

    def step(place, _):
        u, v = place
        (x_u, x_v), (y_u, y_v) = slopes(x, u, v), slopes(y, u, v)
        miss_x, miss_y = _bilinear(x, u, v) - target[0], _bilinear(y, u, v) - target[1]
        determinant = x_u * y_v - y_u * x_v
        regular = jnp.abs(determinant) > 1e-6
        by = miss_x * y_v - miss_y * x_v, x_u * miss_y - y_u * miss_x
        nearer = (k - divide(d, determinant, where=regular) for k, d in zip(place, by, strict=True))
        u, v = (jnp.where(regular, jnp.clip(k, -0.5, 1.5), old) for k, old in zip(nearer, place, strict=True))
        return (u, v), None

    return jax.lax.scan(step, start, None, length=3)[0]  # a loop: unrolled, each step would compute all before twice


def _repeated(values: Array, n: int, axis: int) -> Array:
    """Each entry n times along an axis of a plane; `jnp.repeat` would gather."""
    shape = [*values.shape[: axis + 1], n, *values.shape[axis + 1 :]]
    stretched = jnp.broadcast_to(jnp.expand_dims(values, axis + 1), shape)
    return stretched.reshape([size * (n if k == axis else 1) for k, size in enumerate(values.shape)])


def _spread(values: Array, n: int) -> Array:
    """Values `[J, I]` of the vertices, bilinear at the middles of the n x n parts of each cell."""
    for axis in (1, 0):
        count = values.shape[axis] - 1
        low, high = (jax.lax.slice_in_dim(values, k, k + count, axis=axis) for k in (0, 1))
        part = jnp.tile((jnp.arange(n, dtype=values.dtype) + 0.5) / n, count)
        part = part[None, :] if axis == 1 else part[:, None]
        values = _repeated(low, n, axis) + part * _repeated(high - low, n, axis)
    return values


@partial(jax.jit, static_argnames=("cell", "snap"))
def grid_warp(
    image: Float[ArrayLike, "h w c"],
    flow: Float[ArrayLike, "h w 2"],
    depth: Float[ArrayLike, "h w 1"] | None,
    fraction: float | Float[ArrayLike, ""],
    *,
    cell: int = 8,
    snap: bool = True,
    tear: float | Float[ArrayLike, ""] = 2.0,
) -> tuple[Float[Array, "h w c"], Bool[Array, "h w"]]:
    """The image as a sheet of rubber: the vertices of a coarse grid move by fraction * flow, and it is drawn there.

    Each vertex has the flow and the depth of its pixel; within a cell both are bilinear. A pixel of the result finds
    the nearest cell that covers it, its place in that cell (the inverse of the bilinear map), and the colour there.

    Args:
        image: `[H, W, C]`.
        flow: `[H, W, 2]` in pixels.
        depth: `[H, W, 1]`, smaller is nearer, what is not positive is nothing, and the farthest; `None`: all as near.
        fraction: of the flow, traced.
        cell: the distance of vertices in pixels, about: they are spread evenly from the first to the last pixel.
        snap: whether a vertex moves to the closest pixel (within half a cell) of a near surface's rim, where the next
            pixel is farther by more than 10 %, so that the grid follows silhouettes; needs depth.
        tear: a cell is torn, and leaves a hole, where one of its edges gets longer than `tear` times what it was, or
            than 2.8 cells.

    Returns:
        The warped image, 0 in holes, and where it is covered, bool `[H, W]`. `fill_pyramid` fills the rest.

    Convention:
        Push: `flow` belongs to the image's pixels and is added; pixels, x right, y down, integers are centres.

    Exactness:
        No flow returns the image bit for bit, a flow of one whole-pixel value the shifted image.

    Edge cases:
        Cells that fold over (they are hidden behind what moved before them) and cells with a vertex of non-finite flow
        are not drawn. Of equal depths the cell that comes first row by row is drawn; an infinite depth is the farthest.

    Gradient:
        With respect to image, flow (at the vertices) and fraction; which cell is drawn, and depth, are held fixed.

    Raises:
        TypeError, ValueError: no floating-point array, a shape that does not fit, or a cell below 1.

    References:
        Didyk et al. 2010 (Perceptually-motivated real-time temporal upsampling), for the grid and its snapping;
        Schollmeyer et al. 2017 (Efficient hybrid image warping). Departures: the grid is uniform, not refined where
        depth asks for it; torn cells are not drawn, rather than stretched; no blur of uncertain regions and no
        compensation over time, which are for the eye; rasterisation is by four samples a pixel, depth-tested, which
        leave no gap up to `tear`.
    """
    height, width = size = check_image("image", image)
    check_image("flow", flow, size=size, channels=2)
    if depth is not None:
        check_image("depth", depth, size=size, channels=1)
        depth = surface_depth(jnp.asarray(depth))
    if not isinstance(cell, int) or cell < 1:
        raise ValueError(f"cell: expected an integer of at least 1, got {cell!r}")
    wide = widest(flow)
    fraction = jnp.asarray(fraction).astype(wide)
    x, y = _axis(width, cell), _axis(height, cell)
    if depth is not None and snap:
        places = _snapped(jax.lax.stop_gradient(depth), x, y, cell)
    else:
        places = jnp.stack(jnp.broadcast_arrays(jnp.asarray(x)[None, :], jnp.asarray(y)[:, None]), -1)
    index = places[..., 1] * width + places[..., 0]
    moves = take_rows(jnp.asarray(flow).astype(wide).reshape(-1, 2), index)
    finite = jnp.all(jnp.isfinite(moves), -1)
    moves = jnp.where(finite[..., None], moves, 0)
    own, carried = _corners(places.astype(wide)), _corners(moves)
    ends = [p + fraction * f for p, f in zip(own, carried, strict=True)]

    # samples at the middles of each cell's n x n parts; as a frame of their own they go through the depth test
    n = 2 * cell
    rows, columns = len(y) - 1, len(x) - 1
    drawn = jnp.all(jnp.stack(_corners(finite)), 0) & (_turns(ends) >= 0)
    for k, m in ((0, 1), (2, 3), (0, 2), (1, 3)):
        before, after = (jnp.sqrt(jnp.sum(jnp.square(e[m] - e[k]), -1)) for e in (own, ends))
        drawn &= (after <= jnp.asarray(tear).astype(wide) * before) & (after <= _LONGEST * cell)
    frame = rows * n, columns * n
    drawn = _repeated(_repeated(drawn, n, 0), n, 1)
    landed = places.astype(wide) + fraction * moves
    offset = [_spread(landed[..., k], n) - own for k, own in enumerate(pixel_grid(*frame, wide))]
    if depth is None:
        nearness = jnp.zeros(frame, wide)
    else:
        nearness = _spread(take_rows(held(depth).astype(wide).reshape(-1, 1), index)[..., 0], n)
    offset = jnp.stack([jnp.where(drawn, k, jnp.nan) for k in offset], -1)
    source, covered = splat_source(offset, nearness[..., None])
    source, covered = source[:height, :width], covered[:height, :width]

    row, column = source // frame[1], source % frame[1]
    which = (row // n) * columns + column // n
    planes = [take_rows(c[..., k].reshape(-1, 1), which)[..., 0] for c in (*ends, *carried) for k in (0, 1)]
    corners = jnp.stack(planes).reshape(8, 2, *size)
    px, py = (jnp.broadcast_to(k, size) for k in pixel_grid(height, width, wide))
    u, v = _inverse(corners[:4], (px, py), tuple(((k % n).astype(wide) + 0.5) / n for k in (column, row)))
    back = jnp.stack([-fraction * _bilinear(list(corners[4:, k]), u, v) for k in (0, 1)], -1)
    warped = sample(jnp.asarray(image), *landing(jnp.where(covered[..., None], back, 0))[:2])
    return jnp.where(covered[..., None], warped, 0), covered
