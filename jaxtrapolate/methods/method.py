"""What a method is: a list of named stages over one set of values.

The run, the benchmark, the plan and the reports all read that one list. A stage is a pure function of the method's
state (its weights and options) and of the values that it takes, a dict; it returns those that it gives. A method starts
with "carry", "history", "target" and "future", frames whose depth is +inf where no surface was hit, and ends with
"image". A target with colour is a rendered frame: its stages start with that as "image". A stage with memory gives a
new "carry". A stage on the host (a library that is not JAX) is run between the compiled ones around it.

What is given by name to whom is checked when a method is put together: what is taken is given before, by a stage that
is always there, or may be absent. An optional stage that takes what a stage gives that is left out is left out with it.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from itertools import groupby
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_choice, missing_package
from jaxtrapolate.methods.frames import Frames, buffer, cast, rendered, upcoming
from jaxtrapolate.methods.options import Option, options_of, replaced
from jaxtrapolate.methods.stage import Stage, Values, listed
from jaxtrapolate.ops.depth import surfaces
from jaxtrapolate.ops.jitter import on_own_pixels
from jaxtrapolate.records import Frame, check_frame, record

Precision = Literal["float32", "bfloat16", "float16"]
"""What a method may work in, whatever its frames are in."""


@record
@dataclasses.dataclass(frozen=True)
class State:
    """What a stage is given beside the values: a method's weights, and its options as `settings`."""

    weights: Any = ()
    settings: Any = ()


def _run(stages: Sequence[Stage], state: Any, values: Values) -> dict[str, Any]:
    """What some stages add to the values, one after the other."""
    added: dict[str, Any] = {}
    for stage in stages:
        added |= stage(state, {**values, **added})
    return added


