"""The methods without weights that warp the newest rendered frame."""

from functools import partial, reduce
from itertools import chain
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrapolate.checks import check_present
from jaxtrapolate.methods.frames import rendered
from jaxtrapolate.methods.hindsight import HINDSIGHT
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.methods.space import Space, in_space, space
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.methods.stages import (
    COMPOSITE,
    HOLES,
    OCCLUSION,
    REPROJECT,
    SKY,
    Demodulation,
    composite,
    demodulate_stage,
    modulate_stage,
)
from jaxtrapolate.ops.depth import held, surface_depth
from jaxtrapolate.ops.guided import far_motion, guided_warp
from jaxtrapolate.ops.radiance import compress
from jaxtrapolate.ops.visibility import expected_depth
from jaxtrapolate.ops.warp import Filter, backward_warp
from jaxtrapolate.precision import widest


def repeat() -> Method:
    """The newest rendered frame once more: what a display does without frame generation."""

    def function(state, values: Values):
        history = values["history"]
        return {"image": history[rendered(history)[0]].color}

    return Method("repeat", (Stage("repeat", function, ("history",), ("image",), reads=("history.color",)),))


@settings
class WarpSettings:
    """How a frame is fetched."""

    filter: Filter = option("bilinear", "how colours are interpolated between pixels", choices=Filter)
    space: Space = space("linear")  # the baseline that it is


def warp() -> Method:
    """The newest rendered frame, undivided, fetched along the motion vectors."""

    def function(state, values: Values):
        how = state.settings
        fetch = partial(backward_warp, motion=values["motion"], filter=how.filter)
        return {"image": in_space(how.space, fetch, values["newest"].color)}

    return Method(
        "warp", (REPROJECT, Stage("warp", function, ("newest", "motion"), ("image",)), SKY), settings=WarpSettings()
    )


def occlusion_warp() -> Method:
    """The demodulated frame along the motion, in holes along the occluder's (the occlusion composite of ExtraNet)."""

    def function(state, values: Values):
        warped = in_space(state.settings.space, partial(composite, values), values["layers"][0])
        return {"warped": warped, "image": warped[..., :3]}

    stages = (
        REPROJECT,
        HOLES,
        OCCLUSION,
        HINDSIGHT,
        demodulate_stage(),
        Stage("composite", function, ("layers", *COMPOSITE), ("warped", "image")),
        modulate_stage(),
        SKY,
    )
    return Method("occlusion_warp", stages, past=2, settings=Demodulation())


_GROUPS = ("albedo", "normal"), ("stencil", "depth")  # what guides: the first group of which there is any
_LOGARITHM = 2.0  # of the depth as a guide: with the default sigma, 1.5 % of the depth is one sigma


@settings
class Guide:
    """How the guided warp looks for like pixels; `rows` is measured in experiments/guided_reach.py."""

    rows: int | None = option(
        180, "of frames that the kernels suit; in larger ones holes are led further off", low=1, high=65536, none=True
    )
    keep: int = option(4, "how many of the most similar pixels are blended", low=1, high=33)
    strides: tuple[int, ...] = option((1, 3, 5, 9), "of the kernels of 3 x 3 pixels, in pixels", low=1, high=64)
    sigma_guide: float = option(0.03, "of the Gaussian of the guides' difference (see `guides`)", low=0)
    sigma_space: float = option(0.5, "of the Gaussian of the distance on the screen, in pixels", low=0)
    unlike: float = option(0.1, "squared difference of guides from which on a hole is led further off", low=0)


@settings
class GuidedSettings(Guide, Demodulation):
    """Of demodulation and of the guided warp."""


def _compared(target, source, motion, names) -> dict[str, tuple[jax.Array, jax.Array]]:
    """Those of these buffers that both frames have, of each `[H, W, G]`, by name."""
    both = [n for n in names if getattr(target, n) is not None and getattr(source, n) is not None]
    found = {n: (getattr(target, n), getattr(source, n)) for n in both}
    if "depth" in found:
        then, there = (surface_depth(jnp.asarray(g.depth), g.sky) for g in (target, source))
        then, there = (_LOGARITHM * jnp.log(held(d)) for d in (expected_depth(then, there, motion), there))
        found["depth"] = then, there
    return found


def _guiding(target, source) -> tuple[str, ...]:
    """Which buffers guide; none where the frames have none in common."""
    shared = [tuple(n for n in names if None not in (getattr(target, n), getattr(source, n))) for names in _GROUPS]
    return next(filter(None, shared), ())


def guides(target, source, motion):
    """The guides `[H, W, G]` of both frames: albedo and normal, those that both have; else stencil and depth, likewise.

    Of depth it is twice the logarithm, so that it has no unit; the target's is the depth that its surfaces are expected
    to have in the source (`expected_depth`).
    """
    names = _guiding(target, source)
    check_present("albedo, normal, stencil or depth", names or None, needed_by="the guided warp")
    both = zip(*_compared(target, source, motion, names).values(), strict=True)
    return tuple(jnp.concatenate(images, -1) for images in both)


