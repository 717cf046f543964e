"""Checkpoints that a kill at any moment leaves whole, and the trained weights."""

import contextlib
import errno
import gc
import logging
import math
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from flax import nnx
from orbax.checkpoint import checkpoint_managers as policies

from jaxtrapolate.atomic import os_input_error
from jaxtrapolate.errors import InputError


class Checkpoints:
    """The states of a run by step, in a folder: the last few and the best. `InputError` where the disk is full.

    Orbax writes each into a folder of another name, which takes its own only when it is complete; what a kill leaves is
    removed when the run goes on. With several hosts all of them call `save` and `restore`.

    Args:
        folder: for the checkpoints.
        keep: how many of the last.
        score: name of the metric by which one more is kept, the one where it is largest; NaN counts as the least.
    """

    def __init__(self, folder: Path, *, keep: int, score: str) -> None:
        def value(metrics: Mapping[str, float]) -> float:
            found = float(metrics[score])
            return -math.inf if math.isnan(found) else found

        best = policies.BestN(get_metric_fn=value, n=1, keep_checkpoints_without_metrics=False)
        options = ocp.CheckpointManagerOptions(
            preservation_policy=policies.AnyPreservationPolicy([policies.LatestN(keep), best]),
            cleanup_tmp_directories=True,
            enable_async_checkpointing=False,
        )
        self._folder = folder.absolute()
        self._manager = ocp.CheckpointManager(self._folder, options=options)

    def latest(self) -> int | None:
        """The step of the last checkpoint."""
        return self._manager.latest_step()

    def steps(self) -> tuple[int, ...]:
        """The steps of all of them, ascending."""
        return tuple(sorted(self._manager.all_steps()))

    def save(self, step: int, state: Any, metrics: Mapping[str, float] | None = None) -> None:
        """Saves a state; metrics: of its validation, where there was one."""
        scores = None if metrics is None else dict(metrics)
        with _disk(self._folder, state):
            self._manager.save(step, args=ocp.args.StandardSave(state), metrics=scores)

    def restore(self, step: int, like: Any) -> Any:
        """The state of a step, with the structure, types and shardings of the arrays `like`."""
        target = jax.tree.map(ocp.utils.to_shape_dtype_struct, like)
        return self._manager.restore(step, args=ocp.args.StandardRestore(target))

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._manager.close()


def model_arrays(model: nnx.Module) -> dict[str, np.ndarray]:
    """A network's weights and statistics as NumPy arrays, named by their paths in it, as "down1/feature/kernel"."""
    _, state, _ = nnx.split(model, (nnx.Param, nnx.BatchStat), ...)
    pairs = nnx.to_flat_state(state)
    return {"/".join(map(str, path)): np.asarray(variable[...]) for path, variable in pairs}


def save_model(folder: Path, model: nnx.Module, *, about: Mapping[str, Any]) -> None:
    """Saves `model_arrays` as an Orbax checkpoint, in place of what was there; all hosts call it.

    about: JSON that is saved with them. The checkpoint's items are "weights" and "metadata", as
    `jaxtrapolate.weights.load_orbax` reads them.
    """
    arrays = model_arrays(model)
    items = {"weights": ocp.args.StandardSave(arrays), "metadata": ocp.args.JsonSave(dict(about))}
    with _disk(folder, arrays), ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as checkpointer:
        checkpointer.save(folder.absolute(), args=ocp.args.Composite(**items), force=True)


_SPARE = 1 << 20  # bytes that a checkpoint needs beside its arrays


@contextlib.contextmanager
def _disk(folder: Path, state: Any) -> Iterator[None]:
    """Raises `InputError` where a state does not fit on the disk, before Orbax tries, which has no one error for it.

    What fills up meanwhile (or has a quota) it reports in many words, by many threads: here as the same error.
    """
    needed = _SPARE + sum(leaf.nbytes for leaf in jax.tree.leaves(state) if hasattr(leaf, "nbytes"))
    free = shutil.disk_usage(next(p for p in (folder, *folder.parents) if p.exists())).free
    if free < needed:
        text = f"the disk is full ({free >> 20} MB are free, a checkpoint needs {needed >> 20}); free some space"
        raise InputError(f"{folder}: cannot be written, {text} and run again")
    loggers = [logging.getLogger(name) for name in ("absl", "asyncio")]
    quiet = [logger.disabled for logger in loggers]
    for logger in loggers:
        logger.disabled = True
    try:
        yield
    except Exception as error:
        gc.collect()  # tasks that nobody waited for complain when they are collected
        full = [n for n in (errno.ENOSPC, errno.EDQUOT) if os.strerror(n) in str(error)]
        if not full:
            raise
        raise os_input_error(folder, OSError(full[0], os.strerror(full[0])), action="write") from None
    finally:
        for logger, before in zip(loggers, quiet, strict=True):
            logger.disabled = before