@dataclasses.dataclass(frozen=True, eq=False)
class Method:
    """Generates a frame from those around it: `image = method(history, target, future=())`.

    history and future are tuples of `Frame` in order of display, oldest first; a frame may lack colour (only its
    buffers were drawn): motion chains through it. target is the `Frame` to be generated: its time, and whatever buffers
    were drawn for it. A target that has colour was rendered; a method has stages for those if it super samples or
    remembers, and returns them unchanged if it has none.

    No frame may be left out between those handed over: each one's motion leads to the one before it here, also from
    future[0] to the target (to history[-1] where the target has no motion), and from the target to history[-1]. Of a
    sequence whose motion leads from frame to frame, that is every frame from the oldest to the newest that is taken,
    with colour or without; `neighbours` says which. That cannot be checked here: times are traced, and need not be
    there. What a frame shows of nothing (depth that is not positive or infinite, or the sky) is far in every stage, see
    `jaxtrapolate.ops.depth`.

    Attributes:
        name: as `jaxtrapolate.load` knows it.
        stages: in order of execution.
        kind: "extrapolation" uses the past only, "interpolation" the future too.
        past: how many rendered frames of history it takes at most; with fewer it leaves out what needs them.
        future: how many rendered frames that follow the target it takes at most.
        scale: output size over input size.
        weights: a pytree.
        settings: its options, an instance of a class that `jaxtrapolate.methods.options.settings` decorates.
        defaults: its options as it was made, which weights may say; `None` = `settings`.
        dtype: what the stages work in: colours and buffers are cast to it, and the image to what the colours were in.
            Motion, depth, position, stencil, cameras and times keep their dtype. `None` = nothing is cast.
        networks: the networks on their own, by name: pure functions `(weights, *inputs) -> output` of one frame.
        start: `(history, target) -> carry`, for methods with memory: these are to be given every frame in order of
            display, the rendered ones too.
    """

    name: str
    stages: tuple[Stage, ...]
    kind: Literal["extrapolation", "interpolation"] = "extrapolation"
    past: int = 1
    future: int = 0
    scale: int = 1
    weights: Any = ()
    settings: Any = ()
    defaults: Any = None
    dtype: Precision | None = None
    networks: Mapping[str, Callable[..., Any]] = dataclasses.field(default_factory=dict)
    start: Callable[[Frames, Frame], Any] | None = None

    def __post_init__(self):
        if self.defaults is None:
            object.__setattr__(self, "defaults", self.settings)
        if self.dtype is not None:
            check_choice("dtype", self.dtype, get_args(Precision))
        names = [stage.name for stage in self.stages]
        if len(set(names)) < len(names):
            raise ValueError(f"method {self.name!r}: expected stages with names of their own, got {', '.join(names)}")
        for stage in self.stages:
            members = sum(stage.group == other.group for other in self.stages)
            if stage.group is not None and (members < 2 or not stage.optional):
                where = f"method {self.name!r}, stage {stage.name!r}"
                raise ValueError(f"{where}: expected group {stage.group!r} to have several stages, all optional")
        if self.scale != 1 and not self._for("rendered"):
            raise ValueError(f"method {self.name!r}: expected stages that super sample rendered frames too, got none")
        for kind in ("generated", "rendered"):
            if stages := self._for(kind):
                self._check_values(stages, self._begin(kind))

    def _check_values(self, stages: Sequence[Stage], begin: set[str]) -> None:
        """Raise unless every value that a stage needs is given before it, to the end also the image."""
        certain, possible = set(begin), set(begin)
        for stage in stages:
            for value in sorted(stage.needs - (possible if stage.optional else certain)):
                which = "only optional stages give" if value in possible else "no stage gives"
                raise ValueError(
                    f"method {self.name!r}, stage {stage.name!r}: takes {value!r}, which {which} before it"
                )
            possible |= set(stage.gives)
            if not stage.optional:
                certain |= set(stage.gives)
        if "image" not in certain:
            raise ValueError(f"method {self.name!r}: expected a stage that gives 'image' and is not optional, got none")

    def _for(self, kind: str) -> tuple[Stage, ...]:
        """The stages for targets of a kind, "generated" or "rendered"."""
        return tuple(stage for stage in self.stages if stage.on in (kind, "both"))

    def _begin(self, kind: str) -> set[str]:
        """The names of what the first stage gets."""
        names = {"carry", "history", "target", "future"}
        return names | {"image"} if kind == "rendered" and self.scale == 1 else names

    @property
    def state(self) -> State:
        """What `function` is given: the weights and the options. Its real-valued options are leaves of this pytree."""
        return State(self.weights, self.settings)

    @property
    def options(self) -> tuple[Option, ...]:
        """Its options: name, default, current value, range or choices, whether static, and what they do."""
        return options_of(self.settings, self.defaults)

    def replace(self, **options: Any) -> "Method":
        """This method with other options; real-valued ones change without compiling anew.

        Raises:
            ValueError: an unknown option, or a value of another kind or out of range; lists the options.
        """
        return self._changed(settings=replaced(f"method {self.name!r}", self.settings, options))

    def with_weights(self, weights: Any) -> "Method":
        """This method with other weights of the same structure and shapes, without compiling anew."""
        return self._changed(weights=weights)

    def _changed(self, **fields: Any) -> "Method":
        """With other fields that `state` holds: what is compiled does not hold them."""
        changed = dataclasses.replace(self, **fields)
        for name in ("_jitted", "_first_values", "_compiled_rows", "jitted_stages"):
            changed.__dict__[name] = getattr(self, name)
        return changed

    @property
    def memory(self) -> bool:
        """Whether it has a carry, so that it is to be given every frame in order of display, the rendered ones too."""
        return self.start is not None

    def without(self, *names: str) -> "Method":
        """This method without some optional stages, those of their groups, and those that take what they give.

        Raises:
            ValueError: no stage of that name, or one that is not optional.
        """
        optional = {stage.name: stage for stage in self.stages if stage.optional}
        for name in names:
            if name not in optional:
                raise ValueError(
                    f"method {self.name!r}: expected one of its optional stages {listed(optional)}, got {name!r}"
                )
        gone = set(names)
        while True:
            groups = {optional[name].group for name in gone} - {None}
            rest = [stage for stage in self.stages if stage.name not in gone and stage.group not in groups]
            given = {name for stage in rest for name in stage.gives} | self._begin("rendered")
            gone = {stage.name for stage in self.stages if stage not in rest}
            if not (more := {stage.name for stage in rest if stage.optional and not stage.needs <= given}):
                return dataclasses.replace(self, stages=tuple(rest))
            gone |= more

    def missing(self, history: Frames, target: Frame, future: Frames = ()) -> dict[str, list[str]]:
        """What each stage that cannot run lacks: `{stage: [buffers]}`; of all for such a target, optional or not.

        Of one that lacks no buffer, the stage without which it is left out.
        """
        return self._chosen(history, target, future)[1]

    def _chosen(self, history: Frames, target: Frame, future: Frames) -> tuple[list[Stage], dict[str, list[str]]]:
        """The stages that can run on frames like these, and what those lack that cannot."""
        kind = "generated" if target.color is None else "rendered"
        stages = self._for(kind)
        lacks = {s.name: lacks for s in stages if (lacks := self._lacks(s, history, target, future))}
        while True:
            given, absent = self._begin(kind), {}  # the names of values; of stages left out those that give the others
            chosen, unneeded, more = [], set(), {}
            for stage in stages:
                lost = sorted(stage.needs - given)
                if stage.fallback and given >= set(stage.gives):
                    unneeded.add(stage.name)
                elif not stage.optional or not (lost or stage.name in lacks):
                    given |= set(stage.gives)  # without one that is not optional the method does not run at all
                    chosen.append(stage)
                else:
                    absent |= dict.fromkeys(stage.gives, stage.name)
                    more |= {stage.name: [f"{value} of stage {absent[value]!r}" for value in lost]} if lost else {}
            for stage in stages:
                fellows = [s.name for s in stages if s.group == stage.group and s not in chosen]
                if stage.group is not None and fellows:
                    more.setdefault(stage.name, [f"stage {fellows[0]!r}"])
            more = {name: what for name, what in more.items() if name not in lacks}
            if not more:
                named = [stage.name for stage in stages if stage.name in lacks and stage.name not in unneeded]
                return [s for s in chosen if s.name not in lacks], {name: lacks[name] for name in named}
            lacks |= more

    def active(self, history: Frames, target: Frame, future: Frames = ()) -> tuple[Stage, ...]:
        """The stages that run on frames like these; none where a rendered target is returned unchanged.

        Raises:
            ValueError: a stage that the method cannot do without lacks something, named in the message.
        """
        chosen, lacks = self._chosen(history, target, future)
        for stage in self.stages:
            if stage.name in lacks and not stage.optional:
                raise ValueError(f"method {self.name!r}, stage {stage.name!r}: missing {', '.join(lacks[stage.name])}")
        if target.color is None and not chosen:
            raise ValueError(f"method {self.name!r}: generates no frames, it only takes rendered ones")
        return tuple(chosen)

    def _lacks(self, stage: Stage, history: Frames, target: Frame, future: Frames) -> list[str]:
        sources = [history[i] for i in rendered(history)][: self.past]
        lacks = [] if len(sources) >= stage.past else [f"{stage.past} rendered frames in history"]
        if stage.extra is not None and (lacking := missing_package(stage.extra)):
            lacks.append(lacking)
        following = [future[i] for i in upcoming(future)][: self.future]
        roles = {"target": [target], "history": sources, "future": following, "newest": sources[:1]}
        newest, previous = (*rendered(history), -1, -1)[:2]
        oldest = min(rendered(history)[: self.past], default=-1)
        between = {
            "since_newest": history[newest + 1 :],
            "before_newest": history[previous + 1 : max(newest, 0)],
            "since_oldest": history[oldest + 1 : newest + 1],
            "before_next": future[: (*upcoming(future), len(future))[0]],
        }

        def there(source: str) -> bool:
            names, name = source.split(".")
            frames = [frame for role in names.split("+") for frame in (*roles.get(role, ()), *between.get(role, ()))]
            whole = all(roles[role] for role in names.split("+") if role in roles)
            return whole and all(buffer(frame, name) is not None for frame in frames)

        def said(source: str) -> str:
            names, name = source.split(".")
            return f"{name} in {' and '.join(names.split('+'))}" if "+" in names else source

        missing = [r.split("|") for r in stage.reads if not any(map(there, r.split("|")))]
        return lacks + [" or ".join(map(said, read)) for read in missing]

    def function(
        self, state: Any, carry: Any, history: Frames, target: Frame, future: Frames = ()
    ) -> tuple[Any, Float[Array, "i j 3"]]:
        """The pure function beneath: `(carry, image)`, for jit, grad, vmap, scan and sharding.

        Raises:
            TypeError: traced, in a method with a stage on the host: there is no such function of it.
            ValueError: see `active`; frames whose sizes differ, or for a target without colour a history without.
        """
        self._check(history, target, future)
        values = self._advance(self.active(history, target, future), state, carry, history, target, future)
        return values["carry"], self._answer(values["image"], history, target)

    def values_before(
        self, stage: str, state: Any, carry: Any, history: Frames, target: Frame, future: Frames = ()
    ) -> dict[str, Any]:
        """The values that a stage gets: what the stages before it have given, as a pure function like `function`.

        Training runs a network's inputs through it, under vmap and jit: `values_before("network", ...)["inputs"]`.

        Raises:
            TypeError, ValueError: as `function`; no stage of that name, or one that these frames leave out.
        """
        self._check(history, target, future)
        stages = self.active(history, target, future)
        names = [s.name for s in stages]
        if stage not in names:
            raise ValueError(f"method {self.name!r}: expected one of the stages {', '.join(names)}, got {stage!r}")
        return self._advance(stages[: names.index(stage)], state, carry, history, target, future)

    def first_values(self, carry: Any, history: Frames, target: Frame, future: Frames = ()) -> dict[str, Any]:
        """What the first stage gets.

        The frames, whose depth is +inf where no surface was hit (`surface_depth`), and whose motion and cameras lead to
        pixels where frames are jittered (`jaxtrapolate.ops.jitter`).
        """
        before = target if target.motion is not None or not history else history[-1]
        future = on_own_pixels((before, *future))[1:]
        frames = on_own_pixels((*history, target))
        history, target = frames[:-1], frames[-1]
        given, past, coming = (tuple(map(self._prepared, frames)) for frames in ((target,), history, future))
        values = {"carry": carry, "history": past, "target": given[0], "future": coming}
        return values if target.color is None or self.scale != 1 else values | {"image": jnp.asarray(target.color)}

    def _prepared(self, frame: Frame) -> Frame:
        frame = surfaces(frame)
        return frame if self.dtype is None else cast(frame, jnp.dtype(self.dtype))

    def _answer(self, image: Array, history: Frames, target: Frame) -> Array:
        """The image in the dtype that the colours had."""
        frame = history[rendered(history)[0]] if target.color is None else target
        return image if self.dtype is None else image.astype(frame.color.dtype)  # type: ignore[union-attr]

    def _advance(self, stages, state, carry, history, target, future) -> dict[str, Any]:
        values = self.first_values(carry, history, target, future)
        for stage in stages:
            if stage.host and any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((state, values))):
                raise TypeError(
                    f"method {self.name!r}, stage {stage.name!r}: runs on the host, where nothing can be traced; "
                    "call the method or its step outside of jit, grad and vmap"
                )
            values |= stage(state, values)
        return values

    def _by_turns(self, carry, history, target, future):
        """As `function`, each row of stages between those on the host compiled as one."""
        self._check(history, target, future)
        values: dict[str, Any] = self._first_values(carry, history, target, future)
        for host, group in groupby(self.active(history, target, future), key=lambda stage: stage.host):
            row = tuple(group)
            values |= _run(row, self.state, values) if host else self._rows(row)(self.state, values)
        return values["carry"], self._answer(values["image"], history, target)

    def _rows(self, row: tuple[Stage, ...]) -> Callable[[Any, Values], dict[str, Any]]:
        if row not in self._compiled_rows:
            self._compiled_rows[row] = jax.jit(partial(_run, row))
        return self._compiled_rows[row]

    @cached_property
    def _compiled_rows(self) -> dict[tuple[Stage, ...], Callable[[Any, Values], dict[str, Any]]]:
        return {}

    def _check(self, history, target, future):
        size = None
        for role, frames in (("history", history), ("future", future)):
            if not isinstance(frames, tuple):
                raise TypeError(f"{role}: expected a tuple of Frame, oldest first, got {type(frames).__name__}")
            for i, frame in enumerate(frames):
                size = check_frame(f"{role}[{i}]", frame, size=size)
        check_frame("target", target, size=size)
        if target.color is None and not rendered(history):
            raise ValueError(f"history: expected a frame with colour, got {len(history)} frames without")

    @cached_property
    def _first_values(self):
        return jax.jit(self.first_values)

    @cached_property
    def _jitted(self):
        return jax.jit(self.function)

    @cached_property
    def network(self) -> Callable[..., Any]:
        """The bare network with the method's weights, compiled: `(*inputs) -> output` of one frame.

        Raises:
            ValueError: the method has none, or several: `networks` has them by name.
        """
        if len(self.networks) != 1:
            raise ValueError(f"method {self.name!r}: expected one network, it has {', '.join(self.networks) or 'none'}")
        return partial(jax.jit(*self.networks.values()), self.weights)

    @cached_property
    def jitted_stages(self) -> dict[str, Callable[[Any, Values], dict[str, Any]]]:
        """Each stage on its own, compiled but for those on the host: for timing stage by stage."""
        return {stage.name: stage if stage.host else jax.jit(stage) for stage in self.stages}

    def init(self, history: Frames, target: Frame) -> Any:
        """The carry before the first step; `()` for methods without memory."""
        if self.start is None:
            return ()
        self._check(history, target, ())
        values = self.first_values((), history, target)
        return self.start(values["history"], values["target"])

    def step(
        self, carry: Any, history: Frames, target: Frame, future: Frames = ()
    ) -> tuple[Any, Float[Array, "i j 3"]]:
        """One frame, compiled: `(carry, image)`; anew only where sizes or the buffers that are there change."""
        host = any(stage.host for stage in self.stages)
        try:
            return (self._by_turns if host else partial(self._jitted, self.state))(carry, history, target, future)
        except TypeError:  # what is no array at all JAX refuses before any check, in words of its own
            self._check(history, target, future)
            raise

    def __call__(self, history: Frames, target: Frame, future: Frames = ()) -> Float[Array, "i j 3"]:
        """The image `[scale H, scale W, 3]`, linear radiance; for a method with memory, from a new start."""
        return self.step(self.init(history, target), history, target, future)[1]
