"""A small task for tests of the training loop: a linear map of pixels, whose answer is known, after batch norm."""

import dataclasses
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from jaxtrapolate.training import TASKS, Entry
from jaxtrapolate.training.augment import crop

MAP = np.array([[1.0, -2.0], [0.5, 0.25], [-1.5, 1.0]])
SHIFT = np.array([0.3, -0.7])


@dataclasses.dataclass(frozen=True)
class ToyOptions:
    """norm: batch norm. wobble: how much the output depends on how often the network was called while training.

    poison: number of the example of a pool that is not finite, -1 for none.
    """

    crop: tuple[int, int] = (5, 3)
    norm: bool = True
    wobble: float = 0.0
    poison: int = -1


class Count(nnx.Variable):
    """How often a network was called."""


class Net(nnx.Module):
    """Batch norm and a linear map, with a count and random keys besides."""

    def __init__(self, options, rngs):
        self.wobble, self.calls, self.deterministic = options.wobble, Count(jnp.zeros((), jnp.float32)), False
        self.dropout = nnx.Dropout(0.0, rngs=rngs)
        self.norm = nnx.data(nnx.BatchNorm(3, momentum=0.9, rngs=rngs) if options.norm else None)
        self.map = nnx.Linear(3, 2, rngs=rngs)

    def __call__(self, x):
        x = self.dropout(x)
        if not self.deterministic:
            self.calls[...] = self.calls[...] + 1
            x = x * (1 + self.wobble * jnp.sin(self.calls[...]))
        x = x if self.norm is None else self.norm(x)
        return self.map(x.astype(self.map.kernel.dtype))


class ToyTask:
    """Random images and their linear map."""

    score = "negative"
    about = MappingProxyType({"method": "toy", "config": {}, "note": "for tests"})

    def __init__(self, options=None):
        self.options, self.asked = options or ToyOptions(), []

    def init(self, rngs):
        return Net(self.options, rngs)

    def pool(self, key, numbers):
        self.asked.append(numbers)
        keys = [np.asarray(jax.random.key_data(jax.random.fold_in(key, i))) for i in numbers]
        x = np.stack([np.random.default_rng(k.tolist()).random((8, 7, 3), np.float32) for k in keys])
        y = (x @ MAP + SHIFT).astype(np.float32)
        if self.options.poison in numbers:
            y[self.options.poison - numbers.start] = np.nan
        return {"x": jnp.asarray(x), "y": jnp.asarray(y)}

    def sample(self, example, key):
        return crop(example, key, size=self.options.crop)

    def loss(self, model, batch):
        error = model(batch["x"]).astype(jnp.float32) - batch["y"]
        return jnp.mean(error**2), {"largest": jnp.max(jnp.abs(error))}

    def validate(self, model):
        example = self.pool(jax.random.key(2**31), range(2))
        error = np.asarray(model(example["x"]) - example["y"])
        return {"negative": -float(np.mean(error**2))}, {"error": np.abs(error[0, ..., :1]).repeat(3, -1)}


TASKS.setdefault("toy", Entry(ToyOptions, ToyTask))
