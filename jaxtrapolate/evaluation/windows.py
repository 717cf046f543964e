"""Frames and what surrounds them, as methods see them.

A held-back frame's colour, shadow and sky colour are never seen by a method. The history is what was rendered; motion
chains over the held-back frames between by their buffers.
"""

import dataclasses
from collections.abc import Collection, Iterable, Iterator

import jax

from jaxtrapolate.evaluation.schedule import Slot, held_back_slots
from jaxtrapolate.files import Sequence, prefetch
from jaxtrapolate.methods.frames import Frames, rendered, upcoming
from jaxtrapolate.methods.method import Method
from jaxtrapolate.ops.forecast import forecast
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
    """A frame to be generated and what surrounds it: history, target and future as methods see them.

    The truth is the frame itself, with all that is known of it; empty where nothing was drawn for it. `larger` is the
    same frame at the output's size, for methods that super sample, where the sequence has it.
    """

    number: int
    truth: Frame
    history: Frames
    target: Frame
    future: Frames
    larger: Frame | None = None


def held_back(sequence: Sequence, *, past: int, future: int = 0, factor: int = 2) -> list[int]:
    """The numbers of the held-back frames that have `past` rendered frames before them and `future` behind them."""
    slots = held_back_slots(sequence, past=past, future=future, factor=factor)
    return [slot.number for slot in slots if slot.full and not slot.rendered]


def windows(
    sequence: Sequence, numbers: Iterable[int], *, past: int, future: int = 0, factor: int = 2
) -> Iterator[Window]:
    """The held-back frames `numbers` with the frames around them, on the device; each frame is read once.

    Neighbours are those in a run, whatever the step of the numbering; of every `factor` frames the first is rendered.

    Raises:
        ValueError: a frame that is not held back, or fewer rendered frames around it than a window has.
    """
    slots = {s.number: s for s in held_back_slots(sequence, past=past, future=future, factor=factor) if not s.rendered}
    chosen = []
    for number in numbers:
        if number not in slots or not slots[number].full:
            raise ValueError(
                f"number {number}: expected a held-back frame with {past} rendered frames before and {future} behind it"
            )
        chosen.append(slots[number])
    for _, window in load(sequence, chosen, hidden=hidden(sequence, factor=factor)):
        yield window


def hidden(sequence: Sequence, *, factor: int = 2) -> set[int]:
    """The numbers of all frames that are held back where the first of every `factor` is rendered."""
    return {slot.number for slot in held_back_slots(sequence, past=0, factor=factor) if not slot.rendered}


def load(
    sequence: Sequence, slots: Iterable[Slot], *, hidden: Collection[int] = (), larger: bool = False
) -> Iterator[tuple[Slot, Window]]:
    """Frames of a schedule with what surrounds them, on the device; each frame of the input is read once.

    Args:
        sequence: the frames.
        slots: in order of display.
        hidden: the numbers of frames that are held back: their windows hold the truth, and `hide` of it elsewhere.
        larger: whether windows hold the frame at the output's size as well, where the sequence has it.
    """
    slots = list(slots)
    waiting = iter(slots)
    slot = next(waiting, None)
    cached: dict[int, Frame] = {}
    for number, frame in prefetch(sequence, sorted({n for s in slots for n in s.numbers})):
        cached[number] = jax.device_put(frame)
        while slot is not None and number == slot.numbers[-1]:
            window = _window(slot, cached, hidden, sequence.step)
            if larger and sequence.larger is not None and slot.virtual is None:
                window = replace(window, larger=jax.device_put(sequence.larger.frame(slot.number)))
            yield slot, window
            slot = next(waiting, None)
        if slot is not None:
            cached = {n: f for n, f in cached.items() if n >= slot.numbers[0]}


def _window(slot: Slot, frames: dict[int, Frame], hidden: Collection[int], step: int) -> Window:
    def seen(number: int) -> Frame:
        return hide(frames[number]) if number in hidden else frames[number]

    history, future = tuple(map(seen, slot.before)), tuple(map(seen, slot.behind))
    if slot.virtual is None:
        return Window(slot.number, frames[slot.number], history, seen(slot.number), future)
    newest = seen(slot.number)
    if slot.virtual == "between":
        target = Frame(time=slot.number + step * float(slot.fraction))
    else:
        target = jax.device_put(forecast(newest, float(slot.fraction)))
    return Window(slot.number, Frame(), (*history, newest), target, future)


def arguments(method: Method, window: Window) -> tuple[Frames, Frame, Frames]:
    """History, target and future for a method: as many rendered frames as it wants, and no more."""
    oldest, last = rendered(window.history)[: method.past], upcoming(window.future)[: method.future]
    history = window.history[oldest[-1] :] if oldest else ()
    return history, window.target, window.future[: last[-1] + 1] if last else ()
