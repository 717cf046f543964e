"""3D flows for keyframes: from cameras, and where the input lacks them, from what it has.

Convention:
    As in `jaxtrapolate.ops.motion`: x and y in pixels to add, x right, y down; then the change of depth to add. depth
    is the distance along the view axis.
"""

import dataclasses
from functools import partial
from typing import cast, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrapolate.bidirectional.search import check_flow, positions, within
from jaxtrapolate.checks import Size, check_choice, check_image
from jaxtrapolate.ops.depth import apart as depth_apart
from jaxtrapolate.ops.depth import changed, held, surfaces_of
from jaxtrapolate.ops.fill import covered_around
from jaxtrapolate.ops.motion import camera_motion, carried
from jaxtrapolate.ops.scatter import splat_source
from jaxtrapolate.ops.warp import root, sample, take_rows
from jaxtrapolate.precision import divide, widest
from jaxtrapolate.records import Camera, DepthKind, Keyframe, replace

_HIDDEN = 0.2  # relative: a surface whose depth changes by more is taken for another one


def _view_depth(camera: Camera, points: Array) -> Array:
    """Distance along the view axis `[..., 1]` of homogeneous world points: clip w in units of its gradient.

    Of an orthographic camera, whose w is constant, -z of the camera's space.
    """
    view, projection = cast(Array, camera.view), cast(Array, camera.projection)
    seen = points @ view.T
    along = (seen[..., :3] @ projection[3, :3])[..., None]
    return divide(along, root(jnp.sum(jnp.square(projection[3, :3]))), otherwise=-seen[..., 2:3])


@jax.jit
def camera_flow(
    position: Float[Array, "h w 3"],
    camera: Camera,
    other_camera: Camera,
    *,
    object_motion: Float[Array, "n 4 4"] | None = None,
    stencil: Float[Array, "h w 1"] | None = None,
) -> Float[Array, "h w 3"]:
    """Exact 3D flow of surfaces at known positions, from the cameras (and objects' matrices) of both frames.

    Args:
        position: `[H, W, 3]`, world space.
        camera: of this frame.
        other_camera: of the frame that the flow leads to, before or after this one.
        object_motion: `[N, 4, 4]`: for each stencil id 0..N-1 the matrix from world positions in this frame to world
            positions in the other.
        stencil: `[H, W, 1]` ids that pick the matrix; ids beyond N-1 count as static. Needed with `object_motion`.

    Returns:
        `[H, W, 3]`: x and y as of `camera_motion`, then the change of depth. NaN where a point is behind one of the
        cameras or its position is not finite.

    Convention:
        A displacement to add, x right, y down. depth is the distance along the view axis: clip w, in units of the
        camera's space; for an orthographic camera -z there, as in OpenGL.

    Gradient:
        With respect to position, both cameras and the matrices; 0 where the result is NaN.

    Raises:
        TypeError, ValueError: no floating-point array, a shape that does not fit, a camera without a matrix, or one of
            object_motion and stencil without the other.

    References:
        Yang et al. 2011, section 3 and equations 1 and 2; Nehab et al. 2007.
    """
    motion = camera_motion(position, camera, other_camera, object_motion=object_motion, stencil=stencil)
    finite = jnp.all(jnp.isfinite(motion), -1, keepdims=True)
    points, moved = carried(jnp.where(finite, position, 0), object_motion, stencil)
    change = _view_depth(other_camera, moved) - _view_depth(camera, points)
    return jnp.concatenate([motion, jnp.where(finite, change, jnp.nan)], -1)


@partial(
    jax.tree_util.register_dataclass, data_fields=["previous", "next", "forward_known", "backward_known"],
    meta_fields=["derived"],
)  # fmt: skip
@dataclasses.dataclass(frozen=True)
class CompletedFlows:
    """Two keyframes with the flows between them, and which of these were derived.

    derived: the names of what the input lacked, of "forward_flow", "backward_flow", "forward_flow.z" and
    "backward_flow.z"; static. forward_known, backward_known `[H, W]`: where a derived flow was splatted, not filled in;
    `None` for one that was given.
    """

    previous: Keyframe
    next: Keyframe
    forward_known: Bool[Array, "h w"] | None
    backward_known: Bool[Array, "h w"] | None
    derived: tuple[str, ...]


def _fill(flow, covered, depth):
    """Uncovered pixels take the flow of one of the next covered ones left, right, above, below: that most like them.

    Like: the smallest difference of depth; at equal differences, or without depth, the closest; then in that order.
    """
    height, width, _ = flow.shape
    rows = flow.reshape(-1, flow.shape[-1])
    best, apart = jnp.zeros_like(flow), jnp.full(covered.shape, jnp.inf, jnp.float32)
    steps = jnp.full(covered.shape, height + width, jnp.int32)
    for found, index, far in covered_around(covered):
        differs = jnp.zeros(covered.shape, jnp.float32)
        if depth is not None:
            differs = depth_apart(take_rows(depth.reshape(-1, 1), index), depth)[..., 0].astype(jnp.float32)
            differs = jnp.where(jnp.isnan(differs), jnp.float32(jnp.finfo(jnp.float32).max), differs)
        better = found & ((differs < apart) | ((differs == apart) & (far < steps)))
        best = jnp.where(better[..., None], take_rows(rows, index), best)
        apart, steps = jnp.where(better, differs, apart), jnp.where(better, far, steps)
    return jnp.where(covered[..., None], flow, best)


