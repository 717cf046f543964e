"""Motion vectors: chains, conventions, cameras, occlusion motion.

Convention:
    Ours: a displacement in pixels to add, x right, y down; the surface point at p is at p + motion[p] in the other
    frame. Files' own conventions are converted where they are read, by `convert_motion`, and nowhere else.
"""

from functools import partial
from typing import Literal, cast, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_array, check_choice, check_image
from jaxtrapolate.ops.depth import surface_depth
from jaxtrapolate.ops.scatter import splat_nearest
from jaxtrapolate.ops.strips import once
from jaxtrapolate.ops.warp import backward_warp, held_motion, landing, take_rows
from jaxtrapolate.precision import divide
from jaxtrapolate.records import Camera, Sign, Units, YAxis, check_camera

Neighbours = Literal["diagonal", "cross", "square"]


@jax.jit
def chain_motion(newer: Float[Array, "h w 2"], older: Float[Array, "h w 2"]) -> Float[Array, "h w 2"]:
    """Motion over two steps: newer(p) + older(p + newer(p)).

    Args:
        newer: `[H, W, 2]` from a frame to the one before it.
        older: `[H, W, 2]` from that to a still earlier one.

    Returns:
        `[H, W, 2]` from the newest to the oldest of the three frames.

    Edge cases:
        `older` is interpolated bilinearly; beyond the frame its nearest border vector goes on. Motion that is not
        finite stays so: NaN or infinite in `newer`, or in an `older` vector that has weight. Longer motion than 2^30
        pixels is held there.

    Gradient:
        With respect to both, as of `backward_warp`.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that do not fit.

    References:
        Guo et al. 2021 (ExtraNet), section 4.4 ("we simply accumulate the motion vectors").
    """
    size = check_image("newer", newer, channels=2)
    check_image("older", older, size=size, channels=2)
    led = backward_warp(older, newer).astype(newer.dtype)
    # by component, because XLA's loops over two numbers are slow
    return jnp.stack([held_motion(newer[..., k]) + held_motion(led[..., k]) for k in (0, 1)], -1)


@partial(jax.jit, static_argnames=("sign", "units", "y_axis"))
def convert_motion(motion: Float[Array, "h w 2"], *, sign: Sign, units: Units, y_axis: YAxis) -> Float[Array, "h w 2"]:
    """Motion vectors of any engine in the library's convention.

    Args:
        motion: `[H, W, 2]`, x and y as stored.
        sign: "previous_minus_current" where the vector is to be added to reach the previous frame, or
            "current_minus_previous" where it is to be subtracted (a velocity).
        units: "pixels"; "uv", fractions of the frame's width and height; or "ndc", which spans 2 over the frame.
        y_axis: the direction in which y grows, "down" or "up".

    Returns:
        `[H, W, 2]` pixels to add, x right, y down; infinite where that is beyond the largest number.

    Raises:
        TypeError, ValueError: no floating-point array, a shape that does not fit, an option that is not listed.

    References:
        Convention of Unreal's dumps: current_minus_previous, pixels, up. Chen 2021 (notes on ExtraNet), section 2.1,
        prints a velocity current_minus_previous, uv, up.
    """
    height, width = check_image("motion", motion, channels=2)
    check_choice("sign", sign, get_args(Sign))
    check_choice("units", units, get_args(Units))
    check_choice("y_axis", y_axis, get_args(YAxis))
    scale = {"pixels": (1.0, 1.0), "uv": (width, height), "ndc": (width / 2, height / 2)}[units]
    forward = -1.0 if sign == "current_minus_previous" else 1.0
    down = -1.0 if y_axis == "up" else 1.0
    return motion * jnp.array([[[scale[0] * forward, scale[1] * forward * down]]], motion.dtype)


def _project(camera: Camera, points: Array, height: int, width: int) -> tuple[Array, Array]:
    """Pixel coordinates `[..., 2]` of homogeneous world points `[..., 4]`, and whether they lie before the camera."""
    view, projection = cast(Array, camera.view), cast(Array, camera.projection)  # `check_camera` has refused None
    clip = points @ (projection @ view).T
    w = clip[..., 3:]
    ndc = divide(clip[..., :2], w)
    half, size = jnp.array([0.5, -0.5], ndc.dtype), jnp.array([width, height], ndc.dtype)
    half, size = (jnp.broadcast_to(a, ndc.shape) for a in (half, size))
    return (ndc * half + 0.5) * size - 0.5, w > 0


def carried(position: Array, object_motion: Array | None, stencil: Array | None) -> tuple[Array, Array]:
    """Finite positions as homogeneous points `[H, W, 4]`, and these moved by the matrix that the stencil picks."""
    points = jnp.concatenate([position, jnp.ones_like(position[..., :1])], -1)
    if object_motion is None or stencil is None:
        return points, points
    count, (height, width) = object_motion.shape[0], position.shape[:2]
    ids = jnp.round(stencil[..., 0]).astype(jnp.int32)
    known = (ids >= 0) & (ids < count)
    matrices = take_rows(object_motion.reshape(count, 16), jnp.where(known, ids, 0)).reshape(height, width, 4, 4)
    # not a matrix product, which some GPUs take in fewer bits
    moved = jnp.sum(matrices * points[..., None, :], -1)
    return points, jnp.where(known[..., None], moved, points)


