"""What a stage is: a named, pure function from the values that it takes to those that it gives."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal

import jax
from jaxtyping import Array, Bool

Values = Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Needed:
    """On which frames a stage is needed at all; on others it is not run.

    Compiled as a branch, of which one side runs: under vmap both do.

    Attributes:
        where: in words, as "there are holes".
        test: `(state, values) -> bool []`.
        instead: `(state, values) -> values`: what the stage would give on the others, of the same shapes and dtypes.
    """

    where: str
    test: Callable[[Any, Values], Bool[Array, ""]]
    instead: Callable[[Any, Values], dict[str, Any]]


@dataclasses.dataclass(frozen=True)
class Stage:
    """A named step of a method.

    Attributes:
        name: what reports call it.
        function: `(state, values) -> values`: from those that it takes to those that it gives.
        takes: the names of values; those that end in "?" are `None` where no stage before it gave them.
        gives: the names of the values that it returns, all of them; they replace what stages before it gave.
        reads: the buffers that it needs, as "target.depth"; "target+newest.normal" is needed in both, and alternatives
            are separated by "|". Frames are named "target"; "history" and "future", every rendered frame that the
            method takes; "newest", the newest of history; and what was not rendered, every frame if there is any, which
            motion chains through: "since_newest", in history after the newest rendered frame, "before_newest", between
            that and the rendered one before it, and "before_next", in future before the next rendered frame.
            "since_oldest" is all from after the oldest rendered frame that the method takes on to the newest, that too.
        optional: whether the method does without it: left out where a buffer is missing. Without a stage that is not
            optional the method cannot run.
        group: of optional stages that make sense together alone: if one is left out all of that name are.
        fallback: whether it only runs where what it gives was not given by stages before it.
        past: how many rendered frames it needs in history; 0 where its target or the carry is enough.
        on: the targets that it runs on: those that are generated (without colour), the rendered ones, or both.
        host: whether its function is no JAX code: it gets arrays and is never traced.
        extra: the optional dependency that it needs, as in `pip install "jaxtrapolate[extra]"`.
        needed: on which frames it is; `None` = on all. No part of one on the host.
    """

    name: str
    function: Callable[[Any, Values], dict[str, Any]]
    takes: tuple[str, ...]
    gives: tuple[str, ...]
    reads: tuple[str, ...] = ()
    optional: bool = False
    group: str | None = None
    fallback: bool = False
    past: int = 1
    on: Literal["generated", "rendered", "both"] = "generated"
    host: bool = False
    extra: str | None = None
    needed: Needed | None = None

    @property
    def needs(self) -> frozenset[str]:
        """The values that it cannot do without."""
        return frozenset(name for name in self.takes if not name.endswith("?"))

    def __call__(self, state: Any, values: Values) -> dict[str, Any]:
        """What it gives, from values among which are those that it takes.

        Raises:
            ValueError: its function returned others than it gives.
        """
        taken = {name: values[name] for name in self.needs}
        taken |= {name[:-1]: values.get(name[:-1]) for name in self.takes if name.endswith("?")}
        if self.needed is None:
            given = self.function(state, taken)
        else:
            test = self.needed.test(state, taken)
            given = jax.lax.cond(test, self.function, self.needed.instead, state, taken)
        if set(given) != set(self.gives):
            raise ValueError(f"stage {self.name!r}: expected to give {listed(self.gives)}, got {listed(given)}")
        return given


def listed(names: Iterable[str]) -> str:
    """Names in a message."""
    return ", ".join(sorted(names)) or "nothing"
