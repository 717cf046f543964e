"""The training loop: `train_and_evaluate(config, workdir)`."""

import concurrent.futures
import dataclasses
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxtrapolate.atomic import os_input_error
from jaxtrapolate.errors import InputError
from jaxtrapolate.runtime.output import Output, code, differences, open_output
from jaxtrapolate.training import devices
from jaxtrapolate.training.checkpoints import Checkpoints, save_model
from jaxtrapolate.training.config import Config, make_task
from jaxtrapolate.training.journal import Journal, read_metrics
from jaxtrapolate.training.step import State, Step, make_step, started
from jaxtrapolate.training.tasks import Example, Task, round_key
from jaxtrapolate.weights import default_weights, read_weights

Report = Callable[[str, int, int], None]
"""How a run tells where it is: a text, steps done, of how many."""


class TrainingError(Exception):
    """A run that cannot go on: its loss or gradient is not finite. The message is one line."""


def train_and_evaluate(
    config: Config,
    workdir: str | os.PathLike[str],
    *,
    task: Task | None = None,
    report: Report | None = None,
    ahead: bool | None = None,
    fresh: bool = False,
) -> dict[str, float | None]:
    """Trains a network as a configuration says, from a workdir's last checkpoint on; the last validation's scores.

    In the workdir: run.json, which holds the configuration; metrics.jsonl; checkpoints/, the last few and the best;
    images/ of each validation; at the end model/, the (averaged) weights, which `jaxtrapolate.load` takes. On one
    CPU a run that was killed and resumed gives the same numbers bit for bit. It runs on all devices of all hosts
    that `jax.distributed` knows; these share the workdir, and losses are the same on any number of devices but for
    rounding. A score that is not finite is None here and null in metrics.jsonl. A run that goes on with other code
    of this package says so in metrics.jsonl.

    Args:
        config: see `Config`.
        workdir: a folder, created if need be. It holds one run.
        task: instead of the one that the configuration names.
        report: called at every line of the log.
        fresh: delete what an earlier run wrote to the workdir, and begin anew.
        ahead: whether a thread generates the next round's pool while this one is trained on, which holds two in memory;
            by default on accelerators only, for on a CPU both want the same cores.

    Raises:
        InputError: a workdir of another configuration, of frames that have changed since, in use by another run, or
            that cannot be written (the disk is full); a batch that cannot be divided among
            the devices; weights to start from that cannot be read or do not fit.
        TrainingError: a loss or gradient that is not finite; the message names the step, and the batch is saved.
    """
    devices.check_divisible(config.batch)
    first = jax.process_index() == 0
    settings = dataclasses.asdict(config)
    with open_output(workdir, "train", settings, fresh=fresh, any_code=True, writes=first) as output:
        task = make_task(config) if task is None else task
        for index, sequence in enumerate(getattr(task, "sequences", ())):
            output.agree_frames(sequence, sequence.numbers, kind=f"frames of dump {index}")
        return _train(config, task, output, report, ahead=ahead, first=first)


def _train(
    config: Config, task: Task, output: Output, report: Report | None, *, ahead: bool | None, first: bool
) -> dict[str, float | None]:
    folder = output.folder
    step = make_step(task, config)
    with Checkpoints(folder / "checkpoints", keep=config.keep, score=task.score) as checkpoints:
        state, start, differ = step.create(), checkpoints.latest() or 0, ""
        if start:
            state = checkpoints.restore(start, state)
        elif config.start is not None:
            state, differ = _begun(state, config.start, task)
        journal = Journal(folder, active=first, step=start)
        if differ:
            journal.write("start", start, {"other than the weights were trained on": differ})
        if start and output.code_before is not None:
            journal.write("code", start, {"before": output.code_before, "now": code()})
        ahead = jax.default_backend() != "cpu" if ahead is None else ahead
        with _Pools(task, config, ahead=ahead) as pools:
            run = _Run(config, task, step, pools, checkpoints, journal, report)
            state = run.go(state, start)
    save_model(folder / "model", step.model(state), about=task.about)
    validated = [line for line in read_metrics(folder) if line["kind"] == "validation"]
    return {name: value for name, value in validated[-1].items() if name not in ("kind", "step")}


def _begun(state: State, start: str, task: Task) -> tuple[State, str]:
    """The initial state with the weights of a file, and what differs of what the task lets differ.

    They have to be of the same method, and of the same configuration but for the parts that the task names in `adapts`.
    """
    method, free, changed = task.about["method"], getattr(task, "adapts", ()), ""
    try:
        weights = read_weights(default_weights(method) if start == "default" else start)
        if weights.method is not None:
            own, wanted = {"method": weights.method, **weights.config}, {"method": method, **task.about["config"]}
            if differ := differences(own, wanted, free=free):
                raise ValueError(f"start: {weights.source} holds weights of another kind: {differ}")
            changed = differences(own, wanted)
        return started(state, weights, widened=bool(changed)), changed
    except OSError as error:
        raise os_input_error(start, error) from error
    except ValueError as error:
        raise InputError(str(error)) from error


