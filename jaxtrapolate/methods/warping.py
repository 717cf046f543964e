"""The methods without weights that warp the newest rendered frame."""

import jax.numpy as jnp

from jaxtrapolate.gather import backward_warp
from jaxtrapolate.guided import guided_warp
from jaxtrapolate.methods.hindsight import hindsight_stage
from jaxtrapolate.methods.method import Method, Stage, Values, rendered
from jaxtrapolate.methods.stages import HOLES, REPROJECT, SKY, demodulate_stage, layer, modulate_stage
from jaxtrapolate.motion import occlusion_motion


def repeat() -> Method:
    """The newest rendered frame once more: what a display does without frame generation."""

    def function(state, values: Values):
        history = values["history"]
        return {"image": history[rendered(history)[0]].color}

    return Method("repeat", (Stage("repeat", function, reads=("history.color",)),))


def warp() -> Method:
    """The newest rendered frame, its colour as it is, fetched along the motion vectors."""

    def function(state, values: Values):
        return {"image": backward_warp(values["newest"].color, values["motion"])}

    return Method("warp", (REPROJECT, Stage("warp", function), SKY))


def occlusion_warp() -> Method:
    """The demodulated frame along the motion, in holes along the occluder's (the occlusion composite of ExtraNet)."""

    def occlusion(state, values: Values):
        return {"occlusion_motion": occlusion_motion(values["motion"], values["target"].gbuffer.depth)}

    def composite(state, values: Values):
        image = layer(values)
        along = jnp.where(values["holes"], values["occlusion_motion"], values["motion"])
        warped = backward_warp(image, along)
        return {"warped": warped, "image": warped[..., :3]}

    stages = (
        REPROJECT,
        Stage("occlusion motion", occlusion, reads=("target.depth",)),
        HOLES,
        hindsight_stage(),
        demodulate_stage(),
        Stage("composite", composite),
        modulate_stage(),
        SKY,
    )
    return Method("occlusion_warp", stages, past=2)


_GUIDES = ("albedo", "normal")


def guides(target, source):
    """The guides `[H, W, G]` of both frames: albedo and normal, those that both have; else the stencil."""
    names = [n for n in _GUIDES if getattr(target, n) is not None and getattr(source, n) is not None] or ["stencil"]
    return tuple(jnp.concatenate([getattr(g, n) for n in names], -1) for g in (target, source))


def guided() -> Method:
    """The demodulated frame fetched from the most similar pixels around where the motion leads (ExtraSS)."""

    def function(state, values: Values):
        target_guide, source_guide = guides(values["target"].gbuffer, values["newest"].gbuffer)
        warped = guided_warp(layer(values), values["motion"], target_guide, source_guide)
        return {"warped": warped, "image": warped[..., :3]}

    reads = tuple("|".join(f"{role}.{n}" for n in (*_GUIDES, "stencil")) for role in ("target", "history"))
    stages = (
        REPROJECT,
        HOLES,
        hindsight_stage(),
        demodulate_stage(),
        Stage("guided warp", function, reads=reads),
        modulate_stage(),
        SKY,
    )
    return Method("guided_warp", stages, past=2)
