"""One step of training: what is carried from step to step, and the pure function that takes the next."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float, Int

from jaxtrapolate.errors import InputError
from jaxtrapolate.records import record, replace
from jaxtrapolate.training import devices
from jaxtrapolate.training.config import Config, Optimizer
from jaxtrapolate.training.tasks import Batch, Example, Task, init_key, step_key
from jaxtrapolate.weights import Weights, fit
from jaxtrapolate.weights.tree import named


@record
@dataclasses.dataclass(frozen=True)
class State:
    """What is carried from step to step, and saved.

    step: how many were taken. weights: the network's `nnx.Param`. statistics: its `nnx.BatchStat`. rest: what else it
    holds. moments: the optimiser's. average: running averages of (weights, statistics), `None` where not asked for.
    """

    step: Int[Array, ""]
    weights: Any
    statistics: Any
    rest: Any
    moments: Any
    average: Any


@dataclasses.dataclass(frozen=True)
class Step:
    """The functions of a run, built by `make_step`.

    Attributes:
        create: `() -> State`, the initial one.
        take: `(state, pool) -> (state, metrics)`, compiled; the old state's memory is given up. metrics are scalars on
            the devices: "loss", "gradient" (its norm, before clipping), "learning_rate", and the task's.
        batch: `(pool, number) -> batch` of the step with that number, as `take` cuts it.
        model: `(state) -> nnx.Module`, the averaged network in evaluation mode, on this host's first device.
    """

    create: Callable[[], State]
    take: Callable[[State, Example], tuple[State, dict[str, Array]]]
    batch: Callable[[Example, Any], Batch]
    model: Callable[[State], nnx.Module]


def schedule(optimizer: Optimizer, steps: int) -> optax.Schedule:
    """The learning rate by step, counted from 0."""
    height, rise, level = optimizer.peak_learning_rate, optimizer.warmup, optimizer.constant
    decay = optimizer.decay or max(1, steps - rise - level)
    fall = optax.cosine_decay_schedule(height, decay, alpha=optimizer.floor)
    rest = optax.join_schedules([optax.constant_schedule(height), fall], [level])
    return optax.join_schedules([optax.linear_schedule(0.0, height, rise), rest], [rise]) if rise else rest


def transformation(optimizer: Optimizer, steps: int) -> optax.GradientTransformation:
    """Clipping where asked for, then Adam with its schedule."""
    adam = optax.adamw(
        schedule(optimizer, steps),
        b1=optimizer.beta1,
        b2=optimizer.beta2,
        eps=optimizer.epsilon,
        weight_decay=optimizer.weight_decay,
    )
    return adam if optimizer.clip is None else optax.chain(optax.clip_by_global_norm(optimizer.clip), adam)


def _cast(tree: Any, precision: str) -> Any:
    """The weights in which the network computes."""
    dtype = jnp.dtype(precision)
    return jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, tree)


def _averaged(decay: float, count: Array, old: Any, new: Any) -> Any:
    """The running average after `count` steps; at first it forgets faster, so that it does not stay at the start."""
    count = count.astype(jnp.float32)
    keep = jnp.minimum(decay, (1 + count) / (10 + count))
    return jax.tree.map(lambda o, n: (o * keep + n * (1 - keep)).astype(o.dtype), old, new)


def started(state: State, weights: Weights, *, widened: bool = False) -> State:
    """An initial state that begins with given weights and statistics.

    Args:
        state: the initial one.
        weights: of the same network.
        widened: whether the weights may be of a network whose convolutions lack the last of their inputs. These then
            begin at zero.

    Raises:
        ValueError: one line that names the source: weights that do not fit.
    """
    both = nnx.merge_state(state.weights, state.statistics)
    template, tree = nnx.to_pure_dict(both), weights.tree
    if widened:
        expected = named(template)
        tree = {name: _wider(leaf, expected.get(name, leaf)) for name, leaf in named(tree).items()}
    found = fit(template, tree, source=weights.source)
    nnx.replace_by_pure_dict(both, jax.device_put(found, devices.replicated()))
    given = nnx.split_state(both, nnx.Param, nnx.BatchStat)
    average = None if state.average is None else jax.tree.map(jnp.copy, given)  # a step gives up the memory of each
    return replace(state, weights=given[0], statistics=given[1], average=average)


def _wider(kernel: Any, template: Any) -> Any:
    """A kernel `[..., I, O]` with zeros for the last of its inputs, where the template has more of them."""
    if not np.ndim(kernel) == np.ndim(template) > 1:
        return kernel
    more = np.subtract(np.shape(template), np.shape(kernel))
    return np.pad(kernel, [(0, n) for n in more]) if more[-2] > 0 and np.count_nonzero(more) == 1 else kernel


def make_step(task: Task, config: Config) -> Step:
    """The functions of a run of `task` by `config`.

    The pool is divided along its leading axis, and so is the batch: slot b of every batch holds examples of the b-th
    part of the pool, so that no example ever moves from one device to another, and the same examples are drawn on any
    number of devices.

    Raises:
        InputError: `frozen` names what the network has not.
    """
    optimizer = transformation(config.optimizer, config.steps)
    rate = schedule(config.optimizer, config.steps)

    def split(training: bool) -> tuple[Any, ...]:
        model = task.init(nnx.Rngs(init_key(config.seed)))
        model.train() if training else model.eval()
        return nnx.split(model, nnx.Param, nnx.BatchStat, ...)

    def without(tree: Any) -> Any:
        """A tree like the weights with zeros for the parts that are frozen."""
        if not config.frozen:
            return tree

        def kept(path: Any, leaf: Array) -> Array:
            return jnp.zeros_like(leaf) if path[0].key in config.frozen else leaf

        return jax.tree_util.tree_map_with_path(kept, tree)

    (graph, parts), (evaluated, _) = (nnx.eval_shape(lambda t=training: split(t)[:2]) for training in (True, False))
    if unknown := set(config.frozen) - set(parts):
        raise InputError(f"frozen: the network has no {', '.join(sorted(unknown))}; it has {', '.join(parts)}")

    def create() -> State:
        _, weights, statistics, rest = split(True)
        average = None if config.ema_decay is None else (weights, statistics)
        return State(jnp.zeros((), jnp.int32), weights, statistics, rest, optimizer.init(weights), average)

    def cut(pool: Example, keys: Any) -> Batch:
        """A device's part of a batch from its part of the pool."""
        parts = jax.tree.map(lambda a: a.reshape(len(keys), -1, *a.shape[1:]), pool)

        def one(part: Example, key: Any) -> Batch:
            choice, own = jax.random.split(key)
            (count,) = {a.shape[0] for a in jax.tree.leaves(part)}
            index = jax.random.randint(choice, (), 0, count, jnp.int32)
            return task.sample(jax.tree.map(lambda a: a[index], part), own)

        return jax.vmap(one)(parts, keys)

    over = PartitionSpec(devices.AXIS)
    cut_all = jax.shard_map(cut, mesh=devices.mesh(), in_specs=(over, over), out_specs=over)

    def batch_of(pool: Example, number: Any) -> Batch:
        return cut_all(pool, jax.random.split(step_key(config.seed, number), config.batch))

    def take(state: State, pool: Example) -> tuple[State, dict[str, Array]]:
        batch = batch_of(pool, state.step)

        def loss_of(weights: Any) -> tuple[Float[Array, ""], tuple[Any, Any, dict[str, Array]]]:
            model = nnx.merge(graph, _cast(weights, config.precision), state.statistics, state.rest, copy=True)
            loss, metrics = task.loss(model, batch)
            _, _, statistics, rest = nnx.split(model, nnx.Param, nnx.BatchStat, ...)
            return loss.astype(jnp.float32), (statistics, rest, dict(metrics))

        (loss, (statistics, rest, metrics)), gradient = jax.value_and_grad(loss_of, has_aux=True)(state.weights)
        gradient = without(gradient)
        with jax.numpy_dtype_promotion("standard"):  # which Optax counts on: it raises floats to counts of steps
            updates, moments = optimizer.update(gradient, state.moments, state.weights)
            weights = optax.apply_updates(state.weights, without(updates))
            used = {"gradient": optax.tree.norm(gradient), "learning_rate": rate(state.step)}
        average = state.average
        if config.ema_decay is not None:
            average = _averaged(config.ema_decay, state.step, average, (weights, statistics))
        metrics |= {"loss": loss, **{name: jnp.asarray(value, jnp.float32) for name, value in used.items()}}
        updated = replace(
            state,
            step=state.step + 1,
            weights=weights,
            statistics=statistics,
            rest=rest,
            moments=moments,
            average=average,
        )
        return updated, metrics

    def model(state: State) -> nnx.Module:
        weights, statistics = state.average or (state.weights, state.statistics)
        return nnx.merge(evaluated, *devices.local((weights, statistics, state.rest)), copy=True)

    whole = devices.replicated()
    return Step(
        create=jax.jit(create, out_shardings=whole),
        take=jax.jit(take, donate_argnums=0, out_shardings=(whole, whole)),
        batch=jax.jit(batch_of),
        model=model,
    )