def _turned(flow, own_depth, other_depth, metric):
    """The flow of the other frame's pixels, turned around and splatted to it; and where something was splatted.

    A point that lands where the other frame shows quite another depth is hidden there, and left out.
    """
    known = own_depth is not None
    own_depth = own_depth.astype(flow.dtype) if known else jnp.zeros((*flow.shape[:2], 1), flow.dtype)
    other_depth = None if other_depth is None else other_depth.astype(flow.dtype)
    carried = own_depth
    if flow.shape[-1] == 3 and known:
        carried = changed(own_depth, flow[..., 2:])
        flow = jnp.concatenate([flow[..., :2], jnp.where(own_depth == jnp.inf, 0, flow[..., 2:])], -1)
    index, covered = splat_source(flow[..., :2], carried)
    rows = jnp.concatenate([-flow, carried], -1)
    taken = take_rows(rows.reshape(-1, rows.shape[-1]), index)
    if metric and known and other_depth is not None:
        same = depth_apart(taken[..., -1:], other_depth) <= _HIDDEN * other_depth
        covered &= (same & ((taken[..., -1:] == jnp.inf) == (other_depth == jnp.inf)))[..., 0]
    return _fill(jnp.where(covered[..., None], taken[..., :-1], 0), covered, other_depth), covered


def _deepened(flow, depth, other_depth):
    """The flow with the change of depth found where it leads; 0 where that is outside, or of another surface."""
    finite = jnp.all(jnp.isfinite(flow), -1, keepdims=True)
    at = positions(flow.shape[0], flow.shape[1], flow.dtype) + jnp.where(finite, flow, 0)
    depth = depth.astype(flow.dtype)
    own = held(depth)
    change = sample(held(other_depth), at[..., 0], at[..., 1]).astype(flow.dtype) - own
    same = (jnp.abs(change) <= _HIDDEN * own) & jnp.isfinite(depth)
    used = finite & same & within(at, *depth.shape[:2])[..., None]
    return jnp.concatenate([flow, jnp.where(used, change, 0)], -1)


@partial(jax.jit, static_argnames=("depth",))
def complete_flows(previous: Keyframe, next: Keyframe, *, depth: DepthKind = "metric") -> CompletedFlows:
    """Two keyframes with both flows between them, those that the input lacks derived from the other.

    A missing flow is the other one turned around: -flow, splatted along it (`splat_nearest`, depth-tested where there
    is depth). Where nothing lands (points that are hidden or outside in the other frame), or, with metric depth, where
    a point lands whose depth differs by more than 20 % from what is there, the pixel takes the flow of one of the four
    next pixels left, right, above and below that got one: that of the most similar depth, else the closest. A missing
    change of depth is the difference of the depth buffers (bilinear) along the flow, if metric; 0 where that leads
    outside, or is more than 20 %: another surface.

    Args:
        previous: forward_flow to `next`, `[H, W, 3]` or, without the change of depth, `[H, W, 2]`; and depth
            `[H, W, 1]`, which may be absent; what is not positive is nothing, and far.
        next: likewise, with backward_flow to `previous`. At least one of the two flows is needed.
        depth: "metric" (distance along the view axis), or "ordinal" (only its order counts).

    Returns:
        `CompletedFlows`. What was given is kept unchanged, but nothing has depth +inf. Flow vectors of a splat are of
        the dtype of the given flow.

    Convention:
        Pixels to add, x right, y down; each flow belongs to its own keyframe's grid.

    Edge cases:
        Where no pixel in the same row and column got a flow, it is 0. Given vectors that are not finite are not
        splatted, but where nothing was hit a change of depth does not matter: what is far stays far, and a derived
        change is 0 there. A derived change of depth makes depth tests along it blind to all but jumps of 20 %; a round
        trip of the flows says more then (`interpolate_bidirectional`, visibility).

    Gradient:
        With respect to the flow and depth values as picked; which are picked is held fixed.

    Raises:
        TypeError, ValueError: neither flow is there, no floating-point array, or a shape that does not fit.

    References:
        Ours; Yang et al. 2011 (equations 1 and 2) have exact flows. Mark et al. 1997 for the splat.
    """
    check_choice("depth", depth, get_args(DepthKind))
    size: Size | None = None
    for name, value in (("previous.forward_flow", previous.forward_flow), ("next.backward_flow", next.backward_flow)):
        size = size if value is None else check_flow(name, value, size=size)
    if size is None:
        raise ValueError("previous.forward_flow, next.backward_flow: expected at least one, got neither")
    for name, value in (("previous.depth", previous.depth), ("next.depth", next.depth)):
        if value is not None:
            check_image(name, value, size=size, channels=1)
    previous, next = surfaces_of(previous), surfaces_of(next)
    forward, backward = previous.forward_flow, next.backward_flow
    forward_known = backward_known = None
    derived: tuple[str, ...] = ()
    metric = depth == "metric"
    if forward is None:
        forward, forward_known = _turned(_wide(backward), next.depth, previous.depth, metric)
        derived += ("forward_flow",)
    elif backward is None:
        backward, backward_known = _turned(_wide(forward), previous.depth, next.depth, metric)
        derived += ("backward_flow",)
    if metric and previous.depth is not None and next.depth is not None:
        if cast(Array, forward).shape[2] == 2:
            forward = _deepened(_wide(forward), previous.depth, next.depth)
            derived += ("forward_flow.z",)
        if cast(Array, backward).shape[2] == 2:
            backward = _deepened(_wide(backward), next.depth, previous.depth)
            derived += ("backward_flow.z",)
    previous, next = replace(previous, forward_flow=forward), replace(next, backward_flow=backward)
    return CompletedFlows(previous, next, forward_known, backward_known, derived)


def _wide(flow):
    return flow.astype(widest(flow))
