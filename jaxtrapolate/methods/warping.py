"""The methods without weights that warp the newest rendered frame."""

import jax.numpy as jnp

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
from jaxtrapolate.ops.guided import far_motion, guided_warp
from jaxtrapolate.ops.warp import backward_warp


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
ROWS = 180  # of frames that kernels of 10 pixels suit; see experiments/guided_reach.py


def guides(target, source):
    """The guides `[H, W, G]` of both frames: albedo and normal, those that both have; else the stencil."""
    names = [n for n in _GUIDES if getattr(target, n) is not None and getattr(source, n) is not None] or ["stencil"]
    return tuple(jnp.concatenate([getattr(g, n) for n in names], -1) for g in (target, source))


def guides_of(role: str) -> str:
    """What a stage reads that compares the target with the frames of a role by `guides`: one that both have."""
    return "|".join(f"target+{role}.{name}" for name in (*_GUIDES, "stencil"))


def fetch_guided(image, motion, holes, target, source, *, rows: int | None = ROWS):
    """The image by the guided warp along the motion; in holes as far off as in a frame of about `rows` rows.

    From twice that many rows on, holes are first led to a like surface by a coarse search (`far_motion`); `None` leaves
    that out.
    """
    target_guide, source_guide = guides(target, source)
    step = motion.shape[0] // (rows or motion.shape[0])
    if step > 1:
        motion = far_motion(motion, target_guide, source_guide, holes, step=step)
    return guided_warp(image, motion, target_guide, source_guide)


def guided_stage(*, rows: int | None = ROWS) -> Stage:
    """Fetches the newest layer from the most similar pixels around where the motion leads; see `fetch_guided`."""

    def function(state, values: Values):
        frames = values["target"].gbuffer, values["newest"].gbuffer
        warped = fetch_guided(layers(values)[0], values["motion"], values["holes"], *frames, rows=rows)
        return {"warped": warped, "image": warped[..., :3]}

    return Stage("guided warp", function, reads=(guides_of("newest"),))


def guided(*, rows: int | None = ROWS) -> Method:
    """The demodulated frame fetched from the most similar pixels around where the motion leads (ExtraSS).

    Args:
        rows: of frames that the kernels suit; in larger ones holes are led further off. `None` = by the kernels alone.

    References:
        Wu et al. 2023 (ExtraSS), section 4.2. Departure: `far_motion` before it, in frames of 360 rows or more.
    """
    stages = (REPROJECT, HOLES, hindsight_stage(), demodulate_stage(), guided_stage(rows=rows), modulate_stage(), SKY)
    return Method("guided_warp", stages, past=2)
