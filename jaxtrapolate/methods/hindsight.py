"""Hindsight: is demodulation right here?

Dividing by the reflectance helps where light is reflectance times irradiance. Where it is not (emission, overexposure,
fog in front, sky) the quotient carries the texture's inverse, which moves with the surface like the texture itself, and
is harmless while texels map to the same texels, but prints a texture where the division and the multiplication meet
different ones. So both ways predict the newest rendered frame from the one before it, pixel by pixel; what was better
there is carried along the motion to the target.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_present
from jaxtrapolate.methods.frames import rendered
from jaxtrapolate.methods.space import Space, in_space
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.methods.stages import chain, reflecting
from jaxtrapolate.ops.radiance import By, compress, demodulate, modulate
from jaxtrapolate.ops.warp import backward_warp, landing, sample
from jaxtrapolate.precision import share, widest
from jaxtrapolate.records import Frame, replace

_BLOCK = 8  # pixels, the side of the blocks over which errors are averaged


@jax.custom_jvp
def block_sums(image: Float[Array, "h w 1"]) -> Float[Array, "i j 1"]:
    """Sums over blocks of 8 x 8 pixels; those at the right and lower border may be smaller.

    As two matrix products: XLA does not fuse them with what makes the image, which a CPU then does in vectors. The
    derivative takes sums instead, so that one that is not finite stays in its block.
    """
    height, width, _ = image.shape

    def member(size):
        return (jnp.arange(size)[:, None] // _BLOCK == jnp.arange(-(-size // _BLOCK))[None]).astype(image.dtype)

    return (member(height).T @ (image[..., 0] @ member(width)))[..., None]


@block_sums.defjvp
def _block_sums_jvp(primals, tangents):
    (image,), (tangent,) = primals, tangents
    rows, columns = (-(-size // _BLOCK) for size in image.shape[:2])
    short = [(0, count * _BLOCK - size) for count, size in zip((rows, columns), image.shape[:2], strict=True)]
    padded = jnp.pad(tangent[..., 0], short).reshape(rows, _BLOCK, columns, _BLOCK)
    return block_sums(image), jnp.sum(padded, (1, 3))[..., None]


def from_blocks(values: Float[Array, "i j c"], x: Array, y: Array) -> Float[Array, "h w c"]:
    """What blocks of 8 x 8 pixels have, at positions x, y `[H, W]` of an image, bilinear between their centres."""
    return sample(values, (x + 0.5) / _BLOCK - 0.5, (y + 0.5) / _BLOCK - 0.5)


@partial(jax.jit, static_argnames=("by", "space"))
def plain_share(
    newest: Frame,
    previous: Frame,
    motion: Float[Array, "h w 2"],
    *,
    by: By,
    floor: float | Float[Array, ""] = 1e-2,
    margin: float | Float[Array, ""] = 2.0,
    space: Space = "linear",
) -> Float[Array, "i j 1"]:
    """How much of a prediction should come from the undivided colour, 0..1, for each block of 8 x 8 pixels of `newest`.

    The squared errors of both predictions of `newest` from `previous`, tone mapped and summed over a block, say which
    was better: share = b^2 / ((margin a)^2 + b^2), a the plain one's and b the demodulated one's; 1 where neither errs,
    so that what stands still is exact. The margin of 2 is for what the methods add to demodulation: on 36 windows
    of embedded scenes the guided warp has 36.63 dB with it, 36.56 with 1 and 36.61 without hindsight (most of that on
    street, at night: 31.26 and 31.00); the occlusion warp has 33.49 with it and 33.62 with 1.

    Args:
        newest: a rendered frame with albedo.
        previous: the rendered frame before it, with albedo.
        motion: from the newest to the previous one.
        by: as of `demodulate`.
        floor: as of `demodulate`.
        margin: at least 0.
        space: in which colours are fetched, as the method that asks does.
    """
    truth = check_present("newest.color", newest.color, needed_by="plain_share")
    truth = compress(truth.astype(widest(truth)))
    color = check_present("previous.color", previous.color, needed_by="plain_share")
    fetch = partial(in_space, space, partial(backward_warp, motion=motion))
    plain, divided = fetch(color), fetch(demodulate(color, previous.gbuffer, by=by, floor=floor))

    def error(image):
        difference = jnp.square(compress(image.astype(truth.dtype)) - truth)
        return block_sums(difference[..., :1] + difference[..., 1:2] + difference[..., 2:])

    a, b = error(plain), error(modulate(divided, newest.gbuffer, by=by, floor=floor))
    return share(b, jnp.asarray(margin, a.dtype) * a, otherwise=1)


def hindsight_stage(how: Any = None) -> Stage:
    """Adds "plain_share", carried along the motion to the target's grid; `margin` is an option of the method.

    Args:
        how: has by, floor, sky and space, as of `demodulate_stage`.
    """

    def function(state, values: Values):
        history, given = values["history"], how or state.settings
        newest, previous = rendered(history)[:2]
        frames = (replace(history[i], gbuffer=reflecting(history[i].gbuffer, given.sky)) for i in (newest, previous))
        between = chain(history, newest, previous)
        options = {"by": given.by, "floor": given.floor, "margin": state.settings.margin, "space": given.space}
        found = plain_share(*frames, between, **options)
        x, y, _ = landing(values["motion"])
        return {"plain_share": from_blocks(found, x, y)}

    return Stage(
        "hindsight",
        function,
        takes=("history", "motion"),
        gives=("plain_share",),
        reads=("history.albedo", "target.albedo", "newest.motion", "before_newest.motion"),
        optional=True,
        past=2,
    )


HINDSIGHT = hindsight_stage()
"""Adds "plain_share", carried along the motion to the target's grid."""
