"""G-buffer-guided warping (Wu et al. 2023, ExtraSS, section 4.2).

Around the position that the motion leads to, candidate pixels are compared with the target pixel by their guides
(albedo, normals) and by their distance on the screen; the best few are blended. It is a joint bilateral filter that
reaches past an occluder for a like surface, so that it fills disoccluded pixels as well.
"""

from collections.abc import Sequence
from functools import partial
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt32

from jaxtrapolate.checks import ArrayLike, check_choice, check_image, check_scalar
from jaxtrapolate.ops.warp import backward_warp, landing, pixel_grid, take_rows, weigh
from jaxtrapolate.precision import widest

Guides = Literal["float32", "packed"]

_NO_TAP = 63
_NONE = np.uint32(0xFFFFFFFF)
_STRIP = 16  # rows
_LEAST = 1e-12  # sigma


def guided_taps(strides: Sequence[int]) -> list[tuple[int, int]]:
    """The distinct offsets (y, x) of all kernels: the centre, then stride by stride, row by row.

    This is the order in which ties are resolved.
    """
    taps = [(0, 0)]
    for s in strides:
        taps += [(s * k, s * l) for k in (-1, 0, 1) for l in (-1, 0, 1) if (k, l) != (0, 0)]
    return taps


def _nearest(position, reach, size):
    """The pixel nearest to the displaced position, held within one more than the kernels' reach of the frame."""
    return jnp.clip(jnp.floor(jax.lax.stop_gradient(position) + 0.5), -reach - 1, size + reach).astype(jnp.int32)


def _factors(sigma_guide, sigma_space):
    """The smaller sigma, and what squared differences are weighted with relative to it.

    cost = guide * |guide difference|^2 + space * |distance|^2 is then 2 m^2 times the negative logarithm of the weight:
    the order is kept, and it neither over- nor underflows for any sigma.
    """
    # below this a cube underflows float32, and XLA merges several divisions into one: 0 / 0
    sigma_guide, sigma_space = (jnp.where(sigma > _LEAST, sigma, _LEAST) for sigma in (sigma_guide, sigma_space))
    m = jnp.minimum(sigma_guide, sigma_space)
    return m, (m / sigma_guide) ** 2, (m / sigma_space) ** 2


def _select(x, y, target, padded, guide_factor, space_factor, *, shape, reach, taps, keep) -> UInt32[Array, "h w"]:
    """The `keep` taps with the largest weights, best first, 6 bits each from the lowest on; 63 = no tap.

    A tap's key is its cost, as an integer of the same order, with the tap's number in the lowest six bits: costs that
    differ by less than 2^-17 of their value count as equal, and ties go to the earlier tap. All taps and their ranking
    are one pass over the pixels with one output, so that XLA fuses it into one loop.
    """
    height, width = shape
    border = 2 * reach + 1
    stride = width + 2 * border
    count = (height + 2 * border) * stride - 2 * reach * (stride + 1)
    channels = target.shape[-1]
    column, row = _nearest(x, reach, width), _nearest(y, reach, height)
    base = (row + border - reach) * stride + column + border - reach
    dx, dy = x - column.astype(x.dtype), y - row.astype(y.dtype)
    best = [jnp.full(x.shape, _NONE)] * keep
    for number, (j, i) in enumerate(taps):
        shift = (j + reach) * stride + i + reach
        there = padded[shift : shift + count]
        theirs = [take_rows(there[:, k : k + 1], base)[..., 0] for k in range(there.shape[-1])]
        squared = jnp.zeros((), target.dtype)
        for k in range(channels):
            squared = squared + jnp.square(target[..., k] - theirs[k].astype(target.dtype))
        apart = jnp.square(dx - i) + jnp.square(dy - j)
        cost = guide_factor * squared + space_factor * apart
        bits = jax.lax.bitcast_convert_type(cost.astype(jnp.float32), jnp.uint32)
        key = jnp.where(cost < jnp.inf, (bits & np.uint32(0xFFFFFFC0)) | np.uint32(number), _NONE)
        for slot in range(keep):
            best[slot], key = jnp.minimum(best[slot], key), jnp.maximum(best[slot], key)
    code = jnp.zeros(x.shape, jnp.uint32)
    for slot in range(keep):
        code = code | ((best[slot] & np.uint32(63)) << np.uint32(6 * slot))
    return code


