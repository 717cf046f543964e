"""In which space colours are fetched between pixels: an option of every method that fetches any.

A mean of a bright and a dark pixel is bright in linear light; after a tone curve it looks like what is between the two.
"""

from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.checks import ArrayLike
from jaxtrapolate.methods.options import option
from jaxtrapolate.ops.radiance import compress, expand
from jaxtrapolate.precision import widest

Space = Literal["linear", "log", "tone"]
"""Linear light; its logarithm log(1 + x); or sqrt(x / (1 + x)), `compress`, near a display's tone curve."""


def space(default: Space = "tone") -> Any:
    """The option; its default is measured in experiments/space.py."""
    return option(default, "in which colours are fetched between pixels", choices=Space)


@jax.custom_jvp
def _at_most(values: Array, most: Array) -> Array:
    """The smaller of both; the derivative is that of the values, which only rounding makes the larger."""
    return jnp.minimum(values, most)


@_at_most.defjvp
def _at_most_jvp(primals: Any, tangents: Any) -> Any:
    return _at_most(*primals), tangents[0]


def in_space(space: Space, fetch: Callable[[Array], Array], image: Float[ArrayLike, "h w c"]) -> Float[Array, "i j d"]:
    """What `fetch` takes from an image, whose values it mixes in another space.

    A pixel that is fetched unmixed from its own place is its value bit for bit. In another space than linear light
    negative values are mixed as mirrored ones, and no magnitude exceeds the image's largest; what is not finite stays
    as in linear light.

    Args:
        space: see `Space`.
        fetch: from an image to an image, whose last channels are the colours.
        image: linear light `[H, W, C]`.
    """
    color = jnp.asarray(image)
    if space == "linear":
        return fetch(color)
    wide = color.astype(widest(color))
    known = jnp.isfinite(wide)
    usual = jnp.where(known, jnp.abs(wide), 0)
    curve, inverse = (compress, expand) if space == "tone" else (jnp.log1p, jnp.expm1)
    encoded = jnp.where(known, jnp.sign(wide) * curve(usual), wide)
    found = fetch(encoded)
    rest, answer = jnp.split(found, [found.shape[-1] - color.shape[-1]], -1)
    decoded = jnp.sign(answer) * _at_most(inverse(jnp.abs(answer)), jnp.max(usual))
    if answer.shape == encoded.shape:
        decoded = jnp.where(answer == encoded, wide, decoded)
    decoded = jnp.where(jnp.isfinite(answer), decoded, answer).astype(color.dtype)
    return jnp.concatenate([rest.astype(color.dtype), decoded], -1)
