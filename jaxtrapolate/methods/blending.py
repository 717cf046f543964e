"""Baselines that mix the rendered frames around the target, their colours undivided: nothing is demodulated."""

from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.bidirectional.assisted import blend as mix
from jaxtrapolate.methods.between import BETWEEN, FLOWS, PAIR, depth_of
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.methods.space import Space, in_space, space
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.ops.fill import fill_pyramid
from jaxtrapolate.ops.radiance import tonemap
from jaxtrapolate.ops.scatter import splat
from jaxtrapolate.ops.warp import backward_warp, weigh
from jaxtrapolate.precision import divide


@settings
class SoftmaxSettings:
    """Of the exponents, by mean dB on embedded scenes; that of colour starts from 20 in the authors' release."""

    by_depth: float = option(5.0, "how much the nearer pixel prevails: exponents at infinite depth", low=0)
    by_color: float = option(10.0, "the same by colour, where there is no depth: per display value", low=0)
    space: Space = space()


@settings
class FetchSettings:
    """Of how colours are fetched."""

    space: Space = space()


def evenly(alpha: Array, image: Array) -> Float[Array, "h w 1"]:
    """One weight for all pixels of an image."""
    return jnp.broadcast_to(alpha, (*image.shape[:2], 1))


def blend() -> Method:
    """The rendered frames before and after, mixed by time: (1 - alpha) previous + alpha next.

    References: Yang et al. 2011, section 9 ("naive linear blending").
    """

    def function(state, values: Values):
        previous, next = values["previous"].color, values["next"].color
        return {"image": mix(previous, next, evenly(values["alpha"], previous))}

    return Method(
        "blend",
        (PAIR, Stage("blend", function, ("previous", "next", "alpha"), ("image",))),
        kind="interpolation",
        future=1,
    )


def half_motion() -> Method:
    """The previous frame, fetched along a fraction alpha of the motion that the next frame has at the target's pixel.

    References: Andreev 2010 (P[n - 1/2] = f(P[n - 1], -V[n] / 2) for velocities V), the direction that he prefers.
    Departures: any time alpha, not only 1/2; his separate handling of characters is left out, for which the scene would
    have to be rendered without them.
    """

    def function(state, values: Values):
        between = values["between"]
        fetch = partial(backward_warp, motion=weigh(between, values["alpha"].astype(between.dtype)))
        return {"image": in_space(state.settings.space, fetch, values["previous"].color)}

    return Method(
        "half_motion",
        (PAIR, BETWEEN, Stage("fetch", function, ("previous", "between", "alpha"), ("image",))),
        kind="interpolation",
        future=1,
        settings=FetchSettings(),
    )


def _nearness(depth: Array, scale: float | Array) -> Float[Array, "h w 1"]:
    """Exponents by depth of any unit: -scale depth / (depth + its harmonic mean over the frame); -scale at nothing.

    In that mean what is far hardly counts, and nothing counts as the limit of that. NaN counts as nothing.
    """
    known = depth < jnp.inf
    inverse = divide(1, depth, where=known)
    mean = jnp.mean(inverse)
    return -jnp.asarray(scale, depth.dtype) * divide(mean, inverse + mean, otherwise=1)


def _likeness(own: Array, other: Array, flow: Array, scale: float | Array) -> Float[Array, "h w 1"]:
    """Exponents by colour: -scale times the mean difference of display values from where the flow leads."""
    apart = jnp.abs(tonemap(own) - tonemap(backward_warp(other, flow)))
    apart = jnp.mean(apart, -1, keepdims=True)
    return -jnp.asarray(scale, apart.dtype) * jnp.where(jnp.isfinite(apart), apart, 0)


def softmax_splat() -> Method:
    """Both frames splatted along their flows to the target, softmax where several pixels land, and mixed by time.

    The exponents are -by_depth z / (z + mean z), z the depth, which needs no unit; where a frame has no depth,
    -by_color times the photometric error of its flow (on tone-mapped colours, mean over channels). Mixing weighs each
    side by time and by its coverage (the sum of shares that landed, at most 1), so that what one side leaves open the
    other fills; what both leave open is filled by `fill_pyramid`.

    References: Niklaus and Liu 2020. Departures: no network finds the flows or mixes the warped frames: the flows are
    the engine's, the forward one computed from the backward one; depth instead of, or with, brightness constancy.
    """

    def importance(state, values: Values):
        previous, next = values["previous"], values["next"]
        exponents, how = [], state.settings
        for own, other, flow in ((previous, next, "forward"), (next, previous, "backward")):
            depth = depth_of(own)
            if depth is None:
                exponents.append(_likeness(own.color, other.color, values[flow], how.by_color))
            else:
                exponents.append(_nearness(depth, how.by_depth))
        return {"exponents": tuple(exponents)}

    def function(state, values: Values):
        alpha = values["alpha"]
        sides = []
        for name, flow, passed, weights in (
            ("previous", "forward", alpha, values["exponents"][0]),
            ("next", "backward", 1 - alpha, values["exponents"][1]),
        ):
            color, motion = values[name].color, weigh(values[flow], passed.astype(values[flow].dtype))
            push = partial(splat, motion=motion, weights=weights.astype(color.dtype), mode="softmax")
            warped = in_space(state.settings.space, push, color)
            landed = splat(jnp.ones_like(color[..., :1]), motion, mode="sum")
            sides.append((warped, jnp.minimum(landed, 1)))
        (first, in_first), (second, in_second) = sides
        before, after = (1 - alpha) * in_first.astype(alpha.dtype), alpha * in_second.astype(alpha.dtype)
        covered = before + after > 0
        weight = divide(after, before + after, otherwise=evenly(alpha, first))
        return {"mixed": mix(first, second, weight), "covered": covered[..., 0]}

    def fill(state, values: Values):
        return {"image": fill_pyramid(values["mixed"], values["covered"])}

    moving = ("previous", "next", "forward", "backward")
    stages = (
        PAIR,
        BETWEEN,
        FLOWS,
        Stage("exponents", importance, moving, ("exponents",)),
        Stage("splat", function, (*moving, "alpha", "exponents"), ("mixed", "covered")),
        Stage("fill", fill, ("mixed", "covered"), ("image",)),
    )
    return Method("softmax_splat", stages, kind="interpolation", future=1, settings=SoftmaxSettings())
