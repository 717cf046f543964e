"""The results of an evaluation as records, and as JSON: each key is written down here and nowhere else.

Reading is robust: what is absent or odd becomes `None` or empty, never an error. Numbers that are infinite (equal
images have infinite dB) are the string "inf" in JSON.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any


def number(value: Any) -> float | None:
    """A float, infinite where the value says so ("inf" too); None for anything that is no number, and for NaN."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        result = float(value)
    except (ValueError, OverflowError):
        return None
    return None if math.isnan(result) else result


def mapping(value: Any) -> Mapping[str, Any]:
    """The value where it is a mapping, else an empty one."""
    return value if isinstance(value, Mapping) else {}


def items(value: Any) -> list[Any] | tuple[Any, ...]:
    """The value where it is a list or tuple, else an empty one."""
    return value if isinstance(value, (list, tuple)) else ()


def _decibels(entry: Mapping[str, Any]) -> float | None:
    """The PSNR of an entry; where there is none but the images are the same (SSIM 1), infinite."""
    value = number(entry.get("psnr"))
    return math.inf if value is None and number(entry.get("ssim")) == 1 else value


@dataclasses.dataclass(frozen=True)
class MetricInfo:
    """What a metric's figures are: "frame" or "clip" metric, whether "higher" or "lower" is better, and the unit."""

    per: str = "frame"
    better: str = "higher"
    unit: str = ""

    def to_json(self) -> dict[str, str]:
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, value: Any) -> "MetricInfo":
        entry = mapping(value)
        per, better = (
            ("clip" if entry.get("per") == "clip" else "frame"),
            ("lower" if entry.get("better") == "lower" else "higher"),
        )
        return cls(per, better, str(entry.get("unit") or ""))


@dataclasses.dataclass(frozen=True)
class RunTime:
    """Milliseconds: the median, the distance between the quartiles, and compilation, `None` where not known.

    Attributes:
        cached: whether the compiled program was read from a cache, so that `compile` is not the time of compilation.
    """

    median: float | None = None
    iqr: float | None = None
    compile: float | None = None
    runs: int | None = None
    cached: bool = False

    def to_json(self) -> dict[str, Any]:
        found: dict[str, Any] = {"median": self.median, "iqr": self.iqr, "compile": self.compile}
        found |= {} if self.runs is None else {"runs": self.runs}
        return found | ({"cached": True} if self.cached else {})

    @classmethod
    def from_json(cls, value: Any) -> "RunTime":
        """From a mapping; a bare number is a median."""
        if not isinstance(value, Mapping):
            return cls(_positive(value))
        median, iqr, compiled, runs = (_positive(value.get(key)) for key in ("median", "iqr", "compile", "runs"))
        return cls(median, iqr, compiled, None if runs is None else int(runs), value.get("cached") is True)


def _positive(value: Any) -> float | None:
    value = number(value)
    return value if value is not None and 0 <= value < math.inf else None


@dataclasses.dataclass(frozen=True)
class CauseScore:
    """PSNR over the pixels of one cause of error, and their share of all pixels."""

    psnr: float | None
    share: float | None

    def to_json(self) -> dict[str, float | None]:
        return {"psnr": self.psnr, "share": self.share}


def _causes(value: Any) -> dict[str, CauseScore]:
    found = {str(k): mapping(v) for k, v in mapping(value).items()}
    return {k: CauseScore(number(v.get("psnr")), number(v.get("share"))) for k, v in found.items() if v}


@dataclasses.dataclass(frozen=True)
class FrameScore:
    """The scores of one generated frame, or of a rendered one that was super sampled.

    Attributes:
        number: of the frame.
        distance: how many frames it is after the newest rendered one; 0 for a rendered frame.
        psnr: over the whole frame.
        metrics: all others, by name; `None` where one could not be had.
        by_cause: PSNR by the cause of error.
        ms: how long the method took.
        unscored: why a metric could not be had, by name.
    """

    number: int
    distance: int
    psnr: float | None
    metrics: Mapping[str, float | None]
    by_cause: Mapping[str, CauseScore]
    ms: float | None
    unscored: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        found = {"number": self.number, "distance": self.distance, "psnr": self.psnr, **self.metrics}
        found |= {"by_cause": {k: v.to_json() for k, v in self.by_cause.items()}, "ms": self.ms}
        return found | ({"unscored": dict(self.unscored)} if self.unscored else {})

    @classmethod
    def from_json(cls, value: Any, metrics: Any = ("ssim",)) -> "FrameScore | None":
        """`None` for an entry that does not say which frame it is of."""
        entry = mapping(value)
        index, distance = number(entry.get("number")), number(entry.get("distance"))
        if index is None or not math.isfinite(index):
            return None
        return cls(
            int(index),
            int(distance) if distance is not None and math.isfinite(distance) else 1,
            _decibels(entry),
            {m: number(entry.get(m)) for m in metrics if m != "psnr"},
            _causes(entry.get("by_cause")),
            _positive(entry.get("ms")),
            {str(k): str(v) for k, v in mapping(entry.get("unscored")).items()},
        )


