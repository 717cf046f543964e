"""What a network may say: corrections that its inputs can explain, and nothing at all where nothing changes.

A convolution answers to contrast in proportion, so that beside a lamp brighter than any it was trained on its answer
rings, over surfaces that all its inputs agree on.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

GAIN = 2.0
TOLERANCE = 0.02
CONTRADICTED = 2.0  # of logarithms: light that is seven times another
_TILE = 16  # pixels
_RINGS = 4  # pixels


def _widened(image: Float[Array, "h w 1"], reach: int = 1) -> Float[Array, "h w 1"]:
    """The largest value among a pixel and those up to `reach` from it, by default its eight neighbours."""
    size = 2 * reach + 1
    return jax.lax.reduce_window(image, -jnp.inf, jax.lax.max, (size, size, 1), (1, 1, 1), "SAME")


def explained(
    correction: Float[Array, "h w c"],
    inputs: Sequence[Float[Array, "h w c"]],
    *,
    shown: Callable[[Array], Array] = lambda image: image,
    free: Bool[Array, "h w 1"] | None = None,
) -> Float[Array, "h w c"]:
    """A network's correction, held within what its inputs differ by around a pixel.

    At most `GAIN` times the largest difference between two inputs among a pixel and its eight neighbours, plus
    `TOLERANCE`: where shading moves, the inputs differ, and where they agree there is nothing to correct. Up to 4
    pixels from a difference of `CONTRADICTED` less, and of twice that `TOLERANCE` alone: no shading differs so much,
    one of the inputs shows a lamp where another does not, and the answer rings around it. That is asked of what is
    `shown`: light that was divided by next to no reflectance is bright, and still no lamp.

    Args:
        correction: what is added to a first guess, in the domain of the inputs: logarithms, or display values.
        inputs: images of what the network was shown, all on the target's grid; finite.
        shown: from an input to what would be displayed, modulated, in the same domain, and growing with it.
        free: where it is not held: holes, of which the inputs show nothing.

    Gradient:
        With respect to the correction where it is not held, and with respect to the inputs where it is.
    """
    stacked = jnp.stack([image.astype(correction.dtype) for image in inputs])
    most, least = jnp.max(stacked, 0), jnp.min(stacked, 0)
    spread, contradiction = (jnp.max(a - b, -1, keepdims=True) for a, b in ((most, least), (shown(most), shown(least))))
    believed = jnp.clip(2 - _widened(contradiction, _RINGS) / CONTRADICTED, 0, 1)
    limit = GAIN * _widened(spread) * believed + TOLERANCE
    held = jnp.where(correction > limit, limit, jnp.where(correction < -limit, -limit, correction))
    return held if free is None else jnp.where(free, correction, held)


def standing(images: Sequence[Float[Array, "h w c"]], *motions: Float[Array, "h w 2"]) -> Bool[Array, "h w 1"]:
    """Where all images are equal and nothing moves: there the answer is known.

    By tiles of 16 x 16 pixels, each with the eight around it: light that moves over what lies still enters a tile from
    beside it. Pixels that are not finite do not stand still.
    """
    first, *others = images
    changed = ~jnp.all(jnp.isfinite(first), -1)
    for differs in (*(image != first for image in others), *(motion != 0 for motion in motions)):
        changed |= jnp.any(differs, -1)
    height, width = changed.shape
    rows, columns = -(-height // _TILE), -(-width // _TILE)
    padded = jnp.pad(changed, ((0, rows * _TILE - height), (0, columns * _TILE - width)))
    tiles = jnp.any(padded.reshape(rows, _TILE, columns, _TILE), (1, 3)).astype(first.dtype)
    tiles = _widened(tiles[..., None]) > 0.5
    return ~jnp.repeat(jnp.repeat(tiles, _TILE, 0), _TILE, 1)[:height, :width]
