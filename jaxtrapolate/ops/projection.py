"""Where a frame shows points of the world: by the matrix that its own positions and pixels fit.

A pinhole camera shows a point P at (u / w, v / w) with (u, v, w) = M (P, 1), M of 3 x 4. A frame with positions says
for each of its pixels which point it shows, so that M follows from the frame itself (Hartley and Zisserman, Multiple
View Geometry, section 7.1), jitter and all: on embedded scenes as exactly as from their cameras.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrapolate.checks import check_array, check_image
from jaxtrapolate.ops.fill import check_mask
from jaxtrapolate.ops.strips import once
from jaxtrapolate.ops.warp import pixel_grid
from jaxtrapolate.precision import divide, widest

_POINTS = 4096  # that the matrix is fitted to
_ROUNDS = 8  # of weights
_POLISHED = 3  # times the rest is solved for in each
_DAMPING = 1e-6  # of the normal equations' mean diagonal


@jax.jit
def fitted_projection(
    position: Float[Array, "h w 3"], known: Bool[Array, "h w"]
) -> tuple[Float[Array, "3 4"], Float[Array, ""]]:
    """The matrix M that takes a frame's positions to its pixels, and by how many pixels it misses.

    Direct linear transform with the weights 1 / w of the round before, so that what is least is the distance in
    pixels; about 4096 pixels, evenly spread, are looked at. Where all points lie in one plane M is right on that plane.

    Args:
        position: `[H, W, 3]`, world space.
        known: bool `[H, W]`: where a surface was hit. Moving objects count too: their positions are theirs.

    Returns:
        M `[3, 4]`, with pixel coordinates as `project` has them, and the root of the mean squared distance to the
        pixels; infinite with fewer than 16 points.

    Gradient:
        None: which points a frame shows where is held fixed.

    Raises:
        TypeError, ValueError: no floating-point image, no mask, or sizes that differ.
    """
    size = height, width = check_image("position", position, channels=3)
    check_mask("known", known, size=size)
    wide = widest(position)
    step = max(1, round((height * width / _POINTS) ** 0.5))
    x, y = (jnp.broadcast_to(v, size) for v in pixel_grid(height, width, wide))
    known = known & jnp.all(jnp.isfinite(position), -1)
    points = jax.lax.stop_gradient(jnp.where(known[..., None], position, 0).astype(wide))
    thin = (slice(step // 2, None, step), slice(step // 2, None, step))
    points, x, y, known = points[thin].reshape(-1, 3), x[thin].ravel(), y[thin].ravel(), known[thin].ravel()
    inside = known.astype(wide)
    count = jnp.sum(inside)
    center = divide(inside @ points, count)
    spread = divide(inside @ jnp.sum(jnp.abs(points - center[None]), -1), count, otherwise=1)
    scale = jnp.where(spread > 0, spread, 1)
    unit = jnp.asarray(max(height, width) / 2, wide)
    middle = jnp.array([(width - 1) / 2, (height - 1) / 2], wide)
    points = (points - center[None]) / scale
    u, v = (x - middle[0]) / unit, (y - middle[1]) / unit
    ones, nothing = jnp.ones((len(u), 1), wide), jnp.zeros((len(u), 4), wide)
    here = jnp.concatenate([points, ones], -1)
    # the last of the 12 numbers is 1: the middle of what a camera sees is ahead of it
    rows = jnp.concatenate(
        [
            jnp.concatenate([here, nothing, -u[:, None] * points], -1),
            jnp.concatenate([nothing, here, -v[:, None] * points], -1),
        ]
    )
    target = jnp.concatenate([u, v])

    def depth_of(found):
        return points @ found[8:] + 1

    def improve(_, found):
        along = depth_of(found)
        weight = jnp.where(known & (along > 1e-6), divide(1, along), 0)
        weights = jnp.concatenate([weight, weight])
        weighted = weights[:, None] * rows
        normal = weighted.T @ weighted
        normal = normal + (_DAMPING * jnp.trace(normal) / 11 + 1e-12) * jnp.eye(11, dtype=wide)
        for _ in range(_POLISHED):
            found = found + jnp.linalg.solve(normal, weighted.T @ (weights * (target - rows @ found)))
        return found

    found = jax.lax.fori_loop(0, _ROUNDS, improve, jnp.zeros(11, wide))
    along = depth_of(found)
    off = jnp.square(divide(here @ found[:4], along) - u) + jnp.square(divide(here @ found[4:8], along) - v)
    off = unit * jnp.sqrt(divide(jnp.sum(jnp.where(known, off, 0)), count))
    usual = (count >= 16) & jnp.all(jnp.isfinite(found))
    matrix = jnp.concatenate([found, jnp.ones(1, wide)]).reshape(3, 4)
    pixels = jnp.array([[unit, 0, middle[0]], [0, unit, middle[1]], [0, 0, 1]], wide)
    whole = jnp.concatenate([matrix[:, :3] / scale, (matrix[:, 3] - matrix[:, :3] @ (center / scale))[:, None]], -1)
    return jnp.where(usual, pixels @ whole, jnp.zeros((3, 4), wide)), jnp.where(usual, off, jnp.inf)


@jax.jit
def project(matrix: Float[Array, "3 4"], position: Float[Array, "h w 3"]) -> Float[Array, "h w 2"]:
    """The pixels at which points are seen, `[H, W, 2]`; NaN behind the camera, or where a position is not finite.

    Args:
        matrix: of `fitted_projection`; an all-zero one sees nothing.
        position: `[H, W, 3]`, world space.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that do not fit.
    """
    check_array("matrix", matrix, shape=(3, 4))
    check_image("position", position, channels=3)
    place, along = placed(matrix, position)
    # once: what is all but a whole pixel would be rounded to either side of it by those who read it
    return once(jnp.where(along > 0, place, jnp.nan))


def placed(matrix: Float[Array, "3 4"], position: Float[Array, "*n 3"]) -> tuple[Float[Array, "*n 2"], Array]:
    """The pixels at which points are seen, and how far ahead they are `[*N, 1]`: their depth but for a factor.

    Both 0 behind the camera, and where a position is not finite.
    """
    finite = jnp.all(jnp.isfinite(position), -1, keepdims=True)
    held = jnp.where(finite, position, 0)
    # not a matrix product, which some GPUs take in fewer bits
    rows = matrix.astype(held.dtype).reshape((1,) * (held.ndim - 1) + (3, 4))
    seen = jnp.sum(held[..., None, :] * rows[..., :3], -1) + rows[..., 3]
    along = jnp.where(finite & (seen[..., 2:] > 0), seen[..., 2:], 0)
    return divide(seen[..., :2], along, where=along > 0), along


__all__ = ["fitted_projection", "project"]
