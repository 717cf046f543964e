"""Inverse search of patches, and a dense flow of theirs (Kroeger et al. 2016, sections 2.1 and 2.2).

Patches of 8 x 8 pixels lie on a grid in the first image, each with one displacement. Arrays `[8, 8, N]` have the
pixels of the patch first and the N patches last, row by row; displacements are `[N]`.
"""

import operator
from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxtrapolate.checks import Size
from jaxtrapolate.ops.strips import once
from jaxtrapolate.ops.warp import take_rows
from jaxtrapolate.precision import divide

PATCH = 8
_DAMPING = 1e-3  # of a Hessian's trace: along an edge a patch does not slide
_FLAT = 1.0  # squared grey levels: a gradient of this little says nothing


class Patches(NamedTuple):
    """What a search compares with.

    Attributes:
        grey: of the first image.
        x, y: its gradient, without its mean over the patch, times the weight.
        weight: of the pixels in the patch; `None` if all count.
        total: the sum of the weights.
        inverse: of the Hessian: its three entries.
    """

    grey: Float[Array, "8 8 n"]
    x: Float[Array, "8 8 n"]
    y: Float[Array, "8 8 n"]
    weight: Float[Array, "8 8 n"] | None
    total: Float[Array, " n"]
    inverse: tuple[Array, Array, Array]


class Found(NamedTuple):
    """Displacements, the residual's product with the gradient there, its sum of squares, and how far to step next."""

    x: Array
    y: Array
    slope: Complex[Array, " n"]
    error: Float[Array, " n"]
    step: Float[Array, " n"]


