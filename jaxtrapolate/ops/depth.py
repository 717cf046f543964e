"""Depth where no surface was hit: it is far, whatever a renderer stores there.

Renderers mark what they did not hit in their own ways: infinite depth, a huge one, 0, -1, or a mask of the sky; and
what lies outside a crop is 0 as well. Taken literally, 0 and -1 would be nearer than everything. So all that reads a
depth reads it through `surface_depth`: nothing is at +inf, behind every surface and as far as all other nothing.

Arithmetic with it needs care, because inf - inf and 0 * inf are NaN, and so are derivatives through them: the other
functions here are what the library compares, moves and interpolates such depths with.

A NaN is not nothing: there the depth is unknown. It stays NaN, and each function says what it does with it; in none
does it hide or win anything.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrapolate.checks import ArrayLike, check_image
from jaxtrapolate.precision import divide, widest
from jaxtrapolate.records import Frame, Keyframe, replace

_HELD = 1e30  # in place of infinity
_MIXED = 1e20  # no surface is that far


def surface_depth(
    depth: Float[ArrayLike, "h w 1"], sky: Float[ArrayLike, "h w 1"] | None = None
) -> Float[Array, "h w 1"]:
    """The depth, +inf where nothing was hit: where it is not positive, or the sky's mask is above 0.5.

    Args:
        depth: `[H, W, 1]`, larger is farther, metric or ordinal; surfaces are positive.
        sky: `[H, W, 1]`, 1 where no surface was hit.

    Returns:
        `[H, W, 1]` of the dtype of `depth`. A NaN stays NaN, but under the sky.

    Gradient:
        With respect to depth: 1 at surfaces, 0 where nothing was hit.

    Raises:
        TypeError, ValueError: no floating-point array, or a shape that does not fit.
    """
    size = check_image("depth", depth, channels=1)
    bare = depth <= 0
    if sky is not None:
        check_image("sky", sky, size=size, channels=1)
        bare = bare | (sky > 0.5)
    return jnp.where(bare, jnp.inf, depth)


def nothing(depth: Float[ArrayLike, "h w 1"]) -> Bool[Array, "h w 1"]:
    """Where a depth says that no surface was hit: not positive, or +inf."""
    depth = jnp.asarray(depth)
    return (depth <= 0) | (depth == jnp.inf)


def surfaces(frame: Frame) -> Frame:
    """A frame with `surface_depth`; without depth the frame itself."""
    buffers = frame.gbuffer
    if buffers is None or buffers.depth is None:
        return frame
    return replace(frame, gbuffer=replace(buffers, depth=surface_depth(jnp.asarray(buffers.depth), buffers.sky)))


def surfaces_of(keyframe: Keyframe, frame: Frame | None = None) -> Keyframe:
    """A keyframe with `surface_depth`, by the sky of its frame if that has any; without depth the keyframe itself."""
    if keyframe.depth is None:
        return keyframe
    sky = None if frame is None or frame.gbuffer is None else frame.gbuffer.sky
    return replace(keyframe, depth=surface_depth(jnp.asarray(keyframe.depth), sky))


def changed(depth: Array, change: Array) -> Array:
    """depth + change, where infinite depth stays so, whatever its change: what is far stays far."""
    return depth + jnp.where(depth == jnp.inf, 0, change)


def apart(first: Array, second: Array) -> Array:
    """How unlike two depths are: |first - second|, 0 where both are infinite.

    Where one is, more than any two surfaces, and the less the farther the other is: 1e30 / other. No gradient.
    """
    wide = widest(first, second)
    first, second = jax.lax.stop_gradient(tuple(held(a.astype(wide)) for a in (first, second)))
    near = jnp.minimum(first, second)
    one = (first < _HELD) != (second < _HELD)
    return jnp.where(one, divide(_HELD, near, otherwise=_HELD), jnp.abs(first - second))


def held(depth: Array) -> Array:
    """The depth in at least float32, and at most 1e30: that stands for infinity where depths are interpolated.

    Of a bilinear mixture of nothing and a surface it keeps how much of it is nothing, and its derivatives are finite.
    """
    return jnp.minimum(depth.astype(widest(depth)), _HELD)


def released(depth: Array) -> Array:
    """Infinite again where `held` depth is, or a mixture with it."""
    return jnp.where(depth > _MIXED, jnp.inf, depth)


__all__ = ["apart", "changed", "held", "nothing", "released", "surface_depth", "surfaces", "surfaces_of"]
