"""Filling holes of a warped image from what is around them: by a pyramid, or from the next pixels."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrapolate.checks import ArrayLike, Size, check_image
from jaxtrapolate.ops.depth import surface_depth
from jaxtrapolate.ops.warp import take_rows
from jaxtrapolate.precision import widest


def check_mask(name: str, value: Bool[ArrayLike, "h w"], *, size: Size) -> None:
    """Raise unless `value` is a bool mask `[H, W]` of that size."""
    if not hasattr(value, "dtype") or value.dtype != jnp.bool_:
        raise TypeError(f"{name}: expected a bool array, got {getattr(value, 'dtype', type(value).__name__)}")
    if value.shape != size:
        raise ValueError(f"{name}: expected shape {list(size)}, got {list(value.shape)}")


def _halved(image: Array) -> Array:
    """Sums over blocks of 2 x 2 pixels; at an odd border they are smaller."""
    height, width, _ = image.shape
    padded = jnp.pad(image, ((0, height % 2), (0, width % 2), (0, 0)))
    rows = padded[::2] + padded[1::2]
    return rows[:, ::2] + rows[:, 1::2]


def _doubled(image: Array, size: int, axis: int) -> Array:
    """Linear interpolation to twice as many pixels along an axis, of which the first `size` are kept."""
    count = image.shape[axis]
    ends = [jax.lax.slice_in_dim(image, k, k + 1, axis=axis) for k in (0, count - 1)]
    before = jnp.concatenate([ends[0], jax.lax.slice_in_dim(image, 0, count - 1, axis=axis)], axis)
    after = jnp.concatenate([jax.lax.slice_in_dim(image, 1, count, axis=axis), ends[1]], axis)
    quarter = jnp.asarray(0.25, image.dtype)  # of equal pixels it is exactly that value
    pair = jnp.stack([image + (other - image) * quarter for other in (before, after)], axis + 1)
    shape = (*image.shape[:axis], 2 * count, *image.shape[axis + 1 :])
    return jax.lax.slice_in_dim(pair.reshape(shape), 0, size, axis=axis)


@jax.jit
def fill_pyramid(image: Float[ArrayLike, "h w c"], covered: Bool[ArrayLike, "h w"]) -> Float[Array, "h w c"]:
    """Holes filled from coarser and coarser levels of the image (pull-push): the larger a hole, the smoother.

    Pull: each level is the mean over blocks of 2 x 2 of what is covered in the one below. Push: from the coarsest level
    on, what is not covered is interpolated bilinearly from the level above.

    Args:
        image: `[H, W, C]`.
        covered: bool `[H, W]`, False in holes.

    Returns:
        `[H, W, C]`; covered pixels unchanged, bit for bit. Holes in a constant image get the constant. Zero where
        nothing at all is covered.

    Edge cases:
        Pixels that are not finite fill nothing; covered ones stay. Sizes need not be even: blocks at the border are
        smaller.

    Gradient:
        With respect to the image, which the result is linear in.

    Raises:
        TypeError, ValueError: no floating-point image, no bool mask, or sizes that differ.

    References:
        Gortler et al. 1996 (The lumigraph), section 4.4; instead of the hole filling in several scales of
        Schollmeyer et al. 2017. Departure: coverage is 0 or 1 at every level. To take only the farther pixels of each
        block, as holes show background, gained nothing on embedded scenes.
    """
    size = check_image("image", image)
    check_mask("covered", covered, size=size)
    known = covered[..., None] & jnp.all(jnp.isfinite(image), -1, keepdims=True)
    value = jnp.where(known, image, 0).astype(widest(image))
    levels = [(value, known)]
    while max(value.shape[:2]) > 1:
        total = _halved(jnp.concatenate([value, known.astype(value.dtype)], -1))
        count = total[..., -1:]
        known = count > 0
        value = total[..., :-1] / jnp.maximum(count, 1)
        levels.append((value, known))
    filled = levels[-1][0]
    for value, known in reversed(levels[:-1]):
        above = _doubled(_doubled(filled, value.shape[0], 0), value.shape[1], 1)
        filled = jnp.where(known, value, above)
    return jnp.where(covered[..., None], image, filled.astype(image.dtype))


def _last(mask: Array, axis: int, reverse: bool) -> Array:
    """The index along an axis of the last pixel in the mask up to each pixel; -1 where there is none."""
    index = jax.lax.broadcasted_iota(jnp.int32, mask.shape, axis)
    if not reverse:
        return jax.lax.cummax(jnp.where(mask, index, -1), axis=axis)
    count = mask.shape[axis]
    found = jax.lax.cummin(jnp.where(mask, index, count), axis=axis, reverse=True)
    return jnp.where(found < count, found, -1)


def covered_around(covered: Bool[Array, "h w"]) -> Iterator[tuple[Array, Array, Array]]:
    """The next covered pixel to the left, right, above and below each pixel, which is itself if covered.

    Yields for each direction `[H, W]`: whether there is one, its index in the image's rows put one after the other
    (in bounds in any case), and how many pixels away it is.
    """
    height, width = covered.shape
    row, column = (jax.lax.broadcasted_iota(jnp.int32, (height, width), k) for k in (0, 1))
    for axis, reverse in ((1, False), (1, True), (0, False), (0, True)):
        found = _last(covered, axis, reverse)
        there = jnp.maximum(found, 0)
        index = row * width + there if axis == 1 else there * width + column
        yield found >= 0, index, jnp.abs(found - (column if axis == 1 else row))


@jax.jit
def fill_around(
    image: Float[ArrayLike, "h w c"],
    covered: Bool[ArrayLike, "h w"],
    *,
    depth: Float[ArrayLike, "h w 1"] | None = None,
) -> Float[Array, "h w c"]:
    """Holes filled with one of the next covered pixels to the left, right, above and below: the farthest in depth.

    What comes into view behind a moving object is background, and so is the farther side of the hole.

    Args:
        image: `[H, W, C]`.
        covered: bool `[H, W]`, False in holes.
        depth: `[H, W, 1]` of the image, smaller is nearer, what is not positive is nothing, and the farthest; without
            it the closest of the four pixels is taken.

    Returns:
        `[H, W, C]`; covered pixels unchanged. Of equal depths the closest, then left before right before above. Zero
        where nothing is covered in a hole's row and column. NaN depth counts as nearest.

    Gradient:
        With respect to the image; which pixel is taken is held fixed.

    Raises:
        TypeError, ValueError: no floating-point image, no bool mask, or sizes that differ.

    References:
        Ours; Mark et al. 1997 let the mesh stretch, and prefer another reference image, where there is one.
    """
    height, width = size = check_image("image", image)
    check_mask("covered", covered, size=size)
    far = None
    if depth is not None:
        check_image("depth", depth, size=size, channels=1)
        far = surface_depth(jnp.asarray(depth))
        far = jnp.where(jnp.isnan(far), -jnp.inf, far).reshape(-1)
    covered = jnp.asarray(covered)
    best = jnp.full(size, -1, jnp.int32)
    farthest = jnp.full(size, -jnp.inf, jnp.float32 if far is None else far.dtype)
    steps = jnp.full(size, height + width, jnp.int32)
    for found, index, apart in covered_around(covered):
        behind = jnp.zeros_like(farthest) if far is None else take_rows(far[:, None], index)[..., 0]
        better = (behind > farthest) | ((behind == farthest) & (apart < steps)) | (best < 0)
        better &= found
        best, farthest, steps = (
            jnp.where(better, a, b) for a, b in ((index, best), (behind, farthest), (apart, steps))
        )
    taken = take_rows(jnp.asarray(image).reshape(-1, image.shape[-1]), jnp.maximum(best, 0))
    taken = jnp.where(best[..., None] >= 0, taken, 0)
    return jnp.where(covered[..., None], image, taken)
