"""The hole masks of the ExtraNet authors' release: taps="release" of `jaxtrapolate.ops.holes.hole_masks`.

Ids are interpolated, so that their mean is compared; normals are taken unscaled; of positions all four taps count,
whatever their weight; and all that lies outside is a hole of position as well.
"""

from typing import Any, cast

import jax.numpy as jnp
from jaxtyping import Array

from jaxtrapolate.ops._hole_parts import (
    Pair,
    cosine,
    normal_mask,
    position_limit,
    position_mask,
    softened,
    squared_distance,
)
from jaxtrapolate.ops.warp import backward_warp, bilinear_taps, sample

POSITION_THRESHOLD = (7.5, 45.0, 0.005)
"""Facing, grazing and per depth, in centimetres."""


def _stencil(pair: Pair, motion: Array, softness: Any | None) -> tuple[Array, Array]:
    """The mean of the ids is more than 1/3 off; and what is static: where that mean is 0."""
    warped = backward_warp(cast(Array, pair.source.stencil), motion, outside="zero")
    difference = jnp.abs(warped - cast(Array, pair.target.stencil))
    hole = difference > 1 / 3 if softness is None else softened(3 * difference - 1, softness)
    return hole, warped == 0


def _normal(pair: Pair, motion: Array, static: Array | None, threshold: Any, softness: Any | None) -> Array:
    warped = backward_warp(cast(Array, pair.source.normal), motion, outside="zero")
    found, there = cosine(cast(Array, pair.target.normal), warped, unit=False)
    return normal_mask(found, there if static is None else ~static & there, threshold, softness)


def _position(pair: Pair, static: Array | None, threshold: Any, softness: Any | None) -> Array:
    position, source = cast(Array, pair.target.position), cast(Array, pair.source.position)
    farthest = jnp.zeros(pair.outside.shape, position.dtype)
    for place, _ in bilinear_taps(source, pair.x, pair.y):
        farthest = jnp.maximum(farthest, squared_distance(position, place))
    farthest = jnp.where(pair.outside, jnp.inf, farthest)
    concerned = jnp.ones(pair.outside.shape, bool) if static is None else static
    if pair.both("sky"):  # but not of the sky to itself
        sky = sample(cast(Array, pair.source.sky), pair.x, pair.y, filter="nearest")
        concerned &= (cast(Array, pair.target.sky) < 0.5) | (sky < 0.5)
    return position_mask(farthest, position_limit(pair, None, threshold), concerned, softness)


def release_masks(
    pair: Pair, motion: Array, softness: Any | None, normal_threshold: Any, position_threshold: Any
) -> dict[str, Array | None]:
    """The masks by name, `None` without their buffers; softness `None` gives bool masks."""
    stencil = static = None
    if pair.both("stencil"):
        stencil, static = _stencil(pair, motion, softness)
    return {
        "stencil": stencil,
        "normal": _normal(pair, motion, static, normal_threshold, softness) if pair.both("normal") else None,
        "position": _position(pair, static, position_threshold, softness) if pair.both("position") else None,
    }
