"""How long methods take on this machine: measured on request, and kept in the user's cache folder."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import platformdirs

from jaxtrapolate._version import __version__
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.stages import time_method
from jaxtrapolate.evaluation.windows import arguments, held_back, windows
from jaxtrapolate.files import Sequence
from jaxtrapolate.methods import Method
from jaxtrapolate.results import RunTime, items, mapping
from jaxtrapolate.runtime.output import read_json, write_json
from jaxtrapolate.runtime.timing import machine

REPEATS = 5
"""Calls that a median is of."""


@dataclasses.dataclass(frozen=True)
class MethodTimes:
    """What methods took, on which machine.

    Attributes:
        size: `(H, W)` of the input's frames.
        machine: its processor, how many of its cores were used, its graphics processor if JAX used one.
        version: of this package.
        ms: milliseconds a frame, by method.
    """

    size: tuple[int, int]
    machine: str
    version: str
    ms: Mapping[str, RunTime]

    def __str__(self) -> str:
        """Where the times come from, in words."""
        size = f"{self.size[1]}x{self.size[0]}"
        return f"median of {REPEATS} calls at {size}, on {self.machine}, by jaxtrapolate {self.version}"

    def with_earlier(self, earlier: "MethodTimes | None") -> "MethodTimes":
        """These times, and those of other methods that were measured in the same way."""
        if earlier is None or dataclasses.replace(earlier, ms=self.ms) != self:
            return self
        return dataclasses.replace(self, ms={**earlier.ms, **self.ms})

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self) | {"ms": {name: time.to_json() for name, time in self.ms.items()}}

    @classmethod
    def from_json(cls, value: Any) -> "MethodTimes | None":
        """From a mapping; `None` where it is none of this shape."""
        value = mapping(value)
        sides = [int(side) for side in items(value.get("size")) if isinstance(side, int)]
        texts = str(value.get("machine")), str(value.get("version"))
        ms = {str(name): RunTime.from_json(time) for name, time in mapping(value.get("ms")).items()}
        return cls((sides[0], sides[1]), *texts, ms) if len(sides) == 2 else None


def measure_methods(sequence: Sequence, methods: Mapping[str, Method]) -> MethodTimes:
    """Times each method on one held-back frame; those that cannot run on it have no time.

    Args:
        sequence: the frames, enough in a row for the longest history.
        methods: by name.
    """
    past, future = max(m.past for m in methods.values()), max(m.future for m in methods.values())
    number = held_back(sequence, past=past, future=future)[0]
    (window,) = windows(sequence, [number], past=past, future=future)
    found: dict[str, RunTime] = {}
    for name, method in methods.items():
        try:
            method.active(*arguments(method, window))
        except ValueError:
            continue
        timing = time_method(method, window, repeats=REPEATS)
        found[name] = RunTime(timing.median, timing.iqr, runs=len(timing.runs))
    return MethodTimes(sequence.size, _machine(), __version__, found)


def _machine() -> str:
    known = machine()
    cores = f"{known['cores_used']} core{'s' if known['cores_used'] != 1 else ''} of {known['cpu']}"
    return f"{known['gpu']} ({cores})" if known["gpu"] else cores


def _path() -> Path:
    return Path(platformdirs.user_cache_dir("jaxtrapolate", appauthor=False)) / "method_times.json"


def kept_times() -> MethodTimes | None:
    """The times that were measured last by this user, if any."""
    try:
        return MethodTimes.from_json(read_json(_path()))
    except InputError:
        return None


def keep_times(times: MethodTimes) -> None:
    """Keeps times, in place of those measured otherwise."""
    path = _path()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, times.with_earlier(kept_times()).to_json())
