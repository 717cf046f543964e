"""Configurations of training runs: frozen dataclasses, read from TOML files, strictly.

A file holds the fields of `Config`; the table `[options]` those of the task's own dataclass:

    task = "extranet"
    steps = 100000

    [optimizer]
    peak_learning_rate = 1e-3

    [options]
    crop = [128, 128]
"""

import dataclasses
import os
import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Any, Literal

from jaxtrapolate.errors import InputError
from jaxtrapolate.files.tables import parse
from jaxtrapolate.files.text import read_toml
from jaxtrapolate.training.tasks import Task, find_task

Precision = Literal["float32", "bfloat16"]


@dataclasses.dataclass(frozen=True)
class Optimizer:
    """Adam and the course of its learning rate: linear warm-up, constant, then half a cosine.

    Attributes:
        peak_learning_rate: between warm-up and decay.
        warmup: steps in which it rises linearly from 0.
        constant: steps at its height after that.
        decay: steps from there to the end of the cosine, which a run may stop short of; by default the rest of the run.
        floor: what it ends at, as a fraction of its height.
        beta1, beta2, epsilon: Adam's (Kingma and Ba 2015).
        weight_decay: decoupled (Loshchilov and Hutter 2019), 0 for none.
        clip: the gradient's largest norm, over all weights; not clipped where absent.
    """

    peak_learning_rate: float = 1e-3
    warmup: int = 0
    constant: int = 0
    decay: int | None = None
    floor: float = 0.0
    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-8
    weight_decay: float = 0.0
    clip: float | None = None

    def __post_init__(self) -> None:
        for name in ("peak_learning_rate", "epsilon"):
            check_range(self, name, above=0)
        for name in ("warmup", "constant", "weight_decay"):
            check_range(self, name, least=0)
        for name in ("beta1", "beta2"):
            check_range(self, name, least=0, below=1)
        check_range(self, "floor", least=0, most=1)
        if self.decay is not None:
            check_range(self, "decay", least=1)
        if self.clip is not None:
            check_range(self, "clip", above=0)


@dataclasses.dataclass(frozen=True)
class Config:
    """All that determines a training run.

    Attributes:
        task: its name, see `jaxtrapolate.training.tasks`.
        options: the task's own dataclass.
        steps: of the optimiser, in all.
        seed: of the initial weights, the examples and the batches.
        start: a file of weights, or a run's `model` folder, that the network begins with, or "default" for the weights
            that come with the package; at random where absent. The optimiser begins anew.
        batch: items a step, over all devices.
        pool: examples that are generated at a time, a multiple of `batch`.
        steps_per_round: steps between one pool and the next.
        optimizer: see `Optimizer`.
        ema_decay: of the exponential moving average of the weights, which is validated and exported; the weights
            themselves where absent.
        frozen: parts of the network, attributes by name, whose weights stay what they are.
        precision: of the network while training; weights, averages and validation stay float32.
        log_every: steps from one line of the log to the next, the only times at which the host waits for the devices.
        checkpoint_every, validate_every: steps, multiples of `log_every`.
        keep: how many of the last checkpoints are kept, beside the best.
    """

    task: str
    options: Any
    steps: int
    seed: int = 0
    start: str | None = None
    batch: int = 8
    pool: int = 64
    steps_per_round: int = 64
    optimizer: Optimizer = dataclasses.field(default_factory=Optimizer)
    ema_decay: float | None = None
    frozen: tuple[str, ...] = ()
    precision: Precision = "float32"
    log_every: int = 50
    checkpoint_every: int = 500
    validate_every: int = 1000
    keep: int = 3

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "pool", "steps_per_round", "log_every", "keep"):
            check_range(self, name, least=1)
        check_range(self, "seed", least=0, below=2**32)
        if self.ema_decay is not None:
            check_range(self, "ema_decay", least=0, below=1)
        if self.pool % self.batch:
            raise ValueError(f"pool: expected a multiple of batch = {self.batch}, got {self.pool}")
        for name in ("checkpoint_every", "validate_every"):
            check_range(self, name, least=1)
            if getattr(self, name) % self.log_every:
                raise ValueError(
                    f"{name}: expected a multiple of log_every = {self.log_every}, got {getattr(self, name)}"
                )


def check_range(
    record: Any,
    name: str,
    *,
    least: int | float | None = None,
    most: int | float | None = None,
    above: int | float | None = None,
    below: int | float | None = None,
) -> None:
    """Raise `ValueError` unless a field of a dataclass is finite and within the bounds that are given."""
    value = getattr(record, name)
    bounds = {"at least": least, "at most": most, "above": above, "below": below}
    fits = {
        "at least": lambda b: value >= b,
        "at most": lambda b: value <= b,
        "above": lambda b: value > b,
        "below": lambda b: value < b,
    }
    given = {text: bound for text, bound in bounds.items() if bound is not None}
    finite = abs(value) < float("inf")  # no NaN either
    if not (finite and all(fits[text](bound) for text, bound in given.items())):
        raise ValueError(f"{name}: expected {' and '.join(f'{t} {b}' for t, b in given.items())}, got {value}")


def parse_config(table: Mapping[str, Any]) -> Config:
    """A `Config` from a table, its options by the task that it names. Raises `ValueError` as `parse` does."""
    name = table.get("task")
    if not isinstance(name, str):
        raise ValueError("task: missing; it has no default" if name is None else f"task: expected a text, got {name!r}")
    options = table.get("options", {})
    if not isinstance(options, Mapping):
        raise ValueError(f"options: expected a table, got {options!r}")
    parsed = parse(find_task(name).options, options, where="options")
    return parse(Config, {**table, "options": parsed})


def load_config(name: str | os.PathLike[str], changes: Mapping[str, Any] | None = None) -> Config:
    """The configuration in a TOML file, or the shipped one of that name (see `config_names`).

    Args:
        name: of either.
        changes: settings by their full names, as "options.windows.dumps", in place of what the file says.

    Raises:
        InputError: no such file, no TOML, an unknown key, a wrong type or value, in one line that names the key.
    """
    text = os.fspath(name)
    shipped = _shipped()
    try:
        table = tomllib.loads(shipped[text].read_text()) if text in shipped else _read_toml(text, shipped)
        for key, value in (changes or {}).items():
            _put(table, key, value)
        return parse_config(table)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{text}: {error}") from error


def _read_toml(text: str, shipped: Mapping[str, Any]) -> dict[str, Any]:
    if not text.endswith(".toml") and not os.path.lexists(text):
        there = f"the shipped ones are {', '.join(shipped)}" if shipped else "none are shipped"
        raise InputError(f"{text}: no such configuration or TOML file; {there}")
    return read_toml(text)


def _put(table: dict[str, Any], key: str, value: Any) -> None:
    *path, last = key.split(".")
    for part in path:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise ValueError(f"{key}: {part} is no table")
    table[last] = value


def config_names() -> tuple[str, ...]:
    """The names of the shipped configurations."""
    return tuple(_shipped())


def _shipped() -> dict[str, Any]:
    folder = resources.files("jaxtrapolate.training").joinpath("configs")
    files = sorted(folder.iterdir(), key=lambda f: f.name) if folder.is_dir() else []
    return {f.name.removesuffix(".toml"): f for f in files if f.name.endswith(".toml")}


def make_task(config: Config) -> Task:
    """The task of a configuration.

    Raises:
        InputError: options that do not go together, or name what cannot be read.
    """
    try:
        return find_task(config.task).make(config.options)
    except ValueError as error:
        raise InputError(f"options: {error}") from error
