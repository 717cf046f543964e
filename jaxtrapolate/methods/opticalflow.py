"""Interpolation by optical flow: what a display or a video player does, which knows nothing but the images."""

from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.bidirectional.assisted import blend as mix
from jaxtrapolate.methods.between import PAIR
from jaxtrapolate.methods.blending import evenly
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.methods.space import Space, in_space, space
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.ops.dis import Preset, dis_flow
from jaxtrapolate.ops.radiance import srgb_encode, tonemap
from jaxtrapolate.ops.warp import backward_warp
from jaxtrapolate.precision import widest

_LUMA = (0.299, 0.587, 0.114)


def gray(color: Float[Array, "h w 3"]) -> Float[Array, "h w 1"]:
    """What a display shows, as grey levels 0..1: in sRGB, or tone mapped where a channel of the image is above 1.

    Pixels that are not finite are black.
    """
    held = jnp.where(jnp.isfinite(color), color, 0).astype(widest(color))
    shown = jnp.where(jnp.max(held) <= 1, srgb_encode(jnp.clip(held, 0, 1)), tonemap(held))
    return jnp.sum(shown * jnp.asarray([[_LUMA]], shown.dtype), -1, keepdims=True)


@settings
class FlowSettings:
    """Of the optical flow."""

    preset: Preset = option("medium", "of dis_flow: the better, the slower", choices=Preset)
    space: Space = space()


def dis() -> Method:
    """Both rendered frames fetched along their optical flow (DIS, preset medium unless said) and mixed by time.

    With F and B the flows from the previous to the next frame and back, the flow from the target to the previous frame
    is taken for -alpha (1 - alpha) F + alpha^2 B at the target's own pixel, that to the next for (1 - alpha)^2 F -
    alpha (1 - alpha) B.

    References: Kroeger et al. 2016 for the flow, Jiang et al. 2018 (Super SloMo), equation 4, for that of the target.
    Departures: no occlusion is reasoned about; colours are fetched after a curve near the display's, unless said.
    """

    def flow(state, values: Values):
        first, second = gray(values["previous"].color), gray(values["next"].color)
        pairs = {"forward": (first, second), "backward": (second, first)}
        return {name: dis_flow(*pair, preset=state.settings.preset) for name, pair in pairs.items()}

    def function(state, values: Values):
        forward, backward = values["forward"], values["backward"]
        alpha = values["alpha"].astype(forward.dtype)
        rest = 1 - alpha
        motions = alpha * (alpha * backward - rest * forward), rest * (rest * forward - alpha * backward)
        first, second = (
            in_space(state.settings.space, partial(backward_warp, motion=motion), values[name].color)
            for name, motion in zip(pair, motions, strict=True)
        )
        return {"image": mix(first, second, evenly(alpha, first))}

    pair, flows = ("previous", "next"), ("forward", "backward")
    stages = (
        PAIR,
        Stage("optical flow", flow, pair, flows),
        Stage("fetch", function, (*pair, *flows, "alpha"), ("image",)),
    )
    return Method("dis", stages, kind="interpolation", future=1, settings=FlowSettings())
