"""The scores of single frames as an evaluation keeps them: small JSON files that outlive a killed run."""

import zlib
from pathlib import Path
from typing import Any

from jaxtrapolate.metrics import Metric
from jaxtrapolate.runtime.output import read_json, write_json


class Scores:
    """The scores of frames that outlive a killed run, a JSON file a frame, with times of compilation and of stages.

    What is not of the shape that this version writes, or lacks a metric, counts as not there.
    """

    def __init__(self, folder: Path, metrics: dict[str, Metric]) -> None:
        self._folder, self._metrics = folder, metrics
        compiled, stages = (read_json(folder / f"{name}.json") for name in ("compile", "stages"))
        compiled, stages = (v if isinstance(v, dict) else {} for v in (compiled, stages))
        self.compile_ms: dict[str, float] = {n: float(v) for n, v in compiled.items() if isinstance(v, int | float)}
        self.stages: dict[str, Any] = {n: v for n, v in stages.items() if isinstance(v, dict)}

    def frame(self, number: int) -> dict[str, dict[str, Any]]:
        """The scores of a frame by method."""
        entries = read_json(self._folder / f"{number:04d}.json")
        entries = entries if isinstance(entries, dict) else {}
        return {name: entry for name, entry in entries.items() if self._complete(entry, number)}

    def _complete(self, entry: Any, number: int) -> bool:
        if not isinstance(entry, dict) or entry.get("number") != number:
            return False
        numeric = all(isinstance(entry.get(key), int | float) for key in ("psnr", "ms"))
        wanted = [m.name for m in self._metrics.values() if m.per != "clip" and m.name != "psnr"]
        causes = entry.get("by_cause")
        by_cause = isinstance(causes, dict) and all(
            isinstance(c, dict) and all(isinstance(c.get(k), int | float) for k in ("psnr", "share"))
            for c in causes.values()
        )
        scored = all(m in entry and isinstance(entry[m], int | float | None) for m in wanted)
        return numeric and scored and by_cause and isinstance(entry.get("unscored", {}), dict)

    def write(self, number: int, scores: dict[str, Any]) -> None:
        """Keeps a frame's scores, beside those of methods that are not asked for now."""
        path = self._folder / f"{number:04d}.json"
        there = read_json(path)
        write_json(self._folder / "compile.json", self.compile_ms)
        write_json(self._folder / "stages.json", self.stages)
        write_json(path, (there if isinstance(there, dict) else {}) | scores)

    def clips(self, numbers: list[int]) -> dict[str, dict[str, float]]:
        """The metrics of clips, by method, over just these frames."""
        found = read_json(self._clip(numbers))
        return {n: v for n, v in found.items() if isinstance(v, dict)} if isinstance(found, dict) else {}

    def write_clips(self, numbers: list[int], found: dict[str, dict[str, float]]) -> None:
        """Keeps the metrics of clips."""
        write_json(self._clip(numbers), found)

    def _clip(self, numbers: list[int]) -> Path:
        return self._folder / f"clip-{zlib.crc32(repr(numbers).encode()):08x}.json"
