"""The scores of single frames as an evaluation keeps them: small JSON files that outlive a killed run."""

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxtrapolate.metrics import Metric
from jaxtrapolate.results import FrameScore, RunTime, number
from jaxtrapolate.runtime.output import read_json, write_json


class Scores:
    """The scores of frames that outlive a killed run, a JSON file a frame, with times of compilation and of stages.

    What is not of the shape that this version writes, or lacks a metric, counts as not there.

    Args:
        folder: for the files; `None` keeps nothing.
        metrics: that an entry must have.
    """

    def __init__(self, folder: Path | None, metrics: Mapping[str, Metric]) -> None:
        self._folder, self._metrics = folder, metrics
        compiled, stages = (self._read(f"{name}.json") for name in ("compile", "stages"))
        self.compile: dict[str, RunTime] = {n: RunTime.from_json(v) for n, v in compiled.items()}
        self.stages: dict[str, dict[str, RunTime]] = {
            n: {k: RunTime.from_json(t) for k, t in v.items()} for n, v in stages.items() if isinstance(v, dict)
        }

    def _read(self, name: str) -> dict[str, Any]:
        found = None if self._folder is None else read_json(self._folder / name)
        return found if isinstance(found, dict) else {}

    def _write(self, name: str, content: Any) -> None:
        if self._folder is not None:
            write_json(self._folder / name, content)

    def frame(self, index: int) -> dict[str, FrameScore]:
        """The scores of a frame by method."""
        entries = self._read(f"{index:04d}.json").items()
        found = {n: FrameScore.from_json(e, self._metrics) for n, e in entries if self._complete(e, index)}
        return {name: entry for name, entry in found.items() if entry is not None}

    def _complete(self, entry: Any, index: int) -> bool:
        if not isinstance(entry, dict) or entry.get("number") != index:
            return False
        numeric = all(isinstance(entry.get(key), int | float) for key in ("psnr", "ms", "distance"))
        wanted = [m.name for m in self._metrics.values() if m.per != "clip" and m.name != "psnr"]
        causes = entry.get("by_cause")
        by_cause = isinstance(causes, dict) and all(
            isinstance(c, dict) and all(isinstance(c.get(k), int | float) for k in ("psnr", "share"))
            for c in causes.values()
        )
        scored = all(m in entry and isinstance(entry[m], int | float | None) for m in wanted)
        return numeric and scored and by_cause and isinstance(entry.get("unscored", {}), dict)

    def write(self, index: int, scores: Mapping[str, FrameScore]) -> None:
        """Keeps a frame's scores, beside those of methods that are not asked for now."""
        self._write("compile.json", {n: t.to_json() for n, t in self.compile.items()})
        self._write("stages.json", {n: {k: t.to_json() for k, t in v.items()} for n, v in self.stages.items()})
        name = f"{index:04d}.json"
        self._write(name, self._read(name) | {n: s.to_json() for n, s in scores.items()})

    def clips(self, numbers: list[int]) -> dict[str, dict[str, float]]:
        """The metrics of clips, by method, over just these frames."""
        found = {n: v for n, v in self._read(self._clip(numbers)).items() if isinstance(v, dict)}
        return {n: {k: f for k, v in m.items() if (f := number(v)) is not None} for n, m in found.items()}

    def write_clips(self, numbers: list[int], found: Mapping[str, Mapping[str, float]]) -> None:
        """Keeps the metrics of clips."""
        self._write(self._clip(numbers), found)

    def _clip(self, numbers: list[int]) -> str:
        return f"clip-{zlib.crc32(repr(numbers).encode()):08x}.json"
