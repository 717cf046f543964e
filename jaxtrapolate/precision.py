"""The precision that coordinates and sums are taken in: at least float32, whatever the images are.

The library's results do not depend on JAX's settings of dtypes: float32 arrays give float32 ones, and the same values,
under `jax_enable_x64` as well, and nothing is promoted implicitly, so that `jax_numpy_dtype_promotion="strict"` and
`jax_numpy_rank_promotion="raise"` may be set.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

_DOUBLE = (np.dtype(np.float64), np.dtype(np.complex128))


def widest(*values: Any) -> np.dtype:
    """float64 where one of some arrays is and `jax_enable_x64` is set, else float32.

    `jnp.promote_types` is not for this: under strict promotion it refuses to compare float16 with float32.
    """
    double = any(value.dtype in _DOUBLE for value in values)
    return jax.dtypes.canonicalize_dtype(np.float64 if double else np.float32)


@jax.custom_jvp
def _quotient(numerator, denominator):
    return numerator / denominator


@_quotient.defjvp
def _quotient_jvp(primals, tangents):
    # JAX's own rule takes denominator^-2, which overflows from 5e-20 down, and is 0 from 2e19 up
    (numerator, denominator), (d_numerator, d_denominator) = primals, tangents
    value = _quotient(numerator, denominator)
    finite = jnp.where(jnp.isfinite(value), value, 0)  # one that is not has no slope, rather than one that spreads
    return value, _quotient(d_numerator - finite * d_denominator, denominator)


def divide(numerator: ArrayLike, denominator: Array, *, where: Array | None = None, otherwise: ArrayLike = 0) -> Array:
    """numerator / denominator where that is allowed, `otherwise` elsewhere; with finite derivatives in both.

    The derivative is right for denominators of any size whose reciprocal is finite.

    Args:
        numerator: broadcast against the denominator.
        denominator: mostly a sum of weights, a count or a length.
        where: bool; by default where the denominator is positive, so that 0 and NaN are not.
        otherwise: the value elsewhere, whose derivative counts there.
    """
    where = denominator > 0 if where is None else where
    # the inner `where` is for the derivative: that of the quotient at 0 is NaN, and 0 * NaN is no 0
    quotient = _quotient(jnp.asarray(numerator, denominator.dtype), jnp.where(where, denominator, 1))
    return jnp.where(where, quotient, otherwise)


def share(part: Array, rest: Array, *, otherwise: ArrayLike = 0) -> Array:
    """part^2 / (part^2 + rest^2) of numbers that are not negative; `otherwise` where both are 0.

    The smaller is divided by the larger before it is squared, so that no square over- or underflows.
    """
    larger = jnp.maximum(part, rest)
    # held fixed: a factor that numerator and denominator have in common has no part in the derivative
    part, rest = (divide(a, jax.lax.stop_gradient(larger)) for a in (part, rest))
    return divide(jnp.square(part), jnp.square(part) + jnp.square(rest), otherwise=otherwise)
