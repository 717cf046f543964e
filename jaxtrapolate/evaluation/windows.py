"""Held-back frames and the rendered ones around them.

A held-back frame's colour, shadow and sky colour are never seen by a method. The history is what was rendered; motion
chains over the held-back frames between by their buffers.
"""

import dataclasses
from collections.abc import Iterator

import jax

from jaxtrapolate.files import Sequence, around, prefetch, runs
from jaxtrapolate.methods.method import Method
from jaxtrapolate.records import Frame, record, replace


def hide(frame: Frame) -> Frame:
    """A frame as a method sees it before it is rendered: its buffers, without colour, shadow and sky colour."""
    buffers = frame.gbuffer
    if buffers is not None:
        buffers = replace(buffers, shadow=None, sky_color=None)
    return replace(frame, color=None, gbuffer=buffers)


@record
@dataclasses.dataclass(frozen=True)
class Window:
    """A held-back frame and what surrounds it: the true frame, and history, target and future as methods see them."""

    number: int
    truth: Frame
    history: tuple[Frame, ...]
    target: Frame
    future: tuple[Frame, ...]


def held_back(sequence: Sequence, *, past: int, future: int = 0) -> list[int]:
    """The numbers of the held-back frames that have `past` rendered frames before them and `future` behind them."""
    numbers = []
    for run in runs(sequence):
        numbers += [run[i] for i in range(1, len(run), 2) if i >= 2 * past - 1 and i + 2 * future - 1 < len(run)]
    return numbers


def windows(sequence: Sequence, numbers: list[int], *, past: int, future: int = 0) -> Iterator[Window]:
    """The held-back frames `numbers` with the frames around them, on the device; each frame is read once.

    Neighbours are those in a run, whatever the step of the numbering; every second one from a held-back frame on is
    held back, too.

    Raises:
        ValueError: fewer frames around one of them than a window has.
    """
    before, behind = 2 * past - 1, max(0, 2 * future - 1)
    groups = {n: around(sequence, n, before=before, behind=behind) for n in numbers}
    wanted = iter(numbers)
    number = next(wanted, None)
    cached: dict[int, Frame] = {}
    for i, frame in prefetch(sequence, sorted({i for group in groups.values() for i in group})):
        cached[i] = jax.device_put(frame)
        while number is not None and i == groups[number][-1]:
            group = groups[number]
            rendered = [cached[n] if (k - before) % 2 else hide(cached[n]) for k, n in enumerate(group)]
            yield Window(
                number=number,
                truth=cached[number],
                history=tuple(rendered[:before]),
                target=rendered[before],
                future=tuple(rendered[before + 1 :]),
            )
            number = next(wanted, None)
        if number is not None:
            cached = {k: f for k, f in cached.items() if k >= groups[number][0]}


def arguments(method: Method, window: Window) -> tuple[tuple[Frame, ...], Frame, tuple[Frame, ...]]:
    """History, target and future for a method: as many rendered frames as it wants, and no more."""
    history = window.history[-(2 * method.past - 1) :]
    return history, window.target, window.future[: max(0, 2 * method.future - 1)]
