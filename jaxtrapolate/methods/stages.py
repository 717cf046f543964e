"""Stages that several methods share.

Values they pass on: "motion", from the target to the newest rendered frame, which is "newest"; "holes", a bool mask;
"plain_share", where the colour as it is should be preferred, from `jaxtrapolate.methods.hindsight`; "layer", the image
that is to be warped: the demodulated colour where that can be, followed by the colour as it is where "plain_share" asks
for both; "warped", the same after warping; "image".
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array

from jaxtrapolate.checks import check_present
from jaxtrapolate.gather import backward_warp
from jaxtrapolate.holes import hole_masks
from jaxtrapolate.methods.method import Stage, Values, rendered
from jaxtrapolate.motion import chain_motion
from jaxtrapolate.radiance import By, demodulate, modulate
from jaxtrapolate.records import Frame, GBuffer


def chain(frames: Sequence[Frame], first: int, last: int) -> Array:
    """Motion from frames[first] to the older frames[last], through the motion of all frames between."""
    total = None
    for i in range(first, last, -1):
        name = f"frame {i - len(frames) + 1} before the target: motion"
        motion = check_present(name, frames[i].motion, needed_by="the chain of motion")
        total = motion if total is None else chain_motion(total, motion)
    return check_present(f"motion from frame {first} to the older frame {last}", total, needed_by="the warp")


def _reproject(state, values: Values):
    history, target = values["history"], values["target"]
    newest = rendered(history)[0]
    return {"newest": history[newest], "motion": chain((*history, target), len(history), newest)}


REPROJECT = Stage("reproject", _reproject, reads=("target.motion", "history.color"))
"""Finds the newest rendered frame and the motion that leads there."""


def demodulate_stage(by: By = "albedo+specular") -> Stage:
    """Divides the newest frame by its reflectance; without albedo the colour is warped as it is."""

    def function(state, values: Values):
        newest = values["newest"]
        irradiance = demodulate(newest.color, newest.gbuffer, by=by)
        both = "plain_share" in values
        return {"layer": jnp.concatenate([irradiance, newest.color], -1) if both else irradiance}

    return Stage("demodulate", function, reads=("history.albedo", "target.albedo"), optional=True)


def layer(values: Values) -> Array:
    """What is to be warped: the demodulated colour, or the colour where that stage was left out."""
    return values["layer"] if "layer" in values else values["newest"].color


def modulate_stage(by: By = "albedo+specular") -> Stage:
    """Multiplies by the target's reflectance, and mixes in the colour that was warped as it is, by "plain_share".

    That colour is the plain warp's outside holes, and in holes the method's own.
    """

    def function(state, values: Values):
        image = modulate(values["warped"][..., :3], values["target"].gbuffer, by=by)
        if "plain_share" in values:
            plain = backward_warp(values["newest"].color, values["motion"])
            plain = jnp.where(values["holes"], values["warped"][..., 3:], plain)
            image = image * (1 - values["plain_share"]) + plain * values["plain_share"]
        return {"image": image}

    return Stage("modulate", function, reads=("history.albedo", "target.albedo"), optional=True)


def _sky(state, values: Values):
    buffers = values["target"].gbuffer
    return {"image": jnp.where(buffers.sky > 0.5, buffers.sky_color, values["image"])}


SKY = Stage("sky", _sky, reads=("target.sky", "target.sky_color"), optional=True)
"""Takes the sky as the engine drew it for the target."""


def find_holes(target: GBuffer | None, source: GBuffer | None, motion: Array) -> Array:
    """The union `[H, W, 1]` of all hole masks that the buffers allow, by the pixel nearest to the landing place.

    Judged by all four bilinear taps, every pixel beside a silhouette would be a hole as well.
    """
    return hole_masks(target or GBuffer(), source or GBuffer(), motion, taps="nearest").any


def _holes(state, values: Values):
    return {"holes": find_holes(values["target"].gbuffer, values["newest"].gbuffer, values["motion"])}


HOLES = Stage("holes", _holes)
"""Marks where the warped frame shows another surface; with no buffers at all, only what lies outside the frame."""