def _blend(code, x, y, image, target, source, smaller, guide_factor, space_factor, *, reach, taps, keep):
    """The weighted mean of the selected taps, weights from the unquantised guides; differentiable."""
    height, width, channels = image.shape
    column, row = _nearest(x, reach, width), _nearest(y, reach, height)
    nearest = jnp.clip(row, 0, height - 1) * width + jnp.clip(column, 0, width - 1)
    offsets = jnp.asarray([j * 4096 + i + 2048 for j, i in taps] + [0] * (64 - len(taps)), jnp.int32)[:, None]
    rows = source.reshape(-1, source.shape[-1])

    def locate(slot):
        """Row, column and flat index of a slot's tap; the index of the nearest pixel where there is no tap."""
        tap = ((code >> slot) & np.uint32(63)).astype(jnp.int32)
        offset = take_rows(offsets, tap)[..., 0]
        tap_row, tap_column = row + (offset >> 12), column + (offset & 4095) - 2048
        used = tap != _NO_TAP
        return used, tap_row, tap_column, jnp.where(used, tap_row * width + tap_column, nearest)

    def rate(slot):
        used, tap_row, tap_column, index = locate(slot)
        squared = jnp.zeros((), x.dtype)
        for k in range(source.shape[-1]):
            theirs = take_rows(rows[:, k : k + 1], index)[..., 0]
            squared = squared + jnp.square(jnp.where(used, target[..., k] - theirs, 0))
        # where unused, the square may be infinite, and its derivative
        dx, dy = (jnp.where(used, a - b.astype(a.dtype), 0) for a, b in ((x, tap_column), (y, tap_row)))
        apart = jnp.square(dx) + jnp.square(dy)
        return jnp.where(used, guide_factor * squared + space_factor * apart, jnp.inf)

    slots = 6 * jnp.arange(keep, dtype=jnp.uint32)
    costs = jax.lax.map(rate, slots)
    least = jax.lax.stop_gradient(jnp.min(costs, 0, keepdims=True))
    any_tap, used = least < jnp.inf, costs < jnp.inf
    # divided twice, because 2 m^2 itself may underflow
    over = jnp.where(used, costs - jnp.where(any_tap, least, 0), 0) / smaller / smaller * 0.5
    weights = jnp.where(used, jnp.exp(-over), 0)
    weights = weights.at[0].set(jnp.where(any_tap[0], weights[0], 1))
    total = jnp.sum(weights, 0)
    colors = image.reshape(-1, channels)
    result = jnp.zeros((), weights.dtype)
    for k in range(keep):
        value = take_rows(colors, locate(np.uint32(6 * k))[-1]).astype(weights.dtype)
        result = result + weigh(value, (weights[k] / total)[..., None])
    return result.astype(image.dtype)


