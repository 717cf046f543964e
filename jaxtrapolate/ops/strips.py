"""Work in strips of rows: on a CPU what one strip needs stays in the cache, and what XLA does not fuse costs little."""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

T = TypeVar("T")

_ROWS = 16


def rows_of(image: Array, top: Array | int, rows: int) -> Array:
    """Rows `top` to `top + rows` of an image."""
    return image if image.shape[0] == rows else jax.lax.dynamic_slice_in_dim(image, top, rows)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def by_strips(function: Callable[..., T], height: int, sources: Any) -> T:
    """function(sources, top, rows) for all rows 0 .. height: arrays `[height, ...]`; on a CPU strip by strip.

    The function computes rows top .. top + rows from any part of the sources, and must not close over traced values.
    Differentiated, it is called once for all rows: of strips each would have a gradient of the size of the sources.
    """

    def whole(sources):
        return function(sources, 0, height)

    def split(sources):
        part = jax.jit(partial(function, rows=_ROWS))  # traced once
        example = jax.eval_shape(part, sources, jnp.zeros((), jnp.int32))
        shapes, tree = jax.tree.flatten(example)
        # of different numbers: equal arrays would be allocated once and copied
        empty = tree.unflatten([jnp.full((height, *a.shape[1:]), k, a.dtype) for k, a in enumerate(shapes)])

        def step(number, result):
            top = jnp.minimum(number * _ROWS, height - _ROWS).astype(jnp.int32)  # the last one may repeat rows
            strip = part(sources, top)
            return jax.tree.map(lambda a, b: jax.lax.dynamic_update_slice_in_dim(a, b, top, 0), result, strip)

        return jax.lax.fori_loop(0, -(-height // _ROWS), step, empty)

    return whole(sources) if height <= _ROWS else jax.lax.platform_dependent(sources, cpu=split, default=whole)


@by_strips.defjvp
def _by_strips_jvp(function, height, primals, tangents):
    return jax.jvp(lambda sources: function(sources, 0, height), primals, tangents)


def once(values: T) -> T:
    """The value, or each of a tree, all of one axis or more, computed once.

    XLA on a CPU computes what several consumers read in each of them, and fuses a window with what it slides over; what
    a loop reads it computes before. So two numbers are put where they are, in a loop: one that puts what it has taken,
    or takes but one turn, XLA takes out.
    """
    return _once(values)


@jax.custom_jvp
def _once(values):
    def step(number, values):
        def put(value):
            place = (number, *[jnp.zeros_like(number)] * (value.ndim - 1))
            taken = jax.lax.dynamic_slice(value, place, (1,) * value.ndim)
            taken = jnp.where(number >= 0, taken, jnp.zeros_like(taken))  # always, but XLA does not see that
            return jax.lax.dynamic_update_slice(value, taken, place)

        return jax.tree.map(put, values)

    return jax.lax.platform_dependent(
        values, cpu=lambda values: jax.lax.fori_loop(0, 2, step, values), default=lambda values: values
    )


@_once.defjvp
def _once_jvp(primals, tangents):
    return _once(*primals), *tangents