@jax.jit
def camera_motion(
    position: Float[Array, "h w 3"],
    camera: Camera,
    previous_camera: Camera,
    *,
    object_motion: Float[Array, "n 4 4"] | None = None,
    stencil: Float[Array, "h w 1"] | None = None,
) -> Float[Array, "h w 2"]:
    """Motion to the previous frame of surfaces at known positions, from the cameras of both frames.

    project(previous_camera, M s) - project(camera, s), s the position, M the object's motion backward in time (the
    identity for what is static).

    Args:
        position: `[H, W, 3]`, world space.
        camera: of this frame.
        previous_camera: of the frame before.
        object_motion: `[N, 4, 4]`: for each stencil id 0..N-1 the matrix from world positions now to world positions in
            the previous frame.
        stencil: `[H, W, 1]` ids that pick the matrix; ids beyond N-1 count as static. Needed with `object_motion`.

    Returns:
        `[H, W, 2]` pixels to add. NaN where a point is behind one of the cameras or its position is not finite: no
        position in the frame is right there, and the warps treat NaN as "no vector".

    Gradient:
        With respect to position, both cameras and the matrices; 0 where the result is NaN.

    Raises:
        TypeError, ValueError: no floating-point array, a shape that does not fit, a camera without a matrix, or one of
            object_motion and stencil without the other.

    References:
        Chen 2021 (notes on ExtraNet), section 2.1, which prints P M V s for P V M s; its velocity is current minus
        previous in fractions of the frame with y up: ours = (-W v_x, +H v_y).
    """
    height, width = check_image("position", position, channels=3)
    check_camera("camera", camera)
    check_camera("previous_camera", previous_camera)
    if (object_motion is None) != (stencil is None):
        raise ValueError("object_motion, stencil: expected both or neither, got one")
    finite = jnp.all(jnp.isfinite(position), -1, keepdims=True)
    if object_motion is not None and stencil is not None:
        check_array("object_motion", object_motion, shape=("N", 4, 4))
        check_image("stencil", stencil, size=(height, width), channels=1)
    points, previous = carried(jnp.where(finite, position, 0), object_motion, stencil)
    here, ahead = _project(camera, points, height, width)
    there, ahead_before = _project(previous_camera, previous, height, width)
    # once: what is all but a whole pixel would be rounded to either side of it by those who read it
    return once(jnp.where(finite & ahead & ahead_before, there - here, jnp.nan))


@jax.jit
def occlusion_motion(motion: Float[Array, "h w 2"], depth: Float[Array, "h w 1"]) -> Float[Array, "h w 2"]:
    """Motion for disoccluded pixels: that of the occluder which hid them in the source frame.

    The motion is splatted to the source frame (`splat_nearest`, footprint 4); a pixel takes the vector it finds where
    its own motion lands, floored and held to the frame.

    Args:
        motion: `[H, W, 2]` from the target to the source frame.
        depth: `[H, W, 1]` of the target; what is not positive is nothing, and behind all surfaces.

    Returns:
        `[H, W, 2]`; 0 where nothing was splatted to. A pixel that is nobody's background gets its own or a like vector.
        Motion that is not finite lands on the pixel itself and is not splatted.

    Gradient:
        With respect to the values of the motion that is picked; none with respect to where it lands, nor to depth.

    Raises:
        TypeError, ValueError: no floating-point array, or shapes that do not fit.

    References:
        Zeng et al. 2021; Guo et al. 2021 (ExtraNet), section 4.2, in the form of the authors' release.
    """
    size = check_image("motion", motion, channels=2)
    check_image("depth", depth, size=size, channels=1)
    height, width = size
    splatted, _ = splat_nearest(motion, motion, depth)
    x, y, _ = landing(jax.lax.stop_gradient(motion))
    column = jnp.clip(jnp.floor(x), 0, width - 1).astype(jnp.int32)
    row = jnp.clip(jnp.floor(y), 0, height - 1).astype(jnp.int32)
    return take_rows(splatted.reshape(-1, 2), row * width + column)


_NEIGHBOURS = {
    "diagonal": ((-1, -1), (-1, 1), (1, -1), (1, 1)),
    "cross": ((-1, 0), (0, -1), (0, 1), (1, 0)),
    "square": ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)),
}


@partial(jax.jit, static_argnames=("neighbours",))
def dilate_motion(
    motion: Float[Array, "h w 2"],
    depth: Float[Array, "h w 1"],
    *,
    neighbours: Neighbours = "diagonal",
) -> Float[Array, "h w 2"]:
    """Each pixel takes the motion of the nearest in depth of itself and its neighbours.

    The silhouettes of moving objects then carry their antialiased edge along.

    Args:
        motion: `[H, W, 2]`.
        depth: `[H, W, 1]`, smaller is nearer; what is not positive is nothing, and far.
        neighbours: "diagonal" (four, as Unreal's engine pass), "cross" (four) or "square" (eight).

    Returns:
        `[H, W, 2]`. Ties keep the pixel's own vector, then go to the first neighbour row by row; a NaN depth is never
        nearer; neighbours beyond the frame do not count.

    Gradient:
        With respect to the motion that is picked; none with respect to depth.

    Raises:
        TypeError, ValueError: no floating-point array, shapes that do not fit, or an unknown `neighbours`.

    References:
        Karis 2014; Yang et al. 2020, section 4.2.
    """
    size = check_image("motion", motion, channels=2)
    check_image("depth", depth, size=size, channels=1)
    check_choice("neighbours", neighbours, get_args(Neighbours))
    height, width = size
    depth = surface_depth(jax.lax.stop_gradient(depth))
    nearest = jnp.where(jnp.isnan(depth), jnp.inf, depth)
    around_depth = jnp.pad(nearest, ((1, 1), (1, 1), (0, 0)), constant_values=jnp.inf)
    around = jnp.pad(motion, ((1, 1), (1, 1), (0, 0)))
    for j, i in _NEIGHBOURS[neighbours]:
        window = slice(1 + j, 1 + j + height), slice(1 + i, 1 + i + width)
        nearer = around_depth[window] < nearest
        motion = jnp.where(nearer, around[window], motion)
        nearest = jnp.where(nearer, around_depth[window], nearest)
    return motion
