"""Bidirectional reprojection (Yang et al. 2011): image-based, scene-assisted, or both in one frame (section 6)."""

from collections.abc import Sequence
from functools import partial
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxtrapolate.bidirectional.assisted import (
    CASES,
    Interpolation,
    Offsets,
    Shader,
    check_keyframe,
    drawn_over,
    interpolate_assisted,
)
from jaxtrapolate.bidirectional.image_based import SEARCH, VISIBILITY, interpolate_image_based
from jaxtrapolate.bidirectional.options import SearchOptions, VisibilityOptions
from jaxtrapolate.checks import ArrayLike, Size, check_choice, check_image, check_present
from jaxtrapolate.ops.warp import Filter
from jaxtrapolate.records import Keyframe, replace

TargetMode = Literal["reproject", "render"]


def interpolate_bidirectional(
    previous: Keyframe,
    next: Keyframe,
    alpha: float | Float[ArrayLike, ""],
    *,
    target: Keyframe | None = None,
    stencil_ids: Sequence[int] | None = None,
    target_mode: TargetMode = "reproject",
    offsets: Offsets | None = None,
    search: SearchOptions = SEARCH,
    visibility: VisibilityOptions = VISIBILITY,
    filter: Filter = "bilinear",
    shade_on_miss: Shader | None = None,
    shade_attributes: Shader | None = None,
) -> Interpolation:
    """The frame at t + alpha from the rendered frames at t and t + 1, by whatever is known of it.

    Without a `target` by `interpolate_image_based`. With a `target`, the geometry of the frame to be generated, by
    `interpolate_assisted`. With `stencil_ids` as well, the target's pixels of those ids are drawn over the image-based
    frame through one depth buffer (section 6): reprojected, or, where the I-frames leave them out, as the target's own
    colour has them.

    Args:
        previous: color `[H, W, C]`, any attributes, forward_flow, depth (may be absent).
        next: color, backward_flow, depth.
        alpha: in 0..1, traced; at 0 and 1 the image-based frames are returned bit for bit.
        target: depth, backward_flow to `previous`, forward_flow to `next` (see `camera_flow`), stencil. In the mode
            "render" color, depth, stencil.
        stencil_ids: which of the target's ids are drawn over; `None` = the whole frame is scene-assisted.
        target_mode: "reproject" or "render", as above.
        offsets: as of `interpolate_image_based`.
        search: as of `interpolate_image_based`.
        visibility: as of `interpolate_image_based`; its `epsilon_depth` holds for the target as well.
        filter: of the colours, as in `backward_warp`.
        shade_on_miss: for pixels of the target visible in neither frame, see `interpolate_assisted`.
        shade_attributes: called with the blended attributes, gives the colour; in the mode "render" the target's
            colour is drawn after it.

    Returns:
        An `Interpolation`.

    Convention:
        Each flow belongs to its own frame's grid and is added; pixels, x right, y down, integers are centres.

    Gradient:
        As of `interpolate_image_based` and `interpolate_assisted`; which of the two a pixel takes is held fixed.

    Raises:
        TypeError, ValueError: a field is absent that is needed, no floating-point array, or of another size; an option
            that is not listed, or does not go with the others.

    References:
        Yang et al. 2011, sections 4, 5, 6 and 9.
    """
    check_choice("target_mode", target_mode, get_args(TargetMode))
    if target is None and stencil_ids is not None:
        raise ValueError("stencil_ids: expected None without a target")
    if target is not None and stencil_ids is None and target_mode == "render":
        raise ValueError("stencil_ids: absent (None), but target_mode='render' needs it")
    above = None
    if target is not None and target_mode == "reproject":
        above = interpolate_assisted(
            previous,
            next,
            target,
            alpha,
            epsilon_depth=visibility.epsilon_depth,
            filter=filter,
            shade_on_miss=shade_on_miss,
            shade_attributes=shade_attributes,
        )
        if stencil_ids is None:
            return above
    below = interpolate_image_based(
        previous,
        next,
        alpha,
        offsets=offsets,
        search=search,
        visibility=visibility,
        filter=filter,
        shade_attributes=shade_attributes,
    )
    if target is None or stencil_ids is None:
        return below
    size = check_keyframe("previous", previous)
    stencil = check_present("target.stencil", target.stencil, needed_by="stencil_ids")
    check_image("target.stencil", stencil, size=size, channels=1)
    above = _rendered(below, target, size) if above is None else above
    epsilon = jnp.asarray(visibility.epsilon_depth).astype(below.weight.dtype)
    return _drawn_ids(below, above, stencil, epsilon, stencil_ids=tuple(int(i) for i in stencil_ids))


def _rendered(below: Interpolation, target: Keyframe, size: Size) -> Interpolation:
    """The target's own colour and depth, as a layer over an interpolated frame."""
    color = check_present("target.color", target.color, needed_by="target_mode='render'")
    check_image("target.color", color, size=size, channels=below.color.shape[2])
    depth = check_present("target.depth", target.depth, needed_by="target_mode='render'")
    check_image("target.depth", depth, size=size, channels=1)
    return replace(below, color=color, depth=depth, case=jnp.full(size, CASES.index("rendered"), below.case.dtype))


@partial(jax.jit, static_argnames=("stencil_ids",))
def _drawn_ids(below, above, stencil, epsilon, *, stencil_ids):
    ids = jnp.round(stencil[..., 0]).astype(jnp.int32)
    covered = jnp.isin(ids, jnp.asarray(stencil_ids, jnp.int32))
    return drawn_over(below, above, covered, epsilon)
