"""Inference: batch norms folded into the convolutions, and a model as a pure function of its state."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from flax import nnx

from jaxtrapolate.networks.blocks import Layer

M = TypeVar("M", bound=nnx.Module)


def fold(model: M) -> M:
    """A copy of a model in which each `Layer`'s batch norm is part of its convolution, by its running statistics.

    Equal to the model in evaluation up to rounding. Behind a gate the norm's factor goes into the feature convolution,
    its offset remains as one sum.
    """
    model = nnx.clone(model)
    model.eval()
    for _, module in nnx.iter_modules(model):
        if isinstance(module, Layer):
            module.fold()
    return model


def inference(model: nnx.Module, *, dtype: Any = jnp.float32) -> tuple[Callable[..., Any], Any]:
    """A model in evaluation as a pure function: `function(state, *inputs)` is the result of one frame.

    Args:
        model: built of `Layer`s, whose batch norms are folded, see `fold`.
        dtype: of the weights, and so of all that is computed by them. What a model corrects (the warped image in
            `ExtraNet`) stays in the dtype of the inputs: give them in float32.

    Returns:
        `function`, jitted, differentiable in the state and the inputs, takes and returns arrays without the leading
        batch axis: `[H, W, C]`, histories `[N, H, W, C]`; map it over batches by `vmap`. `state`: nested dicts of
        arrays.

    Precision:
        Of ExtraNet with the authors' weights against their own results in float32, two frames of 64 x 96 and 72 x 40
        with values in -1.1..2.3, on a CPU: the largest error is 2e-6 in float32, 6e-3 in float16 (root mean square
        7.5e-4) and 5.2e-2 in bfloat16 (6.6e-3).
    """
    structure, state = nnx.split(fold(model))
    weights = jax.tree.map(lambda a: a.astype(dtype), nnx.to_pure_dict(state))

    @jax.jit
    def function(state, *inputs):
        batched = jax.tree.map(lambda a: a[None], inputs)
        return jax.tree.map(lambda a: a[0], nnx.merge(structure, state)(*batched))

    return function, weights
