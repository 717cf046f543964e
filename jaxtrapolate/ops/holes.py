"""Hole masks: which pixels of a warped frame show another surface than the target (Guo et al. 2021, section 5.2)."""

import dataclasses
from functools import partial, reduce
from typing import Literal, NamedTuple, cast, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.checks import ArrayLike, check_choice, check_image
from jaxtrapolate.ops._hole_parts import (
    Pair,
    cosine,
    normal_mask,
    pair_of,
    position_limit,
    position_mask,
    squared_distance,
)
from jaxtrapolate.ops._release_holes import POSITION_THRESHOLD, release_masks
from jaxtrapolate.ops.depth import nothing
from jaxtrapolate.ops.warp import backward_warp, bilinear_taps, sample
from jaxtrapolate.records import GBuffer, check_gbuffer, record

Taps = Literal["weighted", "nearest", "release"]


@record
@dataclasses.dataclass(frozen=True)
class HoleMasks:
    """Masks `[H, W, 1]`, True (or towards 1, where softness > 0) where a warped pixel is invalid; `None` = no buffers.

    stencil: another dynamic object. normal: another side of one. position: another point of the static scene. depth:
    nothing instead of a surface, or a surface instead of nothing. outside: beyond the frame.
    """

    stencil: Array | None = None
    normal: Array | None = None
    position: Array | None = None
    depth: Array | None = None
    outside: Array | None = None

    @property
    def any(self) -> Array:
        """The union of the masks that are there; of soft ones 1 - prod(1 - mask)."""
        masks = [m for m in (self.stencil, self.normal, self.position, self.depth, self.outside) if m is not None]
        if not masks:
            raise ValueError("HoleMasks.any: no mask is there")
        if all(m.dtype == jnp.bool_ for m in masks):
            return reduce(jnp.logical_or, masks)
        return 1 - reduce(jnp.multiply, [1 - m for m in masks])


class _Bare(NamedTuple):
    """Where target and source show no surface, and the taps of the source. bool `[H, W, 1]`.

    target: of the target. taps: (bare, weight) of each tap in the source. neither: the target shows nothing, nor does
    any tap with weight.
    """

    target: Array
    taps: list[tuple[Array, Array]]
    neither: Array


def _taps_around(image: Array, pair: Pair, taps: Taps) -> list[tuple[Array, Array]]:
    """The pixels that count around each displaced position and their weights `[H, W, 1]`; one, or four."""
    if taps == "nearest":
        return [(sample(image, pair.x, pair.y, filter="nearest"), jnp.ones((*pair.x.shape, 1), pair.x.dtype))]
    return bilinear_taps(image, pair.x, pair.y)


def _shows_nothing(target: GBuffer, source: GBuffer) -> list[Array] | None:
    """Where the two show no surface, by the sky and the depth that both have, bool `[H, W, 1]`; without, `None`."""
    masks = []
    if target.sky is not None and source.sky is not None:
        masks.append([sky > 0.5 for sky in (target.sky, source.sky)])
    if target.depth is not None and source.depth is not None:
        masks.append([nothing(depth) for depth in (target.depth, source.depth)])
    return [reduce(jnp.logical_or, side) for side in zip(*masks, strict=True)] if masks else None


def _depth_mask(pair: Pair, sides: list[Array], dtype, taps: Taps, soft: bool) -> tuple[Array, _Bare]:
    """One of the two shows a surface and the other nothing; and where which does."""
    around = [(there > 0.5, weight) for there, weight in _taps_around(sides[1].astype(dtype), pair, taps)]
    other, differs = jnp.zeros(pair.outside.shape, dtype), jnp.zeros(pair.outside.shape, bool)
    for there, weight in around:
        other = other + jnp.where(there != sides[0], weight.astype(dtype), 0)
        differs |= (there != sides[0]) & (weight > 0)
    mask = jnp.where(pair.outside, 0, other) if soft else differs & ~pair.outside
    return mask, _Bare(sides[0], around, sides[0] & ~differs)


def _stencil_mask(pair: Pair, taps: Taps, soft: bool) -> tuple[Array, Array]:
    """A tap with weight has another id (eq. 8); and what is static: the target, and all those taps."""
    id_here = jnp.round(cast(Array, pair.target.stencil))
    other = jnp.zeros(pair.outside.shape, pair.x.dtype)
    differs = moving = jnp.zeros(pair.outside.shape, bool)
    for ids, weight in _taps_around(cast(Array, pair.source.stencil), pair, taps):
        another = jnp.round(ids) != id_here
        other = other + jnp.where(another, weight, 0)
        differs |= another & (weight > 0)
        moving |= (jnp.round(ids) != 0) & (weight > 0)
    mask = jnp.where(pair.outside, 0, other) if soft else differs & ~pair.outside
    return mask, ~moving & (id_here == 0)


def _normal_mask(pair: Pair, motion, static, bare: _Bare | None, taps: Taps, threshold, softness) -> Array:
    """The cosine is below a threshold, where the surface is not static and something is shown."""
    filter = "nearest" if taps == "nearest" else "bilinear"
    warped = backward_warp(cast(Array, pair.source.normal), motion, filter=filter, outside="zero")
    # scaled, because the mean of unit vectors is shorter than they are
    found, concerned = cosine(cast(Array, pair.target.normal), warped, unit=True)
    concerned &= ~pair.outside
    concerned = concerned if static is None else concerned & ~static
    concerned = concerned if bare is None else concerned & ~bare.neither
    return normal_mask(found, concerned, threshold, softness)


