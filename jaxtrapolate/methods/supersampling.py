"""What methods that super sample share: the low-resolution frame, the answer to the frame before, and what is kept.

Values passed on: "image", on the target's own pixels until a stage makes it the answer, which is unjittered;
"previous", the answer to the frame before, warped to the target, `[scale H, scale W, 3]`, and "valid", bool, where
there is any. The carry is `Kept`. Motion and buffers are of the input's size alone.
"""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_present
from jaxtrapolate.methods.frames import Frames, newest_color
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.ops.jitter import jitter_difference
from jaxtrapolate.ops.upsample import upsample, upsampled_size
from jaxtrapolate.ops.warp import Filter, backward_warp, in_frame
from jaxtrapolate.precision import widest
from jaxtrapolate.records import Frame, record


@record
@dataclasses.dataclass(frozen=True)
class Kept:
    """What is kept from frame to frame.

    Attributes:
        image: `[scale H, scale W, 3]`, the answer to the frame before, linear radiance, unjittered.
        seen: 1 where there is one, 0 at first.
    """

    image: Float[Array, "i j 3"]
    seen: Float[Array, ""]


def starter(scale: int) -> Callable[[Frames, Frame], Kept]:
    """`Method.start`: nothing has been answered yet."""

    def start(history: Frames, target: Frame) -> Kept:
        color = newest_color(history, target)
        height, width = upsampled_size((color.shape[0], color.shape[1]), scale)
        wide = widest(color)
        return Kept(jnp.zeros((height, width, 3), wide), jnp.zeros((), wide))

    return start


RENDERED = Stage(
    "rendered frame",
    lambda state, values: {"image": jnp.asarray(values["target"].color)},
    ("target",),
    ("image",),
    on="rendered",
    past=0,
)
"""A rendered target is what is super sampled."""


def upsampled_motion(history: Frames, target: Frame, scale: int) -> Float[Array, "i j 2"]:
    """Unjittered motion from the answer's pixels to those of the answer before, of the target's as stages see it."""
    motion = jnp.asarray(check_present("target.motion", target.motion, needed_by="the history"))
    difference = jitter_difference(target, history[-1]) if history else None
    if difference is not None:
        motion = motion - difference.astype(motion.dtype)[None, None]
    jitter = None if target.jitter is None else jnp.asarray(target.jitter)
    return upsample(motion, scale=scale, jitter=jitter) * jnp.asarray(scale, motion.dtype)


def previous_stage(
    scale: int, *, encode: Callable[[Array], Array], filter: Filter | None = None, larger: str = "image"
) -> Stage:
    """Warps the answer to the frame before, in the values that `encode` makes of light.

    Where there is none, at first and beyond the frame, and where motion is absent or not finite, "valid" is false and
    the upsampled low-resolution frame stands in for it. Motion leads to the frame before in the sequence: the method is
    stepped through all of them.

    Args:
        scale: of the method.
        encode: from radiance to the values that are mixed.
        filter: how the history is fetched; `None` = the method's option `fetch`.
        larger: the value that is upsampled.
    """

    def function(state, values: Values):
        target, carry = values["target"], values["carry"]
        jitter = None if target.jitter is None else jnp.asarray(target.jitter)
        instead = upsample(encode(values[larger]), scale=scale, jitter=jitter)
        if target.motion is None:
            return {"previous": instead, "valid": jnp.zeros((*instead.shape[:2], 1), bool)}
        motion = upsampled_motion(values["history"], target, scale)
        how = filter or state.settings.fetch
        warped = backward_warp(encode(carry.image), motion, filter=how).astype(instead.dtype)
        valid = in_frame(motion)[..., None] & (carry.seen > 0) & jnp.all(jnp.isfinite(warped), -1, keepdims=True)
        return {"previous": jnp.where(valid, warped, instead), "valid": valid}

    takes = ("carry", "history", "target", larger)
    return Stage("previous answer", function, takes, ("previous", "valid"), on="both", past=0)


def kept(image: Float[Array, "i j 3"], before: Kept) -> dict[str, Array | Kept]:
    """A stage's answer: the image, and the carry that holds it."""
    held = jnp.where(jnp.isfinite(image), image, 0).astype(before.image.dtype)
    return {"image": image, "carry": Kept(held, jnp.ones_like(before.seen))}