@dataclasses.dataclass(frozen=True)
class MethodResult:
    """The scores of one method.

    Attributes:
        psnr: the mean over the generated frames.
        metrics: all others, by name, generated frames' means and those of clips.
        ms: of a generated frame.
        by_cause: PSNR by the cause of error: the mean over the frames in which it occurs, the share over all.
        by_distance: PSNR by how many frames a frame is after the newest rendered one, where there are several; 0 is
            for the rendered frames, where the method super samples those.
        stages: milliseconds by stage, each on its own.
        left_out: what each stage that did not run lacks.
        frames: the scores of single generated frames; none in results over several inputs.
        rendered: the scores of single rendered frames that were super sampled.
        inputs: over how many inputs the figures are means, in results over several.
    """

    psnr: float | None
    metrics: Mapping[str, float | None]
    ms: RunTime
    by_cause: Mapping[str, CauseScore] = dataclasses.field(default_factory=dict)
    by_distance: Mapping[int, float | None] = dataclasses.field(default_factory=dict)
    stages: Mapping[str, RunTime] = dataclasses.field(default_factory=dict)
    left_out: Mapping[str, list[str]] = dataclasses.field(default_factory=dict)
    frames: tuple[FrameScore, ...] = ()
    rendered: tuple[FrameScore, ...] = ()
    inputs: int | None = None

    @property
    def drift(self) -> float | None:
        """What the last of several frames in a row is below the first, in dB; `None` for single frames."""
        known = [v for distance, v in sorted(self.by_distance.items()) if distance and v is not None]
        return known[0] - known[-1] if len(known) > 1 else None

    def to_json(self) -> dict[str, Any]:
        found: dict[str, Any] = {"psnr": self.psnr, **self.metrics}
        found["by_cause"] = {k: v.to_json() for k, v in self.by_cause.items()}
        found["ms"] = self.ms.to_json()
        if self.by_distance:
            found["by_distance"] = {str(k): v for k, v in self.by_distance.items()}
        if self.inputs is not None:
            return found | {"inputs": self.inputs}
        found["stages"] = {k: v.to_json() for k, v in self.stages.items()}
        found["left_out"] = dict(self.left_out)
        found["frames"] = [f.to_json() for f in self.frames]
        return found | ({"rendered": [f.to_json() for f in self.rendered]} if self.rendered else {})

    @classmethod
    def from_json(cls, value: Any, metrics: Any = ("ssim",)) -> "MethodResult":
        entry = mapping(value)
        left_out = mapping(entry.get("left_out")).items()

        def frames(key: str) -> tuple[FrameScore, ...]:
            found = (FrameScore.from_json(f, metrics) for f in items(entry.get(key)))
            return tuple(sorted((f for f in found if f is not None), key=lambda f: f.number))

        distances = ((number(k), number(v)) for k, v in mapping(entry.get("by_distance")).items())
        inputs = number(entry.get("inputs"))
        return cls(
            psnr=_decibels(entry),
            metrics={m: number(entry.get(m)) for m in metrics if m != "psnr"},
            ms=RunTime.from_json(entry.get("ms")),
            by_cause=_causes(entry.get("by_cause")),
            by_distance={int(k): v for k, v in distances if k is not None and math.isfinite(k)},
            stages={str(k): RunTime.from_json(v) for k, v in mapping(entry.get("stages")).items()},
            left_out={str(k): [str(i) for i in (v if isinstance(v, (list, tuple)) else [v])] for k, v in left_out},
            frames=frames("frames"),
            rendered=frames("rendered"),
            inputs=None if inputs is None or not math.isfinite(inputs) else int(inputs),
        )