def _in_strips(function, *operands):
    """function(operands) `[h, W, ...]` by strips of rows of the operands `[H, W, ...]`.

    A loop is a border across which XLA fuses nothing. Without one, all that uses the selected taps would make the whole
    selection anew; on a CPU the strips also keep what lies between the steps in the cache.
    """
    height = operands[0].shape[0]

    def by(rows, *operands):
        strips = -(-height // rows)

        def split(a):
            a = jnp.pad(a, ((0, strips * rows - height),) + ((0, 0),) * (a.ndim - 1))
            return a.reshape(strips, rows, *a.shape[1:])

        result = jax.lax.map(lambda strip: function(*strip), tuple(split(a) for a in operands))
        return result.reshape(strips * rows, *result.shape[2:])[:height]

    half = max(1, -(-height // 2))
    return jax.lax.platform_dependent(*operands, cpu=partial(by, min(_STRIP, half)), default=partial(by, half))


def _bordered(guide, reach):
    """The guide as `_select` reads it: around it what has no weight, flattened."""
    border = 2 * reach + 1
    padded = jnp.pad(
        guide, ((border, border), (border, border), (0, 0)), constant_values=jnp.asarray(jnp.inf, guide.dtype)
    )
    return padded.reshape(-1, padded.shape[-1])


@partial(jax.jit, static_argnames=("strides", "keep", "packed"))
def _guided_warp(image, motion, target, source, sigma_guide, sigma_space, *, strides, keep, packed):
    height, width, _ = image.shape
    wide = widest(motion)
    target, source = target.astype(wide), source.astype(wide)
    smaller, *factors = _factors(jnp.asarray(sigma_guide, wide), jnp.asarray(sigma_space, wide))
    taps = guided_taps(strides)
    reach = max(strides)
    x, y, _ = landing(motion.astype(wide))

    compared, against = jax.lax.stop_gradient((target, source))
    if packed:
        against = against.astype(jnp.float16)
        compared = compared.astype(jnp.float16).astype(wide)
    padded = _bordered(against, reach)

    def select(x, y, compared):
        fixed = jax.lax.stop_gradient((x, y, compared, padded, *factors))
        return _select(*fixed, shape=(height, width), reach=reach, taps=taps, keep=keep)

    def blend(code, x, y, target):
        return _blend(code, x, y, image, target, source, smaller, *factors, reach=reach, taps=taps, keep=keep)

    if keep == 1:  # a loop over one tap is none, and no border: so the selection has a loop of its own
        return blend(_in_strips(select, x, y, compared), x, y, target)
    return _in_strips(
        lambda x, y, target, compared: blend(select(x, y, compared), x, y, target), x, y, target, compared
    )


def guided_warp(
    image: Float[ArrayLike, "h w c"],
    motion: Float[ArrayLike, "h w 2"],
    target_guide: Float[ArrayLike, "h w g"],
    source_guide: Float[ArrayLike, "h w g"],
    *,
    strides: Sequence[int] = (1, 3, 5, 9),
    sigma_guide: float | Float[ArrayLike, ""] = 0.03,
    sigma_space: float | Float[ArrayLike, ""] = 0.5,
    keep: int = 4,
    guides: Guides = "float32",
) -> Float[Array, "h w c"]:
    """The image fetched along the motion, from the most similar of the pixels around the displaced position.

    w(y) = exp(-|target_guide(p) - source_guide(y)|^2 / (2 sigma_guide^2))
         * exp(-|p + motion[p] - y|^2 / (2 sigma_space^2)) for the taps y; the `keep` largest are normalised, blended.

    Args:
        image: `[H, W, C]` of the source frame, demodulated as a rule.
        motion: `[H, W, 2]` from target to source.
        target_guide: `[H, W, G]`, albedo and normal in the paper.
        source_guide: of the source frame, likewise.
        strides: of the 3 x 3 kernels, all distinct, 1 to 7 of them. The taps are the distinct pixels round(p +
            motion[p]) + stride * (k, l); distances are measured from the unrounded position.
        sigma_guide: in units of the guides.
        sigma_space: in pixels. Both > 0 (below 1e-12 they count as that); traced, so that they can be fitted.
        keep: how many taps are blended, 1 to 5.
        guides: "float32", or "packed": the ranking of the taps compares guides rounded to float16 (of up to 65504) and
            reads half the memory; whether that is faster depends on the machine. The weights of the taps that were
            picked are exact in both. See the README for its error and speed.

    Returns:
        `[H, W, C]` of the dtype of `image`. Blended in at least float32.

    Convention:
        Pull: `motion` is added to p; pixels, x right, y down, integers are centres.

    Edge cases:
        Taps outside the frame, or with guides that are not finite, have no weight. Where no tap is left the pixel of
        the frame nearest to the displaced position is taken. Motion that is not finite counts as 0. Ties (costs that
        differ by less than 2^-17 of their value) go to the first tap: the centre, then stride by stride, row by row.
        Weights are compared and normalised as logarithms, so that no sigma underflows. Zero motion returns the image
        where the kept neighbours have no weight beside the centre, not in general: this is a filter.

    Gradient:
        With respect to image, motion, both guides and both sigmas, through the weights of the taps that are kept; which
        taps these are, and the rounding, are held fixed.

    Raises:
        TypeError, ValueError: no floating-point array, a shape or option that does not fit.

    References:
        Wu et al. 2023 (ExtraSS), section 4.2, equations 1-3. Departures: the centre counts once, the Gaussians carry no
        normalising factor (it cancels), logarithms instead of weights.
    """
    size = check_image("image", image)
    check_image("motion", motion, size=size, channels=2)
    check_image("target_guide", target_guide, size=size)
    check_image("source_guide", source_guide, size=size, channels=target_guide.shape[-1])
    check_choice("guides", guides, get_args(Guides))
    for name, sigma in (("sigma_guide", sigma_guide), ("sigma_space", sigma_space)):
        check_scalar(name, sigma)
    if not isinstance(strides, Sequence) or not all(isinstance(s, int) for s in strides):
        raise TypeError(f"strides: expected 1 to 7 distinct integers from 1 to 1024, as in (1, 3, 5), got {strides!r}")
    strides = tuple(strides)
    if not (1 <= len(strides) <= 7 and len(set(strides)) == len(strides) and all(1 <= s <= 1024 for s in strides)):
        raise ValueError(f"strides: expected 1 to 7 distinct integers from 1 to 1024, got {strides}")
    if not 1 <= keep <= 5:
        raise ValueError(f"keep: expected 1 to 5, got {keep!r}")
    return _guided_warp(
        image,
        motion,
        target_guide,
        source_guide,
        sigma_guide,
        sigma_space,
        strides=strides,
        keep=keep,
        packed=guides == "packed",
    )


@partial(jax.jit, static_argnames=("step",))
def far_motion(
    motion: Float[ArrayLike, "h w 2"],
    target_guide: Float[ArrayLike, "h w g"],
    source_guide: Float[ArrayLike, "h w g"],
    holes: Bool[ArrayLike, "h w 1"],
    *,
    step: int,
    unlike: float | Float[ArrayLike, ""] = 0.1,
) -> Float[Array, "h w 2"]:
    """The motion, in holes led on to the nearest like surface further away than `guided_warp` looks.

    Its kernels reach 9 pixels, which a hole of a large frame is wider than. Here the same search runs among every
    `step`-th pixel of every `step`-th row, so that it reaches that many times as far at 1 / step^2 of the cost; a hole
    whose guides differ where the motion leads goes where its block's pixel found the best tap. Ours, no paper's.

    Args:
        motion: `[H, W, 2]` from target to source.
        target_guide: `[H, W, G]`.
        source_guide: `[H, W, G]`.
        holes: where the motion may be changed.
        step: in pixels, >= 1.
        unlike: squared difference of the guides, at the pixel nearest to the displaced position, above which it is
            changed.

    Returns:
        `[H, W, 2]`. Its derivative is that of the motion: what was added is held fixed.

    Edge cases:
        What lies out of the frame by more than the search's reach is led to the frame's edge. Where a guide is not
        finite, or the motion, it is left unchanged.
    """
    motion, target_guide, source_guide = (jnp.asarray(a) for a in (motion, target_guide, source_guide))
    height, width, _ = motion.shape
    starts = [min(step // 2, size - 1) for size in (height, width)]

    def thin(a):
        return a[starts[0] :: step, starts[1] :: step]

    thinned = thin(jax.lax.stop_gradient(motion)) / step
    x, y, _ = landing(thinned)
    columns, rows = pixel_grid(x.shape[0], x.shape[1], x.dtype)
    grid = jnp.stack(jnp.broadcast_arrays(columns, rows), -1)
    found = guided_warp(grid, thinned, thin(target_guide), thin(source_guide), keep=1)
    further = jax.lax.stop_gradient(step * (found - jnp.stack([x, y], -1)))
    further = jnp.repeat(jnp.repeat(further, step, 0), step, 1)
    short = [(0, max(0, size - have)) for size, have in zip((height, width), further.shape, strict=False)]
    further = jnp.pad(further, (*short, (0, 0)), mode="edge")[:height, :width].astype(motion.dtype)
    there = backward_warp(source_guide, motion, filter="nearest")
    apart = jnp.sum(jnp.square(target_guide - there), -1, keepdims=True)
    differ = apart > jnp.asarray(unlike, apart.dtype)
    return jnp.where(holes & differ, motion + further, motion)
