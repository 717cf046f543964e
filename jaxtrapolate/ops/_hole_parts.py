"""What the tests behind the hole masks share, whichever taps they look at."""

from functools import reduce
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxtrapolate.ops.depth import surface_depth
from jaxtrapolate.ops.warp import inside, landing, root
from jaxtrapolate.precision import divide
from jaxtrapolate.records import GBuffer

_LONGEST = 1e15  # the square of a normal's component is finite
PER_DEPTH = 1e-3  # of the depth, in the position's threshold without a unit
_ALIKE = 3.0  # times as far apart neighbouring steps along one surface may be


class Pair(NamedTuple):
    """Two G-buffers and where the target's pixels land in the source: x, y `[H, W]`; outside, bool `[H, W, 1]`."""

    target: GBuffer
    source: GBuffer
    x: Array
    y: Array
    outside: Array

    def both(self, name: str) -> bool:
        """Whether a buffer is there in both."""
        return getattr(self.target, name) is not None and getattr(self.source, name) is not None


def pair_of(target: GBuffer, source: GBuffer, motion: Array) -> Pair:
    """The `Pair` of two G-buffers and the motion between them."""
    x, y, finite = landing(motion)
    return Pair(target, source, x, y, ~(finite & inside(x, y, *motion.shape[:2]))[..., None])


def channels(image: Array) -> list[Array]:
    """Each channel `[H, W, 1]`: sums over three of them are written out, because XLA's loops over three are slow."""
    return [image[..., k : k + 1] for k in range(image.shape[-1])]


def _product(a: list[Array], b: list[Array]) -> Array:
    return reduce(jnp.add, (x * y for x, y in zip(a, b, strict=True)))


def dot(a: Array, b: Array) -> Array:
    """The inner product over channels, `[H, W, 1]`."""
    return _product(channels(a), channels(b))


def _scaled(vector: list[Array]) -> list[Array]:
    """Divided by the largest component, held fixed, so that no square over- or underflows."""
    size = divide(1, jax.lax.stop_gradient(reduce(jnp.maximum, map(jnp.abs, vector))))
    return [component * size for component in vector]


def softened(excess: Array, softness: Any) -> Array:
    """A sigmoid, 0.5 at excess 0; excess is relative to the threshold."""
    return jax.nn.sigmoid(excess / jnp.asarray(softness, excess.dtype))


def cosine(target: Array, warped: Array, *, unit: bool) -> tuple[Array, Array]:
    """The cosine of two normals, and whether one of them is there; unit: they are scaled to length 1 before.

    Not scaled, components beyond 1e15 are held there.
    """
    if unit:
        first, second = _scaled(channels(target)), _scaled(channels(warped))
    else:
        first, second = ([jnp.clip(c, -_LONGEST, _LONGEST) for c in channels(n)] for n in (target, warped))
    here, there = _product(first, first), _product(second, second)
    product = _product(first, second)
    return divide(product, root(here * there)) if unit else product, (here > 0) | (there > 0)


def normal_mask(cosine: Array, concerned: Array, threshold: Any, softness: Any | None) -> Array:
    """Where the cosine of the normals is below the threshold (eq. 9)."""
    least = jnp.asarray(threshold, cosine.dtype)
    if softness is None:
        return concerned & (cosine < least)
    return jnp.where(concerned, softened((least - cosine) / (1 - least), softness), 0)


def footprint(position: Array, bare: Array | None) -> Array:
    """The distance of each pixel's position to the nearer of its neighbours, the larger one of the two axes.

    But no more than three times the smallest step within two pixels along the axis: both neighbours of what is one
    pixel wide lie on another surface, and the distance to them is the very gap that is looked for. A neighbour that
    shows nothing, or whose position is not finite, does not count; 0 without neighbours.
    """
    result = None
    known = dot(position, position) < jnp.inf
    known = known if bare is None else known & ~bare
    position = jnp.where(known, position, 0)
    for axis in (0, 1):
        if position.shape[axis] == 1:
            continue
        step = jnp.diff(position, axis=axis)
        whole = [jax.lax.slice_in_dim(known, k, known.shape[axis] - 1 + k, axis=axis) for k in (0, 1)]
        squared = jnp.where(whole[0] & whole[1], dot(step, step), jnp.inf)
        padding = [(0, 0)] * squared.ndim
        padding[axis] = (2, 2)
        padded = jnp.pad(squared, padding, constant_values=jnp.inf)
        steps = [jax.lax.slice_in_dim(padded, k, known.shape[axis] + k, axis=axis) for k in range(4)]
        nearer, smallest = jnp.minimum(steps[1], steps[2]), jnp.minimum(steps[0], steps[3])
        nearer = jnp.minimum(nearer, _ALIKE**2 * jnp.minimum(nearer, smallest))
        nearer = jnp.where(nearer < jnp.inf, nearer, 0)
        result = nearer if result is None else jnp.maximum(result, nearer)
    return jnp.zeros_like(position[..., :1]) if result is None else root(result)


def position_limit(pair: Pair, bare: Array | None, threshold: Any) -> Array:
    """How far apart two positions may be and count as one, `[H, W, 1]`; see `hole_masks` for the threshold."""
    target = pair.target
    position = cast(Array, target.position)
    if isinstance(threshold, tuple):
        facing, grazing, per_depth = (jnp.asarray(a, position.dtype) for a in threshold)
        n_dot_v = 1.0 if target.n_dot_v is None else jnp.abs(target.n_dot_v)
        limit = facing * n_dot_v + grazing * (1 - n_dot_v) + jnp.zeros(pair.outside.shape, position.dtype)
    else:
        limit = footprint(position, bare)
        limit, per_depth = jnp.asarray(threshold, limit.dtype) * limit, PER_DEPTH
    if target.depth is not None:
        whole = surface_depth(target.depth, target.sky)
        whole = jnp.where(jnp.isfinite(whole), whole, 0)
        limit = limit + per_depth * whole
    return limit


def squared_distance(position: Array, other: Array) -> Array:
    """Between two positions, infinite where one of them is not finite."""
    known = dot(other, other) + dot(position, position) < jnp.inf
    apart = jnp.where(known, other - position, 0)
    return jnp.where(known, dot(apart, apart), jnp.inf)


def position_mask(farthest: Array, limit: Array, concerned: Array, softness: Any | None) -> Array:
    """Where the farthest tap's position, by its squared distance, is beyond the limit (eq. 10)."""
    if softness is None:
        return concerned & ~((farthest <= jnp.square(limit)) & (farthest < jnp.inf))
    limit = jnp.where(limit > 0, limit, jnp.finfo(limit.dtype).tiny)
    distance = root(jnp.where(jnp.isfinite(farthest), farthest, 0))
    excess = jnp.where(jnp.isfinite(farthest), distance / limit - 1, 1e6)
    return jnp.where(concerned, softened(excess, softness), 0)
