"""Hole masks: which pixels of a warped frame show another surface than the target (Guo et al. 2021, section 5.2)."""

import dataclasses
from collections.abc import Collection
from functools import partial, reduce
from typing import Any, Literal, NamedTuple, cast, get_args

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
from jaxtrapolate.ops.depth import nothing, surface_depth
from jaxtrapolate.ops.visibility import NEARER, expected_depth, planes
from jaxtrapolate.ops.warp import backward_warp, bilinear_taps, pixel_grid, sample
from jaxtrapolate.precision import divide
from jaxtrapolate.records import GBuffer, check_gbuffer, record

Taps = Literal["weighted", "nearest", "release"]

_REMOTE = 100  # times as far as a surface: what is there is no surface that this one could be


@record
@dataclasses.dataclass(frozen=True)
class HoleMasks:
    """Masks `[H, W, 1]`, True (or towards 1, where softness > 0) where a warped pixel is invalid; `None` = no buffers.

    stencil: another dynamic object. normal: another side of one. position: another point of the static scene. depth:
    nothing instead of a surface, or a surface instead of nothing; without positions also a nearer surface. outside:
    beyond the frame.
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

    target: of the target. taps: of each tap in the source, whether one of the two shows nothing, or what is as good as
    nothing beside the other. neither: the target shows nothing, nor does any tap with weight.
    """

    target: Array
    taps: list[Array]
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


def _nearness(buffers: GBuffer, bare: Array, known: bool, dtype: Any) -> Array:
    """1 / depth, 0 where nothing is shown; without depth in both frames 1 at all surfaces. No gradient."""
    if not known:
        return jnp.where(bare, 0, 1).astype(dtype)
    depth = jax.lax.stop_gradient(jnp.asarray(buffers.depth, dtype))
    return divide(1, depth, where=~bare)


def _order(pair: Pair, motion: Array) -> tuple[Array, Array]:
    """The nearness that the target had in the source if it moved as the frame does, and the planes of the source.

    A plane is the nearness at pixel (0, 0) and its slopes, `[H, W, 3]`.
    """
    here, there = (surface_depth(cast(Array, g.depth), g.sky) for g in (pair.target, pair.source))
    here, there = (jax.lax.stop_gradient(d.astype(pair.x.dtype)) for d in (here, there))
    then, plane = expected_depth(here, there, motion), planes(there)
    x, y = pixel_grid(here.shape[0], here.shape[1], plane.dtype)
    origin = plane[..., :1] - plane[..., 1:2] * x[..., None] - plane[..., 2:] * y[..., None]
    return divide(1, then, where=~(then == jnp.inf)), jnp.concatenate([origin, plane[..., 1:]], -1)


def _depth_mask(
    pair: Pair, motion: Array, sides: list[Array], taps: Taps, threshold, soft: bool
) -> tuple[Array, _Bare]:
    """One of the two shows a surface and the other nothing, or one that is nearer; and where which shows nothing.

    Nearer counts where positions say nothing.
    """
    dtype, known, then = motion.dtype, pair.both("depth"), None
    near, image = (
        _nearness(g, nothing_there, known, pair.x.dtype)
        for g, nothing_there in zip((pair.target, pair.source), sides, strict=True)
    )
    if known and not pair.both("position"):
        then, plane = _order(pair, motion)
        image = jnp.concatenate([image, plane], -1)
    x, y = (jax.lax.stop_gradient(v)[..., None] for v in (pair.x, pair.y))
    x, y = jnp.clip(x, 0, motion.shape[1] - 1), jnp.clip(y, 0, motion.shape[0] - 1)
    bare = empty = near == 0
    other, differs, unlike = jnp.zeros(pair.outside.shape, dtype), jnp.zeros(pair.outside.shape, bool), []
    for tap, weight in _taps_around(image, pair, taps):
        nearness = tap[..., :1]
        there = nearness == 0
        empty = empty & (there | (weight <= 0))
        apart = (there != bare) | (_REMOTE * jnp.minimum(near, nearness) < jnp.maximum(near, nearness))
        unlike.append(apart)
        if then is not None:
            found = tap[..., 1:2] + tap[..., 2:3] * x + tap[..., 3:] * y
            apart |= ~there & ~bare & (found > (1 + jnp.asarray(threshold, found.dtype)) * then)
        other = other + jnp.where(apart, weight.astype(dtype), 0)
        differs |= apart & (weight > 0)
    mask = jnp.where(pair.outside, 0, other) if soft else differs & ~pair.outside
    return mask, _Bare(bare, unlike, empty)


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
            squared = jnp.where(bare.taps[k], jnp.inf, jnp.where(bare.target, 0, squared))
        farthest = jnp.maximum(farthest, jnp.where(weight > 0, squared, 0))
    limit = position_limit(pair, None if bare is None else bare.target, threshold)
    concerned = ~pair.outside if static is None else static & ~pair.outside
    return position_mask(farthest, limit, concerned, softness)