def grid(size: Size, stride: int) -> Size:
    """How many rows and columns of patches cover an image; the last ones may hang over."""
    rows, columns = (max(1, -(-(n - PATCH) // stride) + 1) for n in size)
    return rows, columns


def _covering(image, stride):
    """The image with its edge repeated, as far as patches reach."""
    height, width = image.shape
    rows, columns = ((n - 1) * stride + PATCH for n in grid((height, width), stride))
    return jnp.pad(image, ((0, rows - height), (0, columns - width)), mode="edge")


def cut(image: Float[Array, "h w"], stride: int) -> Float[Array, "8 8 n"]:
    """All patches of an image."""
    rows, columns = grid((image.shape[0], image.shape[1]), stride)
    padded = _covering(image, stride)
    ends = (rows - 1) * stride + 1, (columns - 1) * stride + 1

    def tap(offset):
        below = jax.lax.dynamic_slice(padded, (offset // PATCH, offset % PATCH), ends)
        return below[::stride, ::stride].reshape(-1)

    return jax.lax.map(tap, jnp.arange(PATCH * PATCH)).reshape(PATCH, PATCH, -1)


def centres(image: Float[Array, "h w"], stride: int) -> Float[Array, " n"]:
    """The pixel in the middle of each patch."""
    rows, columns = grid((image.shape[0], image.shape[1]), stride)
    padded, half = _covering(image, stride), PATCH // 2
    ends = half + (rows - 1) * stride + 1, half + (columns - 1) * stride + 1
    return padded[half : ends[0] : stride, half : ends[1] : stride].reshape(-1)


def gradient(image: Float[Array, "h w"], axis: int) -> Float[Array, "h w"]:
    """Central differences; the edge is repeated."""
    padding = [(0, 0), (0, 0)]
    padding[axis] = (1, 1)
    padded, size = jnp.pad(image, padding, mode="edge"), image.shape[axis]
    after, before = (jax.lax.slice_in_dim(padded, k, k + size, axis=axis) for k in (2, 0))
    return (after - before) * 0.5


def _sums(terms, *given):
    """Sums over the pixels of each patch, of the terms that a function makes of them; row by row, as they lie."""

    def pixel(arrays, i):
        return (None if a is None else a[i] for a in arrays)

    def row(sums, arrays):
        for i in range(PATCH):
            sums = [a + b for a, b in zip(sums, terms(*pixel(arrays, i)), strict=True)]
        return sums, None

    zero = [jnp.zeros_like(a) for a in terms(*pixel([None if a is None else a[0] for a in given], 0))]
    return jax.lax.scan(row, zero, given)[0]


def patches(first: Float[Array, "h w"], stride: int, weight: Float[Array, "8 8 n"] | None) -> Patches:
    """All patches of the first image; `weight` is of their pixels."""

    def weighed(a, weight):
        return a if weight is None else a * weight

    images = jnp.stack([first, *(gradient(first, axis) for axis in (1, 0))])
    grey, x, y = jax.vmap(partial(cut, stride=stride))(images)
    count, *totals = _sums(lambda x, y, w: [weighed(a, w) for a in (jnp.ones_like(x), x, y)], x, y, weight)
    x, y = (a - divide(total, count)[None, None] for a, total in zip((x, y), totals, strict=True))
    xx, xy, yy = _sums(lambda x, y, w: [weighed(a, w) * b for a, b in ((x, x), (x, y), (y, y))], x, y, weight)
    more = _DAMPING * (xx + yy) + _FLAT
    xx, yy = xx + more, yy + more
    over = 1 / (xx * yy - xy * xy)
    return Patches(grey, weighed(x, weight), weighed(y, weight), weight, count, (yy * over, -xy * over, xx * over))


class Second(NamedTuple):
    """The second image with a margin, as pixels, its size, and where the patches begin in the first."""

    pixels: Float[Array, "m 1"]
    stride: int
    size: Size


def second_image(image: Float[Array, "h w"], stride: int) -> Second:
    """The second image as patches are fetched from it: with its edge repeated."""
    size = image.shape[0], image.shape[1]
    return Second(jnp.pad(image, PATCH, mode="edge").reshape(-1, 1), stride, size)


def _fetch(second: Second, x, y):
    """The 9 x 9 pixels `[9, 9, N]` under each patch at its displacement, and the fractions beyond them.

    A patch is held to where it overlaps the frame's edge, repeated, by a pixel; the derivative beyond is 0.
    """
    height, width = second.size
    rows, columns = grid(second.size, second.stride)
    row, column = (
        np.repeat(np.arange(rows), columns) * second.stride,
        np.tile(np.arange(columns), rows) * second.stride,
    )
    x = jnp.clip(jnp.asarray(column, x.dtype) + x, 1 - PATCH, width - 1)
    y = jnp.clip(jnp.asarray(row, y.dtype) + y, 1 - PATCH, height - 1)
    left, top = (jnp.floor(jax.lax.stop_gradient(a)) for a in (x, y))
    line = width + 2 * PATCH
    index = (top.astype(jnp.int32) + PATCH) * line + left.astype(jnp.int32) + PATCH
    offsets = np.add.outer(np.arange(PATCH + 1) * line, np.arange(PATCH + 1)).reshape(-1)
    last = (height + 2 * PATCH) * line - 1  # at the lower right end a tap has no weight, and may be any pixel
    taps = jax.lax.map(
        lambda offset: take_rows(second.pixels, jnp.minimum(index + offset, last))[..., 0],
        jnp.asarray(offsets, jnp.int32),
        batch_size=PATCH + 1,
    )
    return taps.reshape(PATCH + 1, PATCH + 1, -1), x - left, y - top


def _compare(kept: Patches, second: Second, x, y):
    """The residual's products with the gradient, and its sum of squares without its mean, at a displacement."""
    taps, tx, ty = _fetch(second, x, y)

    def row(sums, given):
        upper, lower, grey, gx, gy, weight = given
        slope, errors = sums
        for i in range(PATCH):
            above, below = ((1 - tx) * a[i] + tx * a[i + 1] for a in (upper, lower))
            apart = (1 - ty) * above + ty * below - grey[i]
            slope = slope + jax.lax.complex(gx[i] * apart, gy[i] * apart)
            weighed = apart if weight is None else apart * weight[i]
            errors = errors + jax.lax.complex(weighed * apart, weighed)
        return (slope, errors), None

    zero = jax.lax.complex(jnp.zeros_like(x), jnp.zeros_like(x))
    given = (taps[:-1], taps[1:], kept.grey, kept.x, kept.y, kept.weight)
    (slope, errors), _ = jax.lax.scan(row, (zero, zero), given)
    return slope, jnp.real(errors) - divide(jnp.square(jnp.imag(errors)), kept.total)


def search(
    kept: Patches,
    second: Second,
    start: tuple[Array, Array],
    *,
    steps: int,
    turns: int,
) -> tuple[Array, Array]:
    """The displacement at which each patch looks most like the second image, from a start `[N]` for x and y.

    Gauss-Newton steps with the gradient of the first image, which stays (inverse search); a step that makes a patch
    less like is not taken, and the next is half as long. After `steps` of these, in each of some `turns`,
    each patch tries its four neighbours' displacements, and steps on from there. What ends
    further than a patch's size from its start goes back there.
    """

    rows, columns = grid(second.size, second.stride)
    number = np.pad(np.arange(rows * columns).reshape(rows, columns), 1, mode="edge")
    around = [number[1 + j : 1 + j + rows, 1 + i : 1 + i + columns].reshape(-1) for j, i in _AROUND]
    around = jnp.asarray(np.stack(around), jnp.int32)

    def consider(found: Found, neighbour):
        """Another displacement: that of a neighbour, or a step further where that is -1."""
        asked = neighbour >= 0
        index = jax.lax.dynamic_index_in_dim(around, jnp.maximum(neighbour, 0), keepdims=False)
        theirs = (take_rows(a[:, None], index)[..., 0] for a in (found.x, found.y))
        xx, xy, yy = kept.inverse
        bx, by = jnp.real(found.slope), jnp.imag(found.slope)
        ours = found.x - found.step * (xx * bx + xy * by), found.y - found.step * (xy * bx + yy * by)
        x, y = (jnp.where(asked, a, b) for a, b in zip(theirs, ours, strict=True))
        slope, error = _compare(kept, second, x, y)
        better = error < found.error
        step = jnp.where(better, jnp.where(asked, 1, jnp.minimum(1, 2 * found.step)), found.step)
        new = Found(x, y, slope, error, jnp.where(better | asked, step, 0.5 * step))
        return Found(*(jnp.where(better, a, b) for a, b in zip(new, found, strict=True)))._replace(step=new.step), None

    zero = jnp.zeros_like(start[0])
    found = Found(*start, jax.lax.complex(zero, zero), zero + jnp.inf, zero + 1)
    order = [-1] * (1 + steps) + turns * [*range(len(_AROUND)), *[-1] * steps]  # the first is at the start
    found, _ = jax.lax.scan(consider, found, jnp.asarray(order, jnp.int32))
    near = jnp.square(found.x - start[0]) + jnp.square(found.y - start[1]) <= PATCH**2
    return jnp.where(near, found.x, start[0]), jnp.where(near, found.y, start[1])


_AROUND = ((0, -1), (-1, 0), (0, 1), (1, 0))


def densify(
    kept: Patches, second: Second, x: Float[Array, " n"], y: Float[Array, " n"], otherwise: Complex[Array, "h w"]
) -> Complex[Array, "h w"]:
    """Each pixel's mean of the displacements of its patches, weighted with 1 / max(1, |residual|) in grey levels.

    Where all its patches have no weight it keeps `otherwise`.
    """
    taps, tx, ty = _fetch(second, x, y)

    def row(given):
        upper, lower, grey, weight = given
        above, below = ((1 - tx)[None] * a[:-1] + tx[None] * a[1:] for a in (upper, lower))
        apart = (1 - ty)[None] * above + ty[None] * below - grey
        like = 1 / jnp.maximum(1, jnp.abs(apart))
        return like if weight is None else like * weight

    weights = jax.lax.map(row, (taps[:-1], taps[1:], kept.grey, kept.weight))
    stride = second.stride
    rows, columns = grid(second.size, stride)
    more = (PATCH - 1) // stride
    margin = ((more, more), (more, more))
    weights = jnp.pad(weights.reshape(PATCH, PATCH, rows, columns), ((0, 0), (0, 0), *margin))
    x, y = (once(jnp.pad(a.reshape(rows, columns), margin)) for a in (x, y))
    tall, wide = rows + more, columns + more

    def phase(j, i):
        """Pixels (stride k + j, stride l + i), which patches (k - a, l - b) reach with their pixels further on."""
        terms, counts = [], []
        for a in range((PATCH - 1 - j) // stride + 1):
            for b in range((PATCH - 1 - i) // stride + 1):
                there = slice(more - a, more - a + tall), slice(more - b, more - b + wide)
                weight = weights[j + a * stride, i + b * stride][there]
                terms.append(jax.lax.complex(weight * x[there], weight * y[there]))
                counts.append(weight)
        total, count = (reduce(operator.add, a) for a in (terms, counts))
        over = divide(1, count)
        return jax.lax.complex(jnp.real(total) * over, jnp.imag(total) * over), count

    phases = [[phase(j, i) for i in range(stride)] for j in range(stride)]

    def joined(part):
        laid = jnp.stack([jnp.stack([p[part] for p in line]) for line in phases])
        laid = laid.transpose(2, 0, 3, 1).reshape(tall * stride, wide * stride)
        return laid[: second.size[0], : second.size[1]]

    flow = joined(0)
    return flow if kept.weight is None else jnp.where(joined(1) > 0, flow, otherwise)
