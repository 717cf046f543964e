"""Hole masks: which pixels of a warped frame show another surface than the target (Guo et al. 2021, section 5.2)."""

import dataclasses
from functools import partial, reduce
from typing import Literal, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.checks import ArrayLike, check_choice, check_image
from jaxtrapolate.ops.depth import nothing, surface_depth
from jaxtrapolate.ops.warp import backward_warp, cell, inside, landing, root, sample, take_offsets
from jaxtrapolate.records import GBuffer, check_gbuffer, record

Taps = Literal["weighted", "nearest", "release"]


@record
@dataclasses.dataclass(frozen=True)
class HoleMasks:
    """Masks `[H, W, 1]`, True (or towards 1, where softness > 0) where a warped pixel is invalid; `None` = no buffers.

    stencil: another dynamic object. normal: another side of one. position: another place of the static scene. depth:
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


def _dot(a, b):
    """The inner product over channels, `[H, W, 1]`; written out, because XLA's loops over three numbers are slow."""
    terms = (a[..., k : k + 1] * b[..., k : k + 1] for k in range(a.shape[-1]))
    return cast(Array, sum(terms))  # there is a channel, so that it is not the int 0


def _footprint(position, bare):
    """The distance of each pixel's position to the nearer of its neighbours, the larger one of the two axes.

    A neighbour that shows nothing, or whose position is not finite, does not count; 0 without neighbours.
    """
    result = None
    known = _dot(position, position) < jnp.inf
    known = known if bare is None else known & ~bare
    position = jnp.where(known, position, 0)
    for axis in (0, 1):
        if position.shape[axis] == 1:
            continue
        step = jnp.diff(position, axis=axis)
        whole = [jax.lax.slice_in_dim(known, k, known.shape[axis] - 1 + k, axis=axis) for k in (0, 1)]
        squared = jnp.where(whole[0] & whole[1], _dot(step, step), jnp.inf)
        first, last = (jax.lax.slice_in_dim(squared, *ends, axis=axis) for ends in ((0, 1), (-1, None)))
        nearer = jnp.minimum(jnp.concatenate([first, squared], axis), jnp.concatenate([squared, last], axis))
        nearer = jnp.where(nearer < jnp.inf, nearer, 0)
        result = nearer if result is None else jnp.maximum(result, nearer)
    return jnp.zeros_like(position[..., :1]) if result is None else root(result)


def _taps(image, x, y, taps):
    """The pixels that count around each landing place and their weights `[H, W, 1]`; one, or four."""
    height, width, _ = image.shape
    if taps == "nearest":
        return [(sample(image, x, y, filter="nearest"), jnp.ones((*x.shape, 1), x.dtype))]
    column, t = cell(x, width)
    row, u = cell(y, height)
    t, u = t[..., None], u[..., None]
    right, down = int(width > 1), int(height > 1)
    values = take_offsets(image, row, column, [(0, 0), (0, right), (down, 0), (down, right)])
    return list(zip(values, [(1 - t) * (1 - u), t * (1 - u), (1 - t) * u, t * u], strict=False))


def _bare(target, source):
    """Where the two show no surface, by the sky and the depth that both have, bool `[H, W, 1]`; without, `None`."""
    masks = []
    if target.sky is not None and source.sky is not None:
        masks.append([g.sky > 0.5 for g in (target, source)])
    if target.depth is not None and source.depth is not None:
        masks.append([nothing(g.depth) for g in (target, source)])
    return [reduce(jnp.logical_or, side) for side in zip(*masks, strict=True)] if masks else None


def _soft(excess, softness):
    """0.5 at excess 0; excess is relative to the threshold."""
    return jax.nn.sigmoid(excess / jnp.asarray(softness, excess.dtype))


