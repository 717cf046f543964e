"""ExtraSS whole (Wu et al. 2023, Figure 2): rendered frames and extrapolated ones super sampled in turn."""

import dataclasses
from collections.abc import Mapping
from os import PathLike
from typing import Any

import jax.numpy as jnp
from flax import nnx

from jaxtrapolate.methods.extranet import relative_depth
from jaxtrapolate.methods.extrass import Blend, LedBlend, Refinement, refinement_stages
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.methods.supersampling import RENDERED, kept, previous_stage, starter
from jaxtrapolate.networks.extrass import ExtraSS, ExtraSSConfig
from jaxtrapolate.networks.inference import inference
from jaxtrapolate.networks.stored import load_network
from jaxtrapolate.ops.warp import Filter
from jaxtrapolate.weights import configured

NAME = "extrass"

PREPARATION = Refinement()
"""What both networks are shown where nothing else is said."""


@settings
class History:
    """Of the history."""

    fetch: Filter = option("bilinear", "how the history is interpolated between pixels", choices=Filter)


@settings
class JointSettings(History, Blend):
    """Of the refinement of extrapolated frames, and of the history."""


@settings
class LedJointSettings(History, LedBlend):
    """And of the flow of light that FRNet begins with."""


def extrass(model: ExtraSS, *, preparation: Refinement = PREPARATION) -> Method:
    """Frames super sampled, rendered ones and extrapolated ones in turn, by a network with a history (ExtraSS).

    A rendered frame is super sampled by itself and the history; another is first extrapolated at the input's size, as
    by `extrass_refine`, always from rendered frames, never from an answer. The history is the answer to the frame
    before, of either kind, warped by the motion of the input's size, upsampled; at first it is the upsampled input.
    What the network is shown is `values["sampled"]` of the stages before "super sampling": colour, history, depth
    (`relative_depth`), jitter, and of an extrapolated frame the guided warp and base colour. No answer is brighter than
    the brightest of colour and history.

    The method has memory: `step` it through every frame in order of display. Low-resolution frames lie on their own,
    jittered pixels; history and answer are unjittered.

    What a scene lacks is left out: without a second rendered frame FRNet; depth that is absent is 0, as far as can be,
    base colour 1, jitter 0; without motion to the frame before the history is the upsampled input. Where nothing has
    been rendered yet there is no answer: a `ValueError`, as of every method.

    Args:
        model: both networks; the output is `model.config.sampler.scale` times as large as the input.
        preparation: what they were trained on.

    References:
        Wu et al. 2023 (ExtraSS), section 4. Departures: see `extrass_refine` and `jaxtrapolate.networks.ExtraSSNet`.
    """
    refine, refining = inference(model.frnet)
    sample, sampling = inference(model.sampler)
    config: ExtraSSConfig = model.config
    scale = config.sampler.scale

    def inputs(state, values: Values):
        target, color = values["target"], preparation.encode(values["image"])
        buffers, guided = target.gbuffer, values["guided"]
        depth, albedo = jnp.zeros_like(color[..., :1]), None
        if buffers is not None and buffers.depth is not None:
            depth = relative_depth(jnp.asarray(buffers.depth, color.dtype), buffers.sky)
        if guided is not None and buffers is not None and buffers.albedo is not None:
            albedo = jnp.clip(jnp.nan_to_num(jnp.asarray(buffers.albedo, color.dtype)), 0, 1)
        jitter = jnp.zeros(2, color.dtype) if target.jitter is None else jnp.asarray(target.jitter, color.dtype)
        given = (color, values["previous"].astype(color.dtype), depth, jitter)
        return {"sampled": given if guided is None else (*given, preparation.encode(guided), albedo)}

    def answer(state, values: Values):
        found = sample(state.weights["sampler"], *values["sampled"])
        color, previous = values["sampled"][:2]
        most = jnp.maximum(jnp.max(color), jnp.max(previous))  # beyond it nothing is known, and the curve may end
        return kept(preparation.decode(jnp.clip(found.image, 0, most)), values["carry"])

    how: Any = LedJointSettings if config.frnet.led else JointSettings
    both: dict[str, Any] = {"on": "both", "past": 0}
    stages = (
        RENDERED,
        *refinement_stages(refine, config.frnet, preparation, weights_of=lambda weights: weights["frnet"]),
        previous_stage(scale, encode=preparation.encode),
        Stage("inputs", inputs, ("target", "image", "previous", "guided?"), ("sampled",), **both),
        Stage("super sampling", answer, ("sampled", "carry"), ("image", "carry"), **both),
    )
    return Method(
        NAME,
        stages,
        past=3 if config.frnet.led else 2,
        scale=scale,
        weights={"frnet": refining, "sampler": sampling},
        settings=how(changed=preparation.changed),
        networks={"frnet": refine, "sampler": sample},
        start=starter(scale),
    )


def extrass_config(config: ExtraSSConfig, preparation: Refinement) -> dict[str, Any]:
    """What a file of weights states about them, as `load` reads it."""
    return {"network": dataclasses.asdict(config), "preparation": dataclasses.asdict(preparation)}


def load(path: str | PathLike[str]) -> Method:
    """The method with the weights in a file; see `load_network`."""

    def build(stated: Mapping[str, Any]):
        config = configured(ExtraSSConfig, stated.get("network", {}), source=str(path))
        return lambda: ExtraSS(config, rngs=nnx.Rngs(0))

    model, stated = load_network(path, NAME, build)
    return extrass(model, preparation=configured(Refinement, stated.get("preparation", {}), source=str(path)))