class _Pools:
    """The pools by round; with `ahead`, a thread generates the next while this one is in use."""

    def __init__(self, task: Task, config: Config, *, ahead: bool) -> None:
        self._task, self._config = task, config
        self._rounds = -(-config.steps // config.steps_per_round)
        self._number, self._pool = -1, None
        self._thread = concurrent.futures.ThreadPoolExecutor(1, "jaxtrapolate-pool") if ahead else None
        self._next: tuple[int, concurrent.futures.Future] | None = None
        self.seconds: list[float] = []  # that each pool took, and of that what was waited for
        self.waited: float = 0.0

    def of(self, step: int, after: Any) -> Example:
        """The pool of a step's round; the last one is kept. `after`: what is waited for first, to time pools alone."""
        number = step // self._config.steps_per_round
        if number != self._number:
            if self._thread is None:
                jax.block_until_ready(after)
            begun = time.perf_counter()
            self._pool = None
            self._pool = devices.distribute(self._made(number))
            self._number = number
            self.waited += time.perf_counter() - begun
            if self._thread is not None and number + 1 < self._rounds:
                self._next = number + 1, self._thread.submit(self._make, number + 1)
        return self._pool

    def _made(self, number: int) -> Example:
        ready, self._next = self._next, None
        if ready is not None:
            pool = ready[1].result()
            if ready[0] == number:
                return pool
        return self._make(number)

    def _make(self, number: int) -> Example:
        begun = time.perf_counter()
        part = devices.own_part(self._config.pool)
        pool = self._task.pool(round_key(self._config.seed, number), part)
        lengths = {np.shape(leaf)[0] for leaf in jax.tree.leaves(pool)}
        if lengths != {len(part)}:
            raise ValueError(f"pool: expected a leading axis of {len(part)} examples, got {sorted(lengths)}")
        jax.block_until_ready(pool)
        self.seconds.append(time.perf_counter() - begun)
        return pool

    def __enter__(self) -> "_Pools":
        return self

    def __exit__(self, *_: object) -> None:
        if self._thread is not None:
            self._thread.shutdown(cancel_futures=True)


class _Run:
    """The loop itself; what it measures between two lines of the log."""

    def __init__(
        self,
        config: Config,
        task: Task,
        step: Step,
        pools: _Pools,
        checkpoints: Checkpoints,
        journal: Journal,
        report: Report | None,
    ) -> None:
        self._config, self._task, self._step, self._pools = config, task, step, pools
        self._checkpoints, self._journal, self._report = checkpoints, journal, report

    def go(self, state: State, start: int) -> State:
        """The state after the last step."""
        config = self._config
        pending: list[dict[str, jax.Array]] = []
        self._tell("compile", start)
        begun, compiled = time.perf_counter(), start + 1
        for number in range(start, config.steps):
            state, metrics = self._step.take(state, self._pools.of(number, state))
            pending.append(metrics)
            done, last = number + 1, number + 1 == config.steps
            if done == compiled:
                jax.block_until_ready(metrics)
                compile_seconds = time.perf_counter() - begun - self._pools.waited
                self._journal.write("start", start, {"compile_s": compile_seconds, **self._pool_times()})
                begun = time.perf_counter()
            if done % config.log_every == 0 or last:
                values = self._finite(done, pending)
                steps = len(pending) - (done - len(pending) == start)  # the first one was compiled
                seconds = time.perf_counter() - begun - self._pools.waited
                if steps:
                    values |= {"step_ms": 1e3 * seconds / steps, "examples_per_s": config.batch * steps / seconds}
                values |= self._pool_times()
                self._journal.write("train", done, values)
                self._tell(f"loss {values['loss']:.4g}", done)
                pending = []
                due = done % config.validate_every == 0 or last
                scores = self._validate(state, done) if due else None
                if due or done % config.checkpoint_every == 0:
                    self._checkpoints.save(done, state, scores)
                begun = time.perf_counter()
        return state

    def _tell(self, text: str, done: int) -> None:
        if self._report is not None:
            self._report(text, done, self._config.steps)

    def _pool_times(self) -> dict[str, float]:
        """Of the pools generated since the last line; the time that was waited for them is forgotten."""
        seconds, self._pools.seconds, self._pools.waited = self._pools.seconds, [], 0.0
        return {"pool_ms": 1e3 * sum(seconds) / len(seconds)} if seconds else {}

    def _finite(self, done: int, pending: list[dict[str, jax.Array]]) -> dict[str, float]:
        """The means of the metrics of the steps up to `done`; raises where one is not finite."""
        fetched = jax.device_get(pending)
        for number, metrics in enumerate(fetched, done - len(fetched)):
            for name in ("loss", "gradient"):
                if not np.isfinite(metrics[name]):
                    batch = devices.collect(self._step.batch(self._pools.of(number, pending), np.int32(number)))
                    path = self._journal.batch(number + 1, batch)
                    raise TrainingError(
                        f"step {number + 1}: the {name} is {metrics[name]}; its batch is saved in {path}, and the last "
                        f"checkpoint is of step {self._checkpoints.latest() or 0}"
                    )
        return {name: float(np.mean([m[name] for m in fetched])) for name in fetched[-1]}

    def _validate(self, state: State, done: int) -> dict[str, float]:
        self._tell("validate", done)
        scores, images = self._task.validate(self._step.model(state))
        scores = {name: float(value) for name, value in scores.items()}
        if self._task.score not in scores:
            raise ValueError(f"validate: expected a metric {self._task.score!r}, got {', '.join(scores) or 'none'}")
        self._journal.write("validation", done, scores)
        self._journal.images(done, images)
        return scores