def _position_mask(pair: Pair, static, bare: _Bare | None, taps: Taps, threshold, softness) -> Array:
    """A tap with weight lies farther away than a threshold, where the surface is static."""
    position = cast(Array, pair.target.position)
    farthest = jnp.zeros(pair.outside.shape, position.dtype)
    for k, (place, weight) in enumerate(_taps_around(cast(Array, pair.source.position), pair, taps)):
        squared = squared_distance(position, place)
        if bare is not None:
            squared = jnp.where(bare.taps[k][0] != bare.target, jnp.inf, jnp.where(bare.target, 0, squared))
        farthest = jnp.maximum(farthest, jnp.where(weight > 0, squared, 0))
    limit = position_limit(pair, None if bare is None else bare.target, threshold)
    concerned = ~pair.outside if static is None else static & ~pair.outside
    return position_mask(farthest, limit, concerned, softness)


@partial(jax.jit, static_argnames=("taps",))
def _hole_masks(target, source, motion, softness, normal_threshold, position_threshold, *, taps: Taps) -> HoleMasks:
    """softness `None`: bool masks."""
    pair, soft = pair_of(target, source, motion), softness is not None
    outside = pair.outside.astype(motion.dtype) if soft else pair.outside
    if taps == "release":
        return HoleMasks(outside=outside, **release_masks(pair, motion, softness, normal_threshold, position_threshold))
    depth = bare = stencil = static = normal = position = None
    sides = _shows_nothing(target, source)
    if sides is not None:
        depth, bare = _depth_mask(pair, sides, motion.dtype, taps, soft)
    if pair.both("stencil"):
        stencil, static = _stencil_mask(pair, taps, soft)
    if pair.both("normal"):
        normal = _normal_mask(pair, motion, static, bare, taps, normal_threshold, softness)
    if pair.both("position"):
        position = _position_mask(pair, static, bare, taps, position_threshold, softness)
    return HoleMasks(stencil, normal, position, depth, outside)


def hole_masks(
    target: GBuffer,
    source: GBuffer,
    motion: Float[ArrayLike, "h w 2"],
    *,
    taps: Taps = "weighted",
    softness: float | Float[ArrayLike, ""] = 0.0,
    normal_threshold: float | Float[ArrayLike, ""] = 0.98,
    position_threshold: float | Float[ArrayLike, ""] | tuple[float, float, float] | None = None,
) -> HoleMasks:
    """Where a frame warped along `motion` shows another surface than the target.

    stencil: the warped stencil is not the target's. normal: the cosine of the normals is below `normal_threshold`, on
    what the stencils do not both call static (everywhere, without stencils), and not where both show nothing. position:
    the positions are farther apart than a threshold, where the stencils are both static. depth: one shows a surface and
    the other nothing (the sky's mask is above 0.5, or depth is infinite or not positive); positions are then infinitely
    far apart. outside: p + motion[p] is beyond the frame. Each mask needs its buffer in both G-buffers ("depth" either
    the sky or the depth), and is `None` without.

    Args:
        target: the G-buffer of the frame to be generated.
        source: the G-buffer of the frame that is warped.
        motion: `[H, W, 2]` from target to source.
        taps: "weighted" looks only at those of the four bilinear taps that have weight, so that a frame warped onto
            itself has no holes; ids are compared, not their mean. "nearest" looks at the nearest pixel alone: the
            pixels beside a silhouette, of whose taps one is wrong, are then no holes. "release" does as the authors':
            the bilinear mean of the ids, more than 1/3 off; the largest distance over all four taps; everything outside
            is a hole of position as well; it has no mask of depth.
        softness: 0 gives bool masks. Above 0 they are in 0..1 and differentiable: a sigmoid of the excess over the
            threshold, relative to it, over softness; the stencil's is the weight of the taps with another id.
        normal_threshold: T_n, a cosine.
        position_threshold: a number: how many times the distance between neighbouring pixels' positions (the larger of
            the two axes), plus 0.1 % of the depth, so that it needs no unit. Or (facing, grazing, per_depth): T_d =
            facing |n_dot_v| + grazing (1 - |n_dot_v|) + per_depth * depth in the scene's unit. `None`: 2.0, but the
            release's (7.5, 45, 0.005) in centimetres for "release".

    Returns:
        `HoleMasks` of `[H, W, 1]`.

    Edge cases:
        Motion that is not finite is outside. A position that is not finite is a hole, but where both show nothing. A
        NaN depth is a surface's.

    Gradient:
        Only of soft masks: with respect to motion, normals, positions, thresholds and softness; not to ids, depth and
        sky.

    Raises:
        TypeError, ValueError: no floating-point array, a size that differs, an unknown `taps`.

    References:
        Guo et al. 2021 (ExtraNet), section 5.2, equations 8-11, and the authors' release for the thresholds.
        Departures: equation 9 prints "> T_n" where a LOW cosine marks a hole (as its text and the release have it); the
        defaults compare without a unit and without weightless taps.
    """
    size = check_image("motion", motion, channels=2)
    check_gbuffer("target", target, size=size)
    check_gbuffer("source", source, size=size)
    check_choice("taps", taps, get_args(Taps))
    if position_threshold is None:
        position_threshold = POSITION_THRESHOLD if taps == "release" else 2.0
    absolute = isinstance(position_threshold, tuple | list)
    soft = not (isinstance(softness, (int, float)) and softness == 0)
    thresholds = normal_threshold, tuple(position_threshold) if absolute else position_threshold
    return _hole_masks(target, source, motion, softness if soft else None, *thresholds, taps=taps)