def guides_of(role: str) -> str:
    """What a stage reads that compares the target with the frames of a role by `guides`: one that both have."""
    return "|".join(f"target+{role}.{name}" for name in chain.from_iterable(_GROUPS))


def fetch_guided(image, motion, holes, target, source, how: Any, space: Space):
    """The image by the guided warp along the motion; in holes as far off as in a frame of about `how.rows` rows.

    From twice that many rows on, holes are first led to a like surface by a coarse search (`far_motion`); `None` leaves
    that out. how: a `Guide`.
    """
    target_guide, source_guide = guides(target, source, motion)
    step = motion.shape[0] // (how.rows or motion.shape[0])
    if step > 1:
        motion = far_motion(motion, target_guide, source_guide, holes, step=step, unlike=how.unlike)
    sigmas = {"sigma_guide": how.sigma_guide, "sigma_space": how.sigma_space}

    def fetch(image):
        return guided_warp(image, motion, target_guide, source_guide, strides=how.strides, keep=how.keep, **sigmas)

    return in_space(space, fetch, image)


_AGREES = 0.03
"""Squared difference of guides up to which the four pixels around where the motion leads are what is looked for."""

_CONTRAST = 0.01
"""Variance of those four, after the tone curve, from which on light ends between them."""


def _bilinear(image, warped, values: Values, space: Space, network: bool):
    """What the guided warp has fetched, and bilinearly where no guide says which pixels are alike.

    Neither albedo nor normal says where a panel that shines ends, or a shadow: the guided warp breaks such an edge into
    dots. Outside holes, the undivided colour is fetched bilinearly where all guides agree, and the demodulated one
    where light ends on one surface, by normal and depth. On 48 windows of training seeds of eight scenes, on which this
    was chosen, the guided warp gains 0.02 to 0.16 dB by scene, 0.08 on the mean. A network corrects what it was trained
    on: the second costs it 0.2 dB on one scene, so that it is left out there, and the first is worth 0.05 (-0.03 to
    0.16).
    """
    frames, motion = (values["target"].gbuffer, values["newest"].gbuffer), values["motion"]
    guiding, surface = _guiding(*frames), () if network else ("normal", "depth")
    compared = _compared(*frames, motion, dict.fromkeys((*guiding, *surface)))
    compared = {name: [jax.lax.stop_gradient(a.astype(widest(a))) for a in pair] for name, pair in compared.items()}
    bright = jax.lax.stop_gradient(jnp.max(compress(image[..., :3].astype(widest(image))), -1, keepdims=True))
    there = [pair[1] for pair in compared.values()]
    sizes = [a.shape[-1] for a in (*there, bright, bright)]

    def fetch(colors):
        return backward_warp(jnp.concatenate([*there, bright, bright * bright, colors], -1), motion)

    found = in_space(space, fetch, image.astype(widest(image)))
    *there, mean, square, plain = jnp.split(found, np.cumsum(sizes), -1)
    off = {n: jnp.square(pair[0] - b) for (n, pair), b in zip(compared.items(), there, strict=True)}

    def agree(names):
        return jnp.sum(jnp.concatenate([off[n] for n in names], -1), -1, keepdims=True) <= _AGREES

    seen, plain = ~values["holes"], plain.astype(warped.dtype)
    own = jnp.where(seen & agree(guiding), plain[..., 3:], warped[..., 3:])
    divided, known = warped[..., :3], [name for name in surface if name in off]
    if known:
        alike = reduce(jnp.logical_and, (agree([name]) for name in known))
        divided = jnp.where(seen & alike & (square - mean * mean > _CONTRAST), plain[..., :3], divided)
    return jnp.concatenate([divided, own], -1)


def guided_stage(space: Space | None = None) -> Stage:
    """Fetches the newest layer from the most similar pixels around where the motion leads; see `fetch_guided`.

    Where both ways of fetching are at hand, see `_bilinear`.

    Args:
        space: what a network was trained with, whose correction the undivided colour has no part in: that is then
            fetched after the tone curve (0.05 dB; like the rest, in linear light, it loses 0.04). `None` = the
            method's option, for all.
    """

    def function(state, values: Values):
        frames, how = (values["target"].gbuffer, values["newest"].gbuffer), state.settings
        layer, motion, holes = values["layers"][0], values["motion"], values["holes"]
        warped = fetch_guided(layer, motion, holes, *frames, how, space or how.space)
        if layer.shape[-1] > 3:
            warped = _bilinear(layer, warped, values, "tone" if space else how.space, space is not None)
        return {"warped": warped, "image": warped[..., :3]}

    takes = ("target", "newest", "layers", "motion", "holes")
    return Stage("guided warp", function, takes, ("warped", "image"), reads=(guides_of("newest"),))


def guided() -> Method:
    """The demodulated frame fetched from the most similar pixels around where the motion leads (ExtraSS).

    References:
        Wu et al. 2023 (ExtraSS), section 4.2. Departure: `far_motion` before it, in frames of 360 rows or more.
    """
    stages = (REPROJECT, HOLES, HINDSIGHT, demodulate_stage(), guided_stage(), modulate_stage(), SKY)
    return Method("guided_warp", stages, past=2, settings=GuidedSettings())