@partial(jax.jit, static_argnames=("taps",))
def _hole_masks(
    target, source, motion, softness, normal_threshold, position_threshold, depth_threshold, *, taps: Taps
) -> HoleMasks:
    """softness `None`: bool masks."""
    pair, soft = pair_of(target, source, motion), softness is not None
    outside = pair.outside.astype(motion.dtype) if soft else pair.outside
    if taps == "release":
        return HoleMasks(outside=outside, **release_masks(pair, motion, softness, normal_threshold, position_threshold))
    depth = bare = stencil = static = normal = position = None
    sides = _shows_nothing(target, source)
    if sides is not None:
        depth, bare = _depth_mask(pair, motion, sides, taps, depth_threshold, soft)
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
    depth_threshold: float | Float[ArrayLike, ""] = NEARER,
) -> HoleMasks:
    """Where a frame warped along `motion` shows another surface than the target.

    stencil: the warped stencil is not the target's. normal: the cosine of the normals is below `normal_threshold`, on
    what the stencils do not both call static (everywhere, without stencils), and not where both show nothing. position:
    the positions are farther apart than a threshold, where the stencils are both static. depth: one shows a surface and
    the other nothing (the sky's mask is above 0.5, or depth is infinite or not positive), or next to nothing (100 times
    as far); positions are then infinitely far apart. Where positions are absent, also what is nearer than the surface
    should be there: by the depth that the target would have in the source if it moved as most of the frame does
    (`expected_depth`), which needs no cameras, and of ordinal depth its order alone. outside: p + motion[p] is beyond
    the frame. Each mask needs its buffer in both G-buffers ("depth" either the sky or the depth), and is `None`
    without.

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
            the two axes, and at most three times the smallest step within two pixels), plus 0.1 % of the depth, so that
            it needs no unit. Or (facing, grazing, per_depth): T_d =
            facing |n_dot_v| + grazing (1 - |n_dot_v|) + per_depth * depth in the scene's unit. `None`: 2.0, but the
            release's (7.5, 45, 0.005) in centimetres for "release".
        depth_threshold: by how much, relatively, what is found must be nearer than expected; an object that moves away
            from the camera by more in one frame is taken for a hole.

    Returns:
        `HoleMasks` of `[H, W, 1]`.

    Edge cases:
        Motion that is not finite is outside. A position that is not finite is a hole, but where both show nothing. A
        NaN depth is a surface's.

    Gradient:
        Only of soft masks: with respect to motion, normals, positions, their thresholds and softness; not to ids, depth
        and sky.

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
    positions = tuple(position_threshold) if absolute else position_threshold
    thresholds = normal_threshold, positions, depth_threshold
    return _hole_masks(target, source, motion, softness if soft else None, *thresholds, taps=taps)


_NEEDS = {"stencil": "stencil", "normal": "normal", "position": "position", "depth": "depth or sky"}


def lacking_masks(buffers: Collection[str]) -> list[str]:
    """The hole masks that cannot be made where both frames have no more than these buffers, and what they need."""
    return [f"{n} (needs {what})" for n, what in _NEEDS.items() if not set(what.split(" or ")) & set(buffers)]


def possible_masks(buffers: Collection[str]) -> str:
    """One line: which hole masks can be made where both frames have these buffers of a `GBuffer`, and which cannot."""
    lacking = lacking_masks(buffers)
    made = [name for name in _NEEDS if not any(text.startswith(f"{name} ") for text in lacking)]
    if "depth" in buffers and "position" not in buffers:
        made[made.index("depth")] = "depth (nearer surfaces, since there is no position)"
    line = "hole masks: by " + ", ".join([*made, "the frame's edge"])
    return f"{line}; not by {', '.join(lacking)}" if lacking else line
