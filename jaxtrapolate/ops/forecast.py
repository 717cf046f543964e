"""A target frame where nothing was drawn for it: the newest frame's motion carried on.

For sequences whose frames are all rendered, extrapolating methods still need a target's buffers. They are derived from
the newest frame's: each surface goes on moving as it did.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_present
from jaxtrapolate.ops.depth import surfaces
from jaxtrapolate.ops.scatter import splat_nearest
from jaxtrapolate.ops.warp import backward_warp, weigh
from jaxtrapolate.precision import widest
from jaxtrapolate.records import Frame, GBuffer, check_frame, replace


@jax.jit
def forecast(frame: Frame, fraction: float | Float[Array, ""]) -> Frame:
    """The buffers of a frame `fraction` of a frame step after `frame`, if everything goes on moving as it does.

    The motion to the previous frame, reversed and scaled by `fraction`, is splatted along itself, the nearest depth
    winning; where nothing lands the pixel keeps its own. Buffers are fetched along the result, from the nearest pixel.
    What comes into view is unknown, and what turns or accelerates is wrong by that: an approximation, unlike the drawn
    buffers of a frame.

    Args:
        frame: with motion; depth decides what hides what, without it everything is at one depth. What it shows of
            nothing (depth that is not positive, the sky) lies behind all, and has depth +inf in the result.
        fraction: of the step from the frame before to `frame`; 0.5 is half way to a next frame.

    Returns:
        A `Frame` without colour, shadow and sky colour; its motion leads to `frame`.

    Raises:
        TypeError, ValueError: no motion, or buffers whose sizes differ.
    """
    check_frame("frame", frame)
    frame = surfaces(frame)
    back = check_present("frame.motion", frame.motion, needed_by="forecast")
    fraction = jnp.asarray(fraction).astype(back.dtype)
    onward = weigh(back, -fraction)
    depth = None if frame.gbuffer is None else frame.gbuffer.depth
    depth = jnp.zeros_like(back[..., :1]) if depth is None else depth
    landed, covered = splat_nearest(-onward, onward, depth)
    motion = jnp.where(covered[..., None], landed, weigh(back, fraction))
    buffers = frame.gbuffer
    if buffers is not None:
        buffers = replace(buffers, shadow=None, sky_color=None)
        buffers = GBuffer(
            **{
                name: None if value is None else backward_warp(value, motion, filter="nearest")
                for name, value in ((n, getattr(buffers, n)) for n in buffers.__dataclass_fields__)
            }
        )
    time = None if frame.time is None else jnp.asarray(frame.time).astype(widest(back)) + fraction.astype(widest(back))
    return Frame(gbuffer=buffers, motion=motion, camera=frame.camera, time=time)