@partial(jax.jit, static_argnames=("taps", "soft", "absolute"))
def _hole_masks(target, source, motion, thresholds, *, taps, soft, absolute):
    softness, normal_threshold, position_threshold = thresholds
    height, width, _ = motion.shape
    x, y, finite = landing(motion)
    seen = (finite & inside(x, y, height, width))[..., None]
    outside = ~seen
    bare, around, neither = _bare(target, source) if taps != "release" else None, [], jnp.zeros(outside.shape, bool)
    both = {name: getattr(target, name) is not None and getattr(source, name) is not None for name in _READ}

    depth = None
    if bare is not None:
        around = [(there > 0.5, weight) for there, weight in _taps(bare[1].astype(motion.dtype), x, y, taps)]
        other = jnp.zeros(outside.shape, motion.dtype)
        differs = jnp.zeros(outside.shape, bool)
        for there, weight in around:
            other = other + jnp.where(there != bare[0], weight.astype(motion.dtype), 0)
            differs |= (there != bare[0]) & (weight > 0)
        depth = jnp.where(seen, other, 0) if soft else differs & seen
        neither = bare[0] & ~differs

    stencil = static = None
    if both["stencil"] and taps == "release":
        warped = backward_warp(source.stencil, motion, outside="zero")
        difference = jnp.abs(warped - target.stencil)
        stencil = _soft(3 * difference - 1, softness) if soft else difference > 1 / 3
        static = warped == 0
    elif both["stencil"]:
        other = jnp.zeros(outside.shape, x.dtype)
        differs = jnp.zeros(outside.shape, bool)
        moving = jnp.zeros(outside.shape, bool)
        for ids, weight in _taps(source.stencil, x, y, taps):
            another = jnp.round(ids) != jnp.round(target.stencil)
            other = other + jnp.where(another, weight, 0)
            differs |= another & (weight > 0)
            moving |= (jnp.round(ids) != 0) & (weight > 0)
        stencil = jnp.where(seen, other, 0) if soft else differs & seen
        static = ~moving & (jnp.round(target.stencil) == 0)
    dynamic = jnp.ones(outside.shape, bool) if static is None else ~static
    still = jnp.ones(outside.shape, bool) if static is None else static

    normal = None
    if both["normal"]:
        filter = "nearest" if taps == "nearest" else "bilinear"
        warped = backward_warp(source.normal, motion, filter=filter, outside="zero")
        here, there = _dot(target.normal, target.normal), _dot(warped, warped)
        concerned = dynamic & ((here > 0) | (there > 0))
        cosine = _dot(target.normal, warped)
        if taps != "release":  # the mean of unit vectors is shorter than they are
            lengths = here * there
            cosine = jnp.where(lengths > 0, cosine / jnp.sqrt(jnp.where(lengths > 0, lengths, 1)), 0)
            concerned &= seen & ~neither
        least = jnp.asarray(normal_threshold, cosine.dtype)
        if soft:
            normal = jnp.where(concerned, _soft((least - cosine) / (1 - least), softness), 0)
        else:
            normal = concerned & (cosine < least)

    position = None
    if both["position"]:
        if absolute:
            facing, grazing, per_depth = (jnp.asarray(a, target.position.dtype) for a in position_threshold)
            n_dot_v = 1.0 if target.n_dot_v is None else jnp.abs(target.n_dot_v)
            limit = facing * n_dot_v + grazing * (1 - n_dot_v) + jnp.zeros(outside.shape, motion.dtype)
        else:
            limit = _footprint(target.position, None if bare is None else bare[0])
            limit, per_depth = jnp.asarray(position_threshold, limit.dtype) * limit, _PER_DEPTH
        if target.depth is not None:
            whole = surface_depth(target.depth, target.sky)
            whole = jnp.where(jnp.isfinite(whole), whole, 0)
            limit = limit + per_depth * whole
        farthest = jnp.zeros(outside.shape, target.position.dtype)
        for k, (place, weight) in enumerate(_taps(source.position, x, y, taps)):
            known = _dot(place, place) + _dot(target.position, target.position) < jnp.inf
            apart = jnp.where(known, place - target.position, 0)
            squared = jnp.where(known, _dot(apart, apart), jnp.inf)
            if bare is not None:
                squared = jnp.where(around[k][0] != bare[0], jnp.inf, jnp.where(bare[0], 0, squared))
            if taps != "release":
                squared = jnp.where(weight > 0, squared, 0)
            farthest = jnp.maximum(farthest, squared)
        if taps == "release":
            farthest = jnp.where(outside, jnp.inf, farthest)
        concerned = still if taps == "release" else still & seen
        if both["sky"] and taps == "release":
            concerned &= (target.sky < 0.5) | (sample(source.sky, x, y, filter="nearest") < 0.5)
        if soft:
            limit = jnp.where(limit > 0, limit, jnp.finfo(limit.dtype).tiny)
            distance = root(jnp.where(jnp.isfinite(farthest), farthest, 0))
            excess = jnp.where(jnp.isfinite(farthest), distance / limit - 1, 1e6)
            position = jnp.where(concerned, _soft(excess, softness), 0)
        else:
            position = concerned & ~((farthest <= jnp.square(limit)) & (farthest < jnp.inf))

    out = outside.astype(motion.dtype) if soft else outside
    return HoleMasks(stencil=stencil, normal=normal, position=position, depth=depth, outside=out)


_READ = ("stencil", "normal", "position", "sky")
_PER_DEPTH = 1e-3
_RELEASE = (7.5, 45.0, 0.005)  # centimetres


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
        target, source: the G-buffers of the frame to be made and of the one that is warped.
        motion: `[H, W, 2]` from target to source.
        taps: "weighted" looks only at those of the four bilinear taps that have weight, so that a frame warped onto
            itself has no holes; ids are compared, not their mean. "nearest" looks at the nearest pixel alone: the
            pixels beside a silhouette, of whose taps one is wrong, are then no holes. "release" does as the authors':
            the bilinear mean of the ids, more than 1/3 off; the largest distance over all four taps; everything
            outside is a hole of position as well; it has no mask of depth.
        softness: 0 gives bool masks. Above 0 they are in 0..1 and differentiable: a sigmoid of the excess over the
            threshold, relative to it, over softness; the stencil's is the weight of the taps with another id.
        normal_threshold: T_n, a cosine.
        position_threshold: a number: how many times the distance between neighbouring pixels' positions (the larger of
            the two axes), plus 0.1 % of the depth, so that it needs no unit. Or (facing, grazing, per_depth): T_d =
            facing |n_dot_v| + grazing (1 - |n_dot_v|) + per_depth * depth in the scene's unit. `None`: 2.0, but
            the release's (7.5, 45, 0.005) in centimetres for "release".

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
    check_choice("taps", taps, ("weighted", "nearest", "release"))
    if position_threshold is None:
        position_threshold = _RELEASE if taps == "release" else 2.0
    soft = not (isinstance(softness, (int, float)) and softness == 0)
    absolute = isinstance(position_threshold, tuple | list)
    thresholds = softness, normal_threshold, position_threshold
    return _hole_masks(target, source, motion, thresholds, taps=taps, soft=soft, absolute=absolute)
