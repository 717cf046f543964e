"""What is trained: the protocol that the loop speaks, and the tasks by name.

The loop knows no network, no loss and no data. A task gives them as pure functions, so that a run is determined by its
configuration: the pool of a round by (seed, round), the batch of a step by (seed, step). Resuming needs no state of the
data; the round's pool is generated again.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

import jax
from flax import nnx
from jaxtyping import Array, Float, PRNGKeyArray

Example = Any
"""A pytree of arrays: what a pool holds of one example."""

Batch = Any
"""A pytree of arrays with a leading axis: items that `Task.sample` cut from examples."""


@runtime_checkable
class Task(Protocol):
    """What `train_and_evaluate` trains.

    Attributes:
        score: name of the metric of `validate` by which the best checkpoint is told; larger is better.
        adapts: names in `about["config"]`, as "network.guess", that weights to start from need not share, as how inputs
            are prepared. Inputs that they do not know come last, and count for nothing at first. May be absent: none.
        about: what the exported weights say about themselves, as in JSON: "method", "config" to build its network with,
            "note".

    A task that learns from frames in files has them in an attribute `sequences`: a run does not go on where they have
    changed.
    """

    score: str
    about: Mapping[str, Any]

    def init(self, rngs: nnx.Rngs) -> nnx.Module:
        """The network with its initial weights.

        Its `nnx.Param` are trained; `nnx.BatchStat` are averaged along with them; whatever else it holds is carried
        from step to step. It computes in the dtype of its kernels, which is how `precision` asks for bfloat16.
        """
        ...

    def pool(self, key: PRNGKeyArray, numbers: range) -> Example:
        """The examples `numbers` of the pool that a key stands for, stacked along a leading axis, on local devices.

        Example i depends on the key and on i alone: with several hosts each generates its own part.
        """
        ...

    def sample(self, example: Example, key: PRNGKeyArray) -> Batch:
        """An item for a batch, cut at random from an example: pure and traced; the loop maps it over a batch."""
        ...

    def loss(self, model: nnx.Module, batch: Batch) -> tuple[Float[Array, ""], Mapping[str, Float[Array, ""]]]:
        """The mean loss over a batch, and scalars to be logged; traced. The model is in training mode.

        The batch is divided over the devices along its leading axis, and the means are those of all of it, also in
        batch norm.
        """
        ...

    def validate(self, model: nnx.Module) -> tuple[Mapping[str, float], Mapping[str, Any]]:
        """Scores of the (averaged) weights on data that training does not see, and images `[H, W, 3]` in 0..1, by name.

        Not traced. The model is in evaluation mode, and its arrays are good until this returns.
        """
        ...


@dataclasses.dataclass(frozen=True)
class Entry:
    """A task by name: the frozen dataclass of its options, and how it is built from them."""

    options: type
    make: Callable[[Any], Task]


TASKS: dict[str, Entry] = {}
"""The tasks by name."""


def find_task(name: str) -> Entry:
    """The entry of a task; `ValueError` with the names there are where there is none."""
    if name not in TASKS:
        raise ValueError(f"task: no task {name!r}; there are {', '.join(map(repr, TASKS)) or 'none'}")
    return TASKS[name]


def round_key(seed: int, number: int) -> PRNGKeyArray:
    """The key of a round's pool."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 1), number)


def step_key(seed: int, number: Any) -> PRNGKeyArray:
    """The key of a step's batch; `number` may be traced."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 2), number)


def init_key(seed: int) -> PRNGKeyArray:
    """The key of the initial weights."""
    return jax.random.fold_in(jax.random.key(seed), 0)
