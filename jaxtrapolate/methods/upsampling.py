"""Baselines that super sample: from one frame, and over time (TAA, TAAU).

Rendered frames are super sampled as they are; a frame that was not rendered is first extrapolated at the input's size
by the stages of `guided_warp`, so that these are also the plain combinations of both.
"""

from functools import partial

import jax.numpy as jnp

from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.methods.space import in_space
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.methods.supersampling import RENDERED, kept, previous_stage, starter
from jaxtrapolate.methods.warping import GuidedSettings, guided
from jaxtrapolate.ops.radiance import compress, expand
from jaxtrapolate.ops.temporal import Rectify, accumulate
from jaxtrapolate.ops.upsample import easu as upsample_edges
from jaxtrapolate.ops.upsample import upsample
from jaxtrapolate.ops.warp import Filter

NAMES = ("bilinear", "bicubic", "easu", "taa", "taau")


def _jitter(values: Values):
    target = values["target"]
    return None if target.jitter is None else jnp.asarray(target.jitter)


def _spatial(name: str, stage: Stage, scale: int) -> Method:
    stages = (RENDERED, *guided().stages, stage)
    return Method(name, stages, past=2, scale=scale, settings=GuidedSettings())


def _filtered(name: str, filter: Filter, scale: int) -> Method:
    def function(state, values: Values):
        larger = partial(upsample, scale=scale, filter=filter, jitter=_jitter(values))
        return {"image": in_space(state.settings.space, larger, values["image"])}

    return _spatial(name, Stage("upsampling", function, ("image", "target"), ("image",), on="both", past=0), scale)


def bilinear(scale: int = 2) -> Method:
    """Each frame at twice the size, bilinear, at the places of its jittered samples."""
    return _filtered("bilinear", "bilinear", scale)


def bicubic(scale: int = 2) -> Method:
    """Each frame at twice the size, bicubic (Catmull-Rom), at the places of its jittered samples."""
    return _filtered("bicubic", "bicubic", scale)


def easu(scale: int = 2) -> Method:
    """Each frame at twice the size by FSR 1's edge-adaptive upsampling, after a tone curve, without its sharpening.

    References: AMD FidelityFX Super Resolution 1.0; see `jaxtrapolate.ops.upsample.easu`.
    """

    def function(state, values: Values):
        larger = upsample_edges(compress(values["image"]), scale=scale, jitter=_jitter(values))
        return {"image": expand(larger).astype(values["image"].dtype)}

    return _spatial("easu", Stage("upsampling", function, ("image", "target"), ("image",), on="both", past=0), scale)


@settings
class Accumulation(GuidedSettings):
    """Of the accumulation over time, and of the guided warp for frames that were not rendered."""

    weight: float = option(0.1, "of a frame in the history, where a sample of it is near", low=0, high=1)
    rectify: Rectify = option("variance", "how the history is brought near the frame's colours", choices=Rectify)
    gamma: float = option(1.0, "how many deviations from their mean it may be, with variance", low=0)
    fetch: Filter = option("bicubic", "how the history is interpolated between pixels", choices=Filter)


def _accumulating(name: str, scale: int) -> Method:
    def function(state, values: Values):
        how, current, carry = state.settings, compress(values["image"]), values["carry"]
        options = {"rectify": how.rectify, "gamma": how.gamma, "weight": how.weight}
        previous, jitter = values["previous"].astype(current.dtype), _jitter(values)
        mixed = accumulate(current, previous, values["valid"], scale=scale, jitter=jitter, **options)
        # a sharp fetch, or a box of deviations, may reach beyond all colours there are, where the curve ends
        most = jnp.maximum(jnp.max(current), jnp.max(compress(carry.image)).astype(current.dtype))
        return kept(expand(jnp.clip(mixed, 0, most)).astype(values["image"].dtype), carry)

    stages = (
        RENDERED,
        *guided().stages,
        previous_stage(scale, encode=compress),
        Stage(
            "accumulation",
            function,
            ("image", "target", "previous", "valid", "carry"),
            ("image", "carry"),
            on="both",
            past=0,
        ),
    )
    return Method(name, stages, past=2, scale=scale, settings=Accumulation(), start=starter(scale))


def taa() -> Method:
    """Temporal anti-aliasing at the input's size: each frame mixed into the warped history, without ghosts.

    References: Karis et al. 2014; Salvi 2016; see `jaxtrapolate.ops.temporal.accumulate`. After a tone curve, where
    the original weighs colours by their brightness. Departure: motion is not dilated along silhouettes.
    """
    return _accumulating("taa", 1)


def taau(scale: int = 2) -> Method:
    """Temporal anti-aliasing that also upsamples to twice the size, by jittered samples (TAAU).

    References: Yang et al. 2020; as of `taa`.
    """
    return _accumulating("taau", scale)
