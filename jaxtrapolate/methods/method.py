"""What a method is: a list of named stages over one set of values.

The run, the benchmark, the plan and the reports all read that one list. A stage is a pure function of the method's
state (its weights) and of the values so far, a dict; it returns the values that it adds. A method starts with "carry",
"history", "target" and "future", and ends with "image".
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, Literal

import jax
from jaxtyping import Array, Float

from jaxtrapolate.checks import ArrayLike
from jaxtrapolate.records import Frame, check_frame

Values = Mapping[str, Any]
Frames = tuple[Frame, ...]


@dataclasses.dataclass(frozen=True)
class Stage:
    """A named step of a method.

    Attributes:
        name: what reports call it.
        function: `(state, values) -> values to add`.
        reads: the buffers that it needs, as "target.depth" or "history.albedo" (in every rendered frame that the method
            takes); alternatives are separated by "|".
        optional: whether the method does without it: left out where a buffer is missing. Without a stage that is not
            optional the method cannot run.
        past: how many rendered frames it needs.
    """

    name: str
    function: Callable[[Any, Values], dict[str, Any]]
    reads: tuple[str, ...] = ()
    optional: bool = False
    past: int = 1


def buffer(frame: Frame, name: str) -> ArrayLike | None:
    """A buffer of a frame by name: "color", "motion", or one of its `GBuffer`."""
    if name in ("color", "motion", "camera", "jitter", "time"):
        return getattr(frame, name)
    return None if frame.gbuffer is None else getattr(frame.gbuffer, name)


def rendered(history: Sequence[Frame]) -> list[int]:
    """The places in a history of the frames with colour, newest first."""
    return [i for i in range(len(history) - 1, -1, -1) if history[i].color is not None]


@dataclasses.dataclass(frozen=True, eq=False)
class Method:
    """Makes a frame from those around it: `image = method(history, target, future=())`.

    history and future are tuples of `Frame` in order of display, oldest first; a frame may lack colour (only its
    buffers were drawn): motion chains through it. target is the `Frame` to be made: its time, and whatever buffers were
    drawn for it. A target that has colour was rendered, and is returned as it is by methods that do not super sample.

    Attributes:
        name: as `jaxtrapolate.load` knows it.
        stages: in order of execution.
        kind: "extrapolation" uses the past only, "interpolation" the future too.
        past, future: how many rendered frames it takes at most; with fewer it leaves out what needs them.
        scale: output size over input size.
        state: a pytree, the weights.
        start: `(history, target) -> carry`, for methods with memory.
    """

    name: str
    stages: tuple[Stage, ...]
    kind: Literal["extrapolation", "interpolation"] = "extrapolation"
    past: int = 1
    future: int = 0
    scale: int = 1
    state: Any = ()
    start: Callable[[Frames, Frame], Any] | None = None

    def missing(self, history: Frames, target: Frame, future: Frames = ()) -> dict[str, list[str]]:
        """What each stage that cannot run lacks: `{stage: [buffers]}`; of all stages, optional or not."""
        return {s.name: lacks for s in self.stages if (lacks := self._lacks(s, history, target, future))}

    def active(self, history: Frames, target: Frame, future: Frames = ()) -> tuple[Stage, ...]:
        """The stages that run on frames like these.

        Raises:
            ValueError: a stage that the method cannot do without lacks something, named in the message.
        """
        stages = []
        for stage in self.stages:
            lacks = self._lacks(stage, history, target, future)
            if not lacks:
                stages.append(stage)
            elif not stage.optional:
                raise ValueError(f"method {self.name!r}, stage {stage.name!r}: missing {', '.join(lacks)}")
        return tuple(stages)

    def _lacks(self, stage: Stage, history: Frames, target: Frame, future: Frames) -> list[str]:
        sources = [history[i] for i in rendered(history)][: self.past]
        lacks = [] if len(sources) >= stage.past else [f"{stage.past} rendered frames in history"]
        roles = {"target": [target], "history": sources, "future": list(future[: self.future])}

        def there(place: str) -> bool:
            role, name = place.split(".")
            frames = roles[role]
            return bool(frames) and all(buffer(frame, name) is not None for frame in frames)

        return lacks + [" or ".join(r.split("|")) for r in stage.reads if not any(map(there, r.split("|")))]

    def function(
        self, state: Any, carry: Any, history: Frames, target: Frame, future: Frames = ()
    ) -> tuple[Any, Float[Array, "i j 3"]]:
        """The pure function beneath: `(carry, image)`, for jit, grad, vmap, scan and sharding."""
        self._check(history, target, future)
        if target.color is not None and self.scale == 1:
            return carry, target.color
        values = {"carry": carry, "history": history, "target": target, "future": future}
        for stage in self.active(history, target, future):
            values |= stage.function(state, values)
        return values["carry"], values["image"]

    def _check(self, history, target, future):
        size = None
        for role, frames in (("history", history), ("future", future)):
            if not isinstance(frames, tuple):
                raise TypeError(f"{role}: expected a tuple of Frame, oldest first, got {type(frames).__name__}")
            for i, frame in enumerate(frames):
                size = check_frame(f"{role}[{i}]", frame, size=size)
        check_frame("target", target, size=size)
        if not rendered(history):
            raise ValueError(f"history: expected a frame with colour, got {len(history)} frames without")

    @cached_property
    def _jitted(self):
        return jax.jit(self.function)

    @cached_property
    def jitted_stages(self) -> dict[str, Callable[[Any, Values], dict[str, Any]]]:
        """Each stage on its own, compiled: for timing stage by stage."""
        return {stage.name: jax.jit(stage.function) for stage in self.stages}

    def init(self, history: Frames, target: Frame) -> Any:
        """The carry before the first step; `()` for methods without memory."""
        return () if self.start is None else self.start(history, target)

    def step(
        self, carry: Any, history: Frames, target: Frame, future: Frames = ()
    ) -> tuple[Any, Float[Array, "i j 3"]]:
        """One frame, compiled: `(carry, image)`; anew only where sizes or the buffers that are there change."""
        return self._jitted(self.state, carry, history, target, future)

    def __call__(self, history: Frames, target: Frame, future: Frames = ()) -> Float[Array, "i j 3"]:
        """The image `[scale H, scale W, 3]`, linear radiance; for a method with memory, from a new start."""
        return self.step(self.init(history, target), history, target, future)[1]
