"""The methods without weights that warp the newest rendered frame."""

import jax.numpy as jnp

from jaxtrapolate.gather import backward_warp
from jaxtrapolate.guided import guided_warp
from jaxtrapolate.methods.hindsight import hindsight_stage
from jaxtrapolate.methods.method import Method, Stage, Values, rendered
from jaxtrapolate.methods.stages import (
    HOLES,
    OCCLUSION,
    REPROJECT,
    SKY,
    composite,
    demodulate_stage,
    layers,
    modulate_stage,
)


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

    def function(state, values: Values):
        warped = composite(values, layers(values)[0])
        return {"warped": warped, "image": warped[..., :3]}

    stages = (
        REPROJECT,
        OCCLUSION,
        HOLES,
        hindsight_stage(),
        demodulate_stage(),
        Stage("composite", function),
        modulate_stage(),
        SKY,
    )
    return Method("occlusion_warp", stages, past=2)


_GUIDES = ("albedo", "normal")


def guides(target, source):
    """The guides `[H, W, G]` of both frames: albedo and normal, those that both have; else the stencil."""
    names = [n for n in _GUIDES if getattr(target, n) is not None and getattr(source, n) is not None] or ["stencil"]
    return tuple(jnp.concatenate([getattr(g, n) for n in names], -1) for g in (target, source))


def _guided(state, values: Values):
    target_guide, source_guide = guides(values["target"].gbuffer, values["newest"].gbuffer)
    warped = guided_warp(layers(values)[0], values["motion"], target_guide, source_guide)
    return {"warped": warped, "image": warped[..., :3]}


GUIDED = Stage(
    "guided warp",
    _guided,
    reads=tuple("|".join(f"{role}.{name}" for name in (*_GUIDES, "stencil")) for role in ("target", "history")),
)
"""Fetches the newest layer from the most similar pixels around where the motion leads."""


def guided() -> Method:
    """The demodulated frame fetched from the most similar pixels around where the motion leads (ExtraSS)."""
    stages = (REPROJECT, HOLES, hindsight_stage(), demodulate_stage(), GUIDED, modulate_stage(), SKY)
    return Method("guided_warp", stages, past=2)
