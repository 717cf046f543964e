"""The frames that a method is handed: which of them are rendered, what they have, and which those of a sequence are."""

import dataclasses
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxtrapolate.records import Frame, replace

Frames = tuple[Frame, ...]


def buffer(frame: Frame, name: str) -> Any:
    """What a frame has by name, or `None`: one of its own fields, or a buffer of its `GBuffer`."""
    if name in ("color", "motion", "camera", "jitter", "time", "objects"):
        return getattr(frame, name)
    return None if frame.gbuffer is None else getattr(frame.gbuffer, name)


_KEPT = ("depth", "position", "stencil")


def cast(frame: Frame, dtype: Any) -> Frame:
    """A frame whose colour and buffers are of a dtype, but for depth, position and stencil, which need their digits."""
    buffers, given = frame.gbuffer, None
    if buffers is not None:
        there = {f.name: getattr(buffers, f.name) for f in dataclasses.fields(buffers) if f.name not in _KEPT}
        given = replace(buffers, **{n: jnp.asarray(v, dtype) for n, v in there.items() if v is not None})
    return replace(frame, color=None if frame.color is None else jnp.asarray(frame.color, dtype), gbuffer=given)


def newest_color(history: Frames, target: Frame) -> Array:
    """The colour of the newest frame that has one, the target included.

    Raises:
        ValueError: none has.
    """
    colors = [frame.color for frame in (*history, target) if frame.color is not None]
    if not colors:
        raise ValueError(f"history: expected a frame with colour, got {len(history)} frames without")
    return jnp.asarray(colors[-1])


def rendered(history: Sequence[Frame]) -> list[int]:
    """The indices in a history of the frames with colour, newest first."""
    return [i for i in range(len(history) - 1, -1, -1) if history[i].color is not None]


def upcoming(future: Sequence[Frame]) -> list[int]:
    """The indices in a future of the frames with colour, the next first."""
    return [i for i, frame in enumerate(future) if frame.color is not None]


def neighbours(
    colored: Sequence[bool],
    index: int,
    *,
    past: int = 1,
    future: int = 0,
    numbers: Sequence[int | float] | None = None,
) -> tuple[range, range]:
    """Which frames of a sequence a method is to be handed as history and future, for the frame at `index`.

    Back to the `past`-th rendered frame before it and on to the `future`-th after it, all frames between included, so
    that motion chains through those without colour; what is beyond the last rendered frame is left out. Where `numbers`
    step over frames nothing on the other side is taken: no motion leads across.

    Args:
        colored: of each frame whether it has colour.
        index: of the frame to be generated, into `colored`.
        past: how many rendered frames before it, as the `Method` wants.
        future: how many rendered frames after it.
        numbers: of the frames (or their times), ascending by one per frame; `None` where none is missing.

    Returns:
        Two ranges of indices: `history = [frames[i] for i in first]`. Empty where there is no rendered frame; shorter
        where there are fewer.

    Raises:
        ValueError: `index` is none of `colored`, or numbers of another length or that do not ascend.
    """
    count = len(colored)
    if not 0 <= index < count:
        raise ValueError(f"index: expected 0 to {count - 1}, got {index}")
    numbers = range(count) if numbers is None else numbers
    if len(numbers) != count:
        raise ValueError(f"numbers: expected {count} as there are frames, got {len(numbers)}")
    steps = [later - earlier for earlier, later in pairwise(numbers)]
    if any(step <= 0 for step in steps):
        raise ValueError(f"numbers: expected each above the one before, got {list(numbers)}")

    def last(indices: range, wanted: int) -> int | None:
        """The index of the `wanted`-th rendered frame, or of the last before a gap."""
        found = None
        for i in indices:
            step = steps[i] if i < index else steps[i - 1]
            if wanted == 0 or step > 1:
                break
            if colored[i]:
                found, wanted = i, wanted - 1
        return found

    first, final = last(range(index - 1, -1, -1), past), last(range(index + 1, count), future)
    return range(index if first is None else first, index), range(index + 1, index + 1 if final is None else final + 1)
