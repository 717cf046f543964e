"""Stages that several methods share.

Values they pass on: "sources", the rendered frames that are warped, newest first, and "motions", from the target to
each of them; "newest" and "motion", the first of both. "masks", bool, for each source where it shows something else,
and "holes", the first of them. "plain_share", where the undivided colour should be preferred, from
`jaxtrapolate.methods.hindsight`. "layers", for each source the image that is to be warped: its colour, or where that
can be the demodulated colour, followed by the undivided one where "plain_share" asks for both; "divisor", what the
target's is to be multiplied by again. "occlusion_motion". "warped", the layers warped to the target, and "image".
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.bidirectional.assisted import blend
from jaxtrapolate.checks import check_present
from jaxtrapolate.methods.frames import rendered
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.methods.space import Space, in_space, space
from jaxtrapolate.methods.stage import Needed, Stage, Values
from jaxtrapolate.ops.holes import Taps, hole_masks
from jaxtrapolate.ops.motion import chain_motion, occlusion_motion
from jaxtrapolate.ops.radiance import By, demodulate, demodulation_divisor
from jaxtrapolate.ops.warp import backward_warp
from jaxtrapolate.records import Frame, GBuffer, replace


def margin() -> Any:
    """The option of hindsight."""
    return option(2.0, "how much better the undivided colour must agree to make up half", low=0, high=1000)


@settings
class Demodulation:
    """How colours are divided by the reflectance, and fetched."""

    by: By = option("albedo+specular", "what the colour is divided by before it is warped", choices=By)
    floor: float = option(0.01, "the smallest divisor", low=0, high=1)
    sky: bool = option(True, "whether the sky's colour is warped undivided; else its albedo counts")
    margin: float = margin()
    space: Space = space()


def chain(frames: Sequence[Frame], first: int, last: int, *, before: Array | None = None) -> Array:
    """Motion from frames[first] to the older frames[last], through the motion of all frames between.

    With `before`, the motion from some frame to frames[first], it is the motion from that frame.
    """
    total = before
    for i in range(first, last, -1):
        name = f"frame {i - len(frames) + 1} before the target: motion"
        motion = check_present(name, frames[i].motion, needed_by="the chain of motion")
        total = motion if total is None else chain_motion(total, motion)
    return check_present(f"motion from frame {first} to the older frame {last}", total, needed_by="the warp")


def reproject_stage(past: int = 1) -> Stage:
    """Finds the newest `past` rendered frames and the motion that leads to each, as far back as motion vectors go."""

    def function(state, values: Values):
        history, target = values["history"], values["target"]
        frames, place, motion, sources, motions = (*history, target), len(history), None, [], []
        for older in rendered(history)[:past]:
            if sources and any(frame.motion is None for frame in frames[older + 1 : place + 1]):
                break
            motion, place = chain(frames, place, older, before=motion), older
            sources.append(history[older])
            motions.append(motion)
        return {
            "newest": sources[0],
            "motion": motions[0],
            "sources": tuple(sources),
            "motions": tuple(motions),
            "layers": tuple(jnp.asarray(source.color) for source in sources),
        }

    return Stage(
        "reproject",
        function,
        takes=("history", "target"),
        gives=("newest", "motion", "sources", "motions", "layers"),
        reads=("target.motion", "since_newest.motion", "history.color"),
    )


REPROJECT = reproject_stage()
"""Finds the newest rendered frame and the motion that leads there."""


def reflecting(gbuffer: GBuffer | None, sky: bool) -> GBuffer:
    """The G-buffer as demodulation sees it."""
    gbuffer = check_present("gbuffer", gbuffer, needed_by="demodulation")
    return gbuffer if sky else replace(gbuffer, sky=None)


_REFLECTANCE: Any = {"reads": ("history.albedo", "target.albedo"), "optional": True, "group": "demodulation"}


def demodulate_stage(how: Any = None) -> Stage:
    """Divides the sources by their reflectance; without albedo the colour is warped undivided.

    Args:
        how: has by, floor, sky and space, as `Demodulation`; `None` = the method's options.
    """

    def function(state, values: Values):
        layers, given = [], how or state.settings
        for source in values["sources"]:
            buffers = reflecting(source.gbuffer, given.sky)
            irradiance = demodulate(source.color, buffers, by=given.by, floor=given.floor)
            both = values["plain_share"] is not None
            layers.append(jnp.concatenate([irradiance, source.color], -1) if both else irradiance)
        target = reflecting(values["target"].gbuffer, given.sky)
        divisor = demodulation_divisor(target, by=given.by, floor=given.floor)
        return {"layers": tuple(layers), "divisor": divisor}

    takes = ("sources", "target", "plain_share?")
    return Stage("demodulate", function, takes, ("layers", "divisor"), **_REFLECTANCE)


def modulate_stage(how: Any = None) -> Stage:
    """Multiplies by the target's reflectance, and mixes in the colour that was warped undivided, by "plain_share".

    That colour is the method's own; the plain warp's where neither way has erred, so that what stands still is exact.
    (The plain warp's outside all hole masks costs the guided warp 0.2 dB on training seeds, where masks miss holes.)
    Options as of `demodulate_stage`.
    """

    def function(state, values: Values):
        given, warped = how or state.settings, values["warped"][..., :3]
        image = warped * values["divisor"].astype(warped.dtype)
        share = values["plain_share"]
        if share is not None:
            own = values["warped"][..., 3:]
            exact = in_space(given.space, partial(backward_warp, motion=values["motion"]), values["newest"].color)
            plain = jnp.where(values["holes"] | (share < 1), own, exact.astype(own.dtype))
            image = blend(image, plain, share)
        return {"image": image}

    takes = ("warped", "divisor", "plain_share?", "newest", "motion", "holes")
    return Stage("modulate", function, takes, ("image",), **_REFLECTANCE)


def _sky(state, values: Values):
    buffers, image = values["target"].gbuffer, values["image"]
    return {"image": jnp.where(buffers.sky > 0.5, jnp.asarray(buffers.sky_color, image.dtype), image)}


SKY = Stage("sky", _sky, ("target", "image"), ("image",), reads=("target.sky", "target.sky_color"), optional=True)
"""Takes the sky as the engine drew it for the target."""


def _occlusion(state, values: Values):
    return {"occlusion_motion": occlusion_motion(values["motion"], values["target"].gbuffer.depth)}


OCCLUSION = Stage(
    "occlusion motion",
    _occlusion,
    takes=("motion", "target", "holes"),
    gives=("occlusion_motion",),
    reads=("target.depth",),
    needed=Needed(
        "there are holes",
        lambda state, values: jnp.any(values["holes"]),
        lambda state, values: {"occlusion_motion": values["motion"]},
    ),
)
"""The motion of what hid the holes."""


COMPOSITE = ("motion", "holes", "occlusion_motion?")
"""What `composite` takes."""


def composite(
    values: Values, image: Float[Array, "h w c"], *, outside: Literal["edge", "zero"] = "edge"
) -> Float[Array, "h w c"]:
    """An image of the newest source along the motion, in holes along the occluder's where that is known.

    Guo et al. 2021 (ExtraNet), section 4.2.
    """
    motion, occluder = values["motion"], values["occlusion_motion"]
    along = motion if occluder is None else jnp.where(values["holes"], occluder, motion)
    return backward_warp(image, along, outside=outside)


def find_holes(
    target: GBuffer | None, source: GBuffer | None, motion: Array, *, taps: Taps = "nearest", **options
) -> Array:
    """The union `[H, W, 1]` of all hole masks that the buffers allow, by the pixel nearest to where the motion leads.

    Judged by all four bilinear taps, every pixel beside a silhouette would be a hole as well. Options as of
    `hole_masks`.
    """
    return hole_masks(target or GBuffer(), source or GBuffer(), motion, taps=taps, **options).any


def holes_stage(taps: Taps = "nearest", **options) -> Stage:
    """Marks where each source shows another surface; with no buffers at all, only what lies outside the frame."""

    def function(state, values: Values):
        buffers, pairs = values["target"].gbuffer, zip(values["sources"], values["motions"], strict=True)
        masks = tuple(find_holes(buffers, source.gbuffer, motion, taps=taps, **options) for source, motion in pairs)
        return {"holes": masks[0], "masks": masks}

    return Stage("holes", function, ("target", "sources", "motions"), ("holes", "masks"))


HOLES = holes_stage()
"""Marks where the warped frame shows another surface."""
