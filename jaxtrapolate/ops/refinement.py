"""Variational refinement of a flow (Brox et al. 2004; Kroeger et al. 2016, section 2.3).

A flow is a complex array here, x + i y: XLA makes both at once.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from jaxtrapolate.ops.patches import gradient
from jaxtrapolate.ops.resample import fetch
from jaxtrapolate.ops.strips import once
from jaxtrapolate.ops.warp import pixel_grid

_ALPHA, _DELTA, _GAMMA = 20.0, 5.0, 10.0  # smoothness, constancy of grey levels, of their gradient
_ZETA = 0.1**2  # squared grey levels: a gradient of this little says nothing
_EPSILON = 0.001**2  # of the penalty sqrt(s^2 + epsilon^2)
_RELAXATION = 1.6


class _Terms(NamedTuple):
    """Grey levels' and gradients' differences at the start, and the derivatives that change them."""

    t: Array
    x: Array
    y: Array
    tx: Array
    ty: Array
    xx: Array
    xy: Array
    yy: Array


class Weights(NamedTuple):
    """What counts in a refinement: pixels `[H, W]`, and neighbours to the right and below of each pixel."""

    pixels: Float[Array, "h w"]
    right: Float[Array, "h w"]
    below: Float[Array, "h w"]


def _terms(first, second, flow) -> _Terms:
    height, width = first.shape
    columns, rows = pixel_grid(height, width, first.dtype)
    warped = fetch(second, columns + jnp.real(flow), rows + jnp.imag(flow))
    mean, change = once(((first + warped) * 0.5, warped - first))
    x, y, tx, ty = once([gradient(a, axis) for a in (mean, change) for axis in (1, 0)])
    return _Terms(change, x, y, tx, ty, *once((gradient(x, 1), gradient(x, 0), gradient(y, 0))))


def shifted(a, axis, by):
    """a[p - by] along an axis, 0 beyond the edge."""
    size = a.shape[axis]
    padding = [(0, 0), (0, 0)]
    padding[axis] = (by, 0) if by > 0 else (0, -by)
    start = 0 if by > 0 else -by
    return jnp.pad(jax.lax.slice_in_dim(a, start, start + size - abs(by), axis=axis), padding)


def _penalty(square):
    """The derivative of sqrt(s^2 + epsilon^2) over s, of s^2."""
    return jax.lax.rsqrt(square + _EPSILON)


def _smoothness(flow, weights):
    """What the four neighbours of each pixel are weighted with: left, right, above, below."""
    differences = [shifted(flow, axis, -1) - flow for axis in (1, 0)]
    height, width = flow.shape
    inner = [jnp.arange(n) < n - 1 for n in (width, height)]
    edges = [inner[0][None, :], inner[1][:, None]]
    squares = [
        jnp.where(edge, jnp.square(jnp.real(d)) + jnp.square(jnp.imag(d)), 0)
        for d, edge in zip(differences, edges, strict=True)
    ]
    strength = once(0.5 * _ALPHA * _penalty(squares[0] + squares[1]))
    right, below = (jnp.where(edge, strength, 0) for edge in edges)
    if weights is not None:
        right, below = right * weights.right, below * weights.below
    return shifted(right, 1, 1), right, shifted(below, 0, 1), below


def _data(terms: _Terms, step, weights):
    """The two constancies' equations for the step: a matrix's three entries, and the right side, complex."""
    u, v = jnp.real(step), jnp.imag(step)
    t, x, y, tx, ty, xx, xy, yy = terms
    norm = x * x + y * y + _ZETA
    grey = 0.5 * _DELTA * _penalty(jnp.square(t + x * u + y * v) / norm) / norm
    norm_x, norm_y = xx * xx + xy * xy + _ZETA, xy * xy + yy * yy + _ZETA
    apart_x, apart_y = tx + xx * u + xy * v, ty + xy * u + yy * v
    slope = 0.5 * _GAMMA * _penalty(jnp.square(apart_x) / norm_x + jnp.square(apart_y) / norm_y)
    if weights is not None:
        grey, slope = grey * weights.pixels, slope * weights.pixels
    grey, slope_x, slope_y = once((grey, slope / norm_x, slope / norm_y))
    a = grey * x * x + slope_x * xx * xx + slope_y * xy * xy + _ZETA
    b = grey * x * y + slope_x * xx * xy + slope_y * xy * yy
    c = grey * y * y + slope_x * xy * xy + slope_y * yy * yy + _ZETA
    right = jax.lax.complex(
        -(grey * x * t + slope_x * xx * tx + slope_y * xy * ty), -(grey * y * t + slope_x * xy * tx + slope_y * yy * ty)
    )
    return a, b, c, right


def _quarters(images):
    """Pixels of even and odd rows and columns, `[2, 2, images, ceil(h / 2), ceil(w / 2)]`; 0 beyond an odd edge."""
    height, width = images[0].shape
    stacked = jnp.pad(jnp.stack(images), ((0, 0), (0, height % 2), (0, width % 2)))
    return stacked.reshape(len(images), -(-height // 2), 2, -(-width // 2), 2).transpose(2, 4, 0, 1, 3)


def _whole(quarters, size):
    rows = [jnp.stack(line, -1).reshape(line[0].shape[0], -1) for line in quarters]
    return jnp.stack(rows, 1).reshape(-1, rows[0].shape[1])[: size[0], : size[1]]


def _relax(flow, inverse, right, around, sweeps):
    """Successive over-relaxation of inverse^-1 flow = right + sum over neighbours of weight * flow.

    Pixels are coloured like a chessboard: all of one colour are made from those of the other at once.
    """
    parts = _quarters([*inverse, jnp.real(right), jnp.imag(right), *around])
    state = _quarters([flow])[:, :, 0]

    def update(state, j, i):
        xx, xy, yy, given_x, given_y, left, right, above, below = parts[j, i]
        beside, over = state[j][1 - i], state[1 - j][i]
        # of an even column the left neighbour is the odd one before
        to_left, to_right = (shifted(beside, 1, 1), beside) if i == 0 else (beside, shifted(beside, 1, -1))
        up, down = (shifted(over, 0, 1), over) if j == 0 else (over, shifted(over, 0, -1))
        terms = ((left, to_left), (right, to_right), (above, up), (below, down))
        x = given_x + sum(w * jnp.real(z) for w, z in terms)
        y = given_y + sum(w * jnp.imag(z) for w, z in terms)
        old = state[j][i]
        state[j][i] = jax.lax.complex(
            jnp.real(old) + _RELAXATION * (xx * x + xy * y - jnp.real(old)),
            jnp.imag(old) + _RELAXATION * (xy * x + yy * y - jnp.imag(old)),
        )

    def sweep(state, _):
        state = [list(line) for line in state]
        for j, i in ((0, 0), (1, 1), (0, 1), (1, 0)):
            update(state, j, i)
        return state, None

    state, _ = jax.lax.scan(sweep, [list(line) for line in state], None, length=sweeps)
    return _whole(state, flow.shape)


def refine(
    first: Float[Array, "h w"],
    second: Float[Array, "h w"],
    flow: Complex[Array, "h w"],
    *,
    iterations: int,
    sweeps: int = 5,
    weights: Weights | None = None,
) -> Complex[Array, "h w"]:
    """The flow near a given one that keeps grey levels (0..255) and their gradients, and is smooth.

    Linearised once around the given flow; the penalties' weights are taken anew in each of `iterations`, the linear
    system solved by `sweeps` of over-relaxation.
    """
    terms = _terms(first, second, flow)
    start = flow

    def step(flow, _):
        a, b, c, right = _data(terms, flow - start, weights)
        around = _smoothness(flow, weights)
        total = around[0] + around[1] + around[2] + around[3]
        u, v = jnp.real(start), jnp.imag(start)
        right = right + jax.lax.complex(a * u + b * v, b * u + c * v)
        a, c = a + total, c + total
        over = 1 / (a * c - b * b)
        inverse = c * over, -b * over, a * over
        return _relax(flow, inverse, right, around, sweeps), None

    return jax.lax.scan(step, flow, None, length=iterations)[0]
