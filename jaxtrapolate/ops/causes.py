"""Why a predicted pixel is wrong: the causes by which errors are split; the first that applies counts."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrapolate.checks import check_image
from jaxtrapolate.ops.depth import surface_depth
from jaxtrapolate.ops.holes import hole_masks
from jaxtrapolate.ops.warp import backward_warp, in_frame
from jaxtrapolate.precision import divide
from jaxtrapolate.records import Frame, GBuffer, check_frame

CAUSES = ("border", "hole", "shadow", "glossy", "edge", "rest")
"""The causes in the order in which they are tried; `cause_map` gives indices into this."""

_SHADOW = 0.2
_ROUGH = 0.3
_JUMP = 0.05
_REACH = 2


def _neighbours(image, reach):
    """The image shifted by each offset of a square window, the border repeated."""
    height, width, _ = image.shape
    padded = jnp.pad(image, ((reach, reach), (reach, reach), (0, 0)), mode="edge")
    for j in range(2 * reach + 1):
        for i in range(2 * reach + 1):
            yield padded[j : j + height, i : i + width]


def _dilate(mask, reach):
    result = mask
    for axis in (0, 1):
        padding = [(0, 0)] * 3
        padding[axis] = (reach, reach)
        padded = jnp.pad(result, padding)
        size = result.shape[axis]
        shifted = [jax.lax.slice_in_dim(padded, k, k + size, axis=axis) for k in range(2 * reach + 1)]
        result = jnp.any(jnp.stack(shifted), 0)
    return result


def edges(gbuffer: GBuffer, *, metric_depth: bool) -> Bool[Array, "h w 1"] | None:
    """Pixels within 2 of a jump of depth or normal; `None` without both buffers.

    Metric depth jumps where its inverse, which is linear on any plane, bends by more than 5 % of itself between three
    neighbours; ordinal depth, where it bends by more than 0.05; both where a surface ends and nothing begins; the
    normal, where its cosine to a neighbour is below 0.8.
    """
    jumps = []
    if gbuffer.depth is not None:
        depth = surface_depth(gbuffer.depth, gbuffer.sky)
        bare = ~(depth < jnp.inf)
        value = divide(1, depth, where=~bare) if metric_depth else jnp.where(bare, 0, depth)
        scale = value if metric_depth else jnp.ones_like(value)
        for axis in (0, 1):
            if value.shape[axis] < 3:
                continue
            size = value.shape[axis]
            (low, l), (middle, m), (high, h) = (
                tuple(jax.lax.slice_in_dim(a, k, size - 2 + k, axis=axis) for a in (value, bare)) for k in range(3)
            )
            reference = jax.lax.slice_in_dim(scale, 1, size - 1, axis=axis)
            bent = jnp.abs(low - 2 * middle + high) > _JUMP * jnp.abs(reference)
            bent |= (l != m) | (h != m)
            padding = [(0, 0)] * 3
            padding[axis] = (1, 1)
            jumps.append(jnp.pad(bent, padding))
    if gbuffer.normal is not None:
        lowest = jnp.stack([jnp.sum(gbuffer.normal * n, -1, keepdims=True) for n in _neighbours(gbuffer.normal, 1)])
        jumps.append((jnp.min(lowest, 0) < 0.8) & jnp.any(gbuffer.normal != 0, -1, keepdims=True))
    return _dilate(jnp.any(jnp.stack(jumps), 0), _REACH) if jumps else None


@jax.jit
def _cause_map(target, source, motion, hidden, metric) -> Int[Array, "h w"]:
    here, there = target.gbuffer or GBuffer(), source.gbuffer or GBuffer()
    no = jnp.zeros((*motion.shape[:2], 1), bool)
    border = ~in_frame(motion)[..., None]
    hidden = hole_masks(here, there, motion, taps="nearest").any if hidden is None else hidden[..., None]
    shadow = glossy = no
    if here.shadow is not None and there.shadow is not None:
        shadow = jnp.abs(here.shadow - backward_warp(there.shadow, motion)) > _SHADOW
    if here.roughness is not None:
        glossy = here.roughness < _ROUGH
        glossy = glossy if here.sky is None else glossy & (here.sky < 0.5)
    edge = jnp.where(metric, _or(edges(here, metric_depth=True), no), _or(edges(here, metric_depth=False), no))
    rest = ~no
    return jnp.argmax(jnp.concatenate([border, hidden, shadow, glossy, edge, rest], -1), -1).astype(jnp.int32)


def _or(mask, otherwise):
    return otherwise if mask is None else mask


def cause_map(
    target: Frame,
    source: Frame,
    motion: Float[Array, "h w 2"],
    *,
    hidden: Bool[Array, "h w"] | None = None,
    metric_depth: bool = True,
) -> Int[Array, "h w"]:
    """For each target pixel the first cause, as an index into `CAUSES`, why the warped source may be wrong there.

    border: the motion leads beyond the frame. hole: `hidden`. shadow: the target's shadow and the warped one differ by
    more than 0.2. glossy: roughness below 0.3. edge: depth or normal jumps within 2 pixels. rest.

    Args:
        target: the ground truth, with its shadow.
        source: the rendered frame that is warped.
        motion: from target to source.
        hidden: the exact holes (`disoccluded`); without it the union of the `hole_masks` that the buffers allow, by
            the nearest pixel.
        metric_depth: whether depth is a distance, or only ordered.

    Returns:
        int32 `[H, W]`. Causes whose buffers are absent do not occur.

    Raises:
        TypeError, ValueError: no floating-point array, or a size that differs.
    """
    size = check_image("motion", motion, channels=2)
    check_frame("target", target, size=size)
    check_frame("source", source, size=size)
    return _cause_map(target, source, motion, hidden, jnp.asarray(metric_depth))