@dataclasses.dataclass(frozen=True)
class InputResult:
    """One of several inputs.

    Attributes:
        input: its name.
        folder: of its own results, beside those over all.
        size: `(H, W)`.
        hdr: see `Results`.
        frames: how many were scored.
        methods: the scores, without single frames.
        skipped: methods that could not be scored, and why.
    """

    input: str
    folder: str
    size: tuple[int, int] | None
    hdr: bool | None
    frames: int | None
    methods: Mapping[str, MethodResult]
    skipped: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        left = ("inputs", "stages", "left_out", "frames", "rendered")
        methods = {n: {k: v for k, v in m.to_json().items() if k not in left} for n, m in self.methods.items()}
        size = None if self.size is None else list(self.size)
        found = {"input": self.input, "folder": self.folder, "size": size, "hdr": self.hdr, "frames": self.frames}
        return found | {"methods": methods, "skipped": dict(self.skipped)}

    @classmethod
    def from_json(cls, value: Any, metrics: Any = ("ssim",)) -> "InputResult":
        entry = mapping(value)
        folder, frames = entry.get("folder"), number(entry.get("frames"))
        return cls(
            input=str(entry.get("input") or ""),
            folder=folder if isinstance(folder, str) else "",
            size=_size(entry.get("size")),
            hdr=entry.get("hdr") if isinstance(entry.get("hdr"), bool) else None,
            frames=int(frames) if frames is not None and math.isfinite(frames) else None,
            methods={str(n): MethodResult.from_json(m, metrics) for n, m in mapping(entry.get("methods")).items()},
            skipped={str(k): str(v) for k, v in mapping(entry.get("skipped")).items()},
        )


def _size(value: Any) -> tuple[int, int] | None:
    size = [number(v) for v in items(value)]
    if len(size) != 2 or any(v is None or not math.isfinite(v) for v in size):
        return None
    return int(size[0] or 0), int(size[1] or 0)


@dataclasses.dataclass(frozen=True)
class Results:
    """What methods are worth on an input, or on several.

    Attributes:
        input: its name.
        machine: what times depend on, see `jaxtrapolate.runtime.timing.machine`.
        size: `(H, W)` of the frames that were scored; `None` where inputs differ.
        hdr: whether colour is scored after x / (1 + x) and gamma 1 / 2.2, or in sRGB; `None` where inputs differ.
        settings: what was asked for, and versions.
        metrics: the metrics that were scored, by name.
        methods: the scores by method.
        frames: the numbers of the frames that were scored.
        notes: what a reader should know, one line each.
        skipped: methods that were asked for and could not be scored, and why.
        pictures: of single frames, paths relative to the folder of the results.
        video: its path, likewise.
        inputs: where there are several, each of them.
        failed: inputs that could not be used, and why.
    """

    input: str
    machine: Mapping[str, Any]
    size: tuple[int, int] | None
    hdr: bool | None
    settings: Mapping[str, Any]
    metrics: Mapping[str, MetricInfo]
    methods: Mapping[str, MethodResult]
    frames: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()
    skipped: Mapping[str, str] = dataclasses.field(default_factory=dict)
    pictures: tuple[Mapping[str, Any], ...] = ()
    video: str | None = None
    inputs: tuple[InputResult, ...] = ()
    failed: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """As `json` and `from_json` take it; infinite numbers are floats."""
        found: dict[str, Any] = {
            "input": self.input,
            "machine": dict(self.machine),
            "size": None if self.size is None else list(self.size),
            "hdr": self.hdr,
            "settings": dict(self.settings),
            "metrics": {name: m.to_json() for name, m in self.metrics.items()},
            "notes": list(self.notes),
            "methods": {name: m.to_json() for name, m in self.methods.items()},
            "skipped": dict(self.skipped),
        }
        if self.inputs:
            return found | {"inputs": [i.to_json() for i in self.inputs], "failed": dict(self.failed)}
        found |= {"frames": list(self.frames), "pictures": list(self.pictures)}
        return found | ({} if self.video is None else {"video": self.video})

    @classmethod
    def from_json(cls, value: Any) -> "Results":
        """What `to_json` gave, or a JSON file of any age: what is absent is `None` or empty."""
        entry = mapping(value)
        stated = mapping(entry.get("metrics")) if "metrics" in entry else {"ssim": {}}
        metrics = {str(n): MetricInfo.from_json(m) for n, m in stated.items()}
        numbers = (number(n) for n in items(entry.get("frames")))
        return cls(
            input=str(entry.get("input") or ""),
            machine=dict(mapping(entry.get("machine"))),
            size=_size(entry.get("size")),
            hdr=entry.get("hdr") if isinstance(entry.get("hdr"), bool) else None,
            settings=dict(mapping(entry.get("settings"))),
            metrics=metrics,
            methods={str(n): MethodResult.from_json(m, metrics) for n, m in mapping(entry.get("methods")).items()},
            frames=tuple(int(n) for n in numbers if n is not None and math.isfinite(n)),
            notes=tuple(str(n) for n in items(entry.get("notes"))),
            skipped={str(k): str(v) for k, v in mapping(entry.get("skipped")).items()},
            pictures=tuple(mapping(p) for p in items(entry.get("pictures"))),
            video=entry.get("video") if isinstance(entry.get("video"), str) else None,
            inputs=tuple(InputResult.from_json(i, metrics) for i in items(entry.get("inputs"))),
            failed={str(k): str(v) for k, v in mapping(entry.get("failed")).items()},
        )
