"""What a run writes for people and programs to read: metrics as JSON lines, images as PNG, a batch that broke it."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtrapolate.atomic import atomic_path, os_input_error
from jaxtrapolate.files import write_png

METRICS = "metrics.jsonl"
"""Name of the file of metrics: one JSON object a line, with "kind" ("train" or "validation") and "step"."""


class Journal:
    """Writes into a workdir; does nothing where `active` is False (on all hosts but one).

    Args:
        workdir: a folder.
        active: whether to write.
        step: the step at which a run goes on; what an earlier process wrote of later ones is dropped, it comes again.
    """

    def __init__(self, workdir: Path, *, active: bool, step: int) -> None:
        self._workdir, self._active = workdir, active
        self._path = workdir / METRICS
        if active and self._path.exists():
            kept = [line for line in read_metrics(workdir) if line["step"] <= step]
            with atomic_path(self._path) as temporary:
                temporary.write_text("".join(_line(entry) for entry in kept))

    def write(self, kind: str, step: int, values: Mapping[str, float | str]) -> None:
        """Adds a line."""
        if self._active:
            try:
                with self._path.open("a", encoding="utf-8") as file:
                    file.write(_line({"kind": kind, "step": step, **values}))
            except OSError as error:
                raise os_input_error(self._path, error, action="write") from error

    def images(self, step: int, images: Mapping[str, Any]) -> None:
        """Writes images `[H, W, 3]` in 0..1 as images/<step>-<name>.png."""
        if self._active and images:
            folder = self._workdir / "images"
            folder.mkdir(exist_ok=True)
            for name, image in images.items():
                codes = np.round(255 * np.clip(np.nan_to_num(np.asarray(image, np.float32)), 0, 1))
                write_png(folder / f"{step:08d}-{name}.png", codes.astype(np.uint8))

    def batch(self, step: int, batch: Any) -> Path:
        """Writes the arrays of a batch, named by their paths in it, as batch-<step>.npz."""
        path = self._workdir / f"batch-{step:08d}.npz"
        if self._active:
            leaves, _ = jax.tree_util.tree_flatten_with_path(batch)
            names = [jax.tree_util.keystr(place, simple=True, separator=".") or "batch" for place, _ in leaves]
            with atomic_path(path) as temporary, temporary.open("wb") as file:
                arrays: Any = {n: np.asarray(leaf) for n, (_, leaf) in zip(names, leaves, strict=True)}
                np.savez_compressed(file, **arrays)
        return path


def read_metrics(workdir: Path) -> list[dict[str, Any]]:
    """The lines of a workdir's metrics; one that a kill left unfinished is left out."""
    entries = []
    path = workdir / METRICS
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            entries.append(json.loads(line))
        except (ValueError, RecursionError):
            continue
    return entries


def _line(entry: Mapping[str, Any]) -> str:
    """JSON has no infinite numbers and no NaN: they are null."""
    plain = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in entry.items()}
    return json.dumps(plain) + "\n"
