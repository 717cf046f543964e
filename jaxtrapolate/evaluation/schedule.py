"""What is shown when: the frames of a sequence in order of display, and what a method may see to generate each.

Three schedules: every N-th frame is rendered and those between are held back (`held_back_slots`); frames without colour
are generated from the buffers drawn for them (`missing_slots`); frames are put between or after rendered ones, for
which nothing was drawn (`virtual_slots`). Each run of frames without a gap or a cut starts anew.
"""

import dataclasses
import itertools
from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from collections.abc import Sequence as Items
from fractions import Fraction
from typing import Literal

from jaxtrapolate.files import Sequence, runs

Virtual = Literal["between", "onward"]


@dataclasses.dataclass(frozen=True)
class Slot:
    """A frame in order of display, by the numbers of the frames that a method may see.

    Attributes:
        number: of the frame; of the rendered frame before it where nothing was drawn for it.
        before: the numbers of history, oldest first: back to the oldest rendered frame that is wanted.
        behind: the numbers of future: on to the last rendered frame that is wanted.
        rendered: whether the frame is rendered, so that a method only takes note of it, or super samples it.
        first: whether nothing comes before it: the first of the sequence, or after a gap or a cut.
        full: whether as many rendered frames are around it as were asked for.
        distance: how many frames it is after the newest rendered one; 0 for a rendered frame.
        fraction: of the step from `number` to the next frame, for a frame for which nothing was drawn.
        virtual: how such a frame's target is had: "between", its time alone, the next rendered frame being the future;
            "onward", the newest frame's buffers carried on by their motion. `None` where the frame was drawn.
    """

    number: int
    before: tuple[int, ...]
    behind: tuple[int, ...]
    rendered: bool
    first: bool
    full: bool
    distance: int = 0
    fraction: Fraction = Fraction(0)
    virtual: Virtual | None = None

    @property
    def numbers(self) -> tuple[int, ...]:
        """The frames that it takes to load it, ascending."""
        return (*self.before, self.number, *self.behind)


def _slots(run: Items[int], colored: Items[bool], past: int, future: int) -> Iterator[Slot]:
    """The frames of a run, by whether each is rendered."""
    rendered = [i for i, has in enumerate(colored) if has]
    for i, number in enumerate(run):
        earlier, later = bisect_left(rendered, i), bisect_right(rendered, i)
        start = rendered[max(0, earlier - past)] if earlier and past else i
        stop = rendered[min(len(rendered), later + future) - 1] if future and later < len(rendered) else i
        yield Slot(
            number=number,
            before=tuple(run[start:i]),
            behind=tuple(run[i + 1 : stop + 1]),
            rendered=colored[i],
            first=i == 0,
            full=earlier >= past and len(rendered) - later >= future,
            distance=0 if colored[i] or not earlier else i - rendered[earlier - 1],
        )


def held_back_slots(sequence: Sequence, *, past: int, future: int = 0, factor: int = 2) -> list[Slot]:
    """All frames, of which the first of every `factor` counts as rendered and the others are held back.

    Args:
        sequence: the frames.
        past: rendered frames of history that are wanted.
        future: rendered frames after the frame that are wanted.
        factor: frame rate out over frame rate in.

    Raises:
        ValueError: a factor below 2.
    """
    if factor < 2:
        raise ValueError(f"factor: expected 2 or more, got {factor}")
    found: list[Slot] = []
    for run in runs(sequence):
        found += _slots(run, [i % factor == 0 for i in range(len(run))], past, future)
    return found


def missing_slots(sequence: Sequence, *, past: int, future: int = 0) -> list[Slot]:
    """All frames, of which those with colour count as rendered; the others have buffers alone.

    Args:
        sequence: the frames.
        past: rendered frames of history that are wanted.
        future: rendered frames after the frame that are wanted.
    """
    return [s for run in runs(sequence) for s in _slots(run, [sequence.has_color(n) for n in run], past, future)]


def virtual_slots(sequence: Sequence, virtual: Virtual, *, past: int, factor: int) -> list[Slot]:
    """All frames, which are rendered, and `factor` - 1 after each for which nothing was drawn.

    Args:
        sequence: the frames, all with colour.
        virtual: how the targets are had, see `Slot`; none of "between" comes after a run's last frame.
        past: rendered frames of history that are wanted.
        factor: frame rate out over frame rate in.
    """
    found: list[Slot] = []
    for run in runs(sequence):
        for i, slot in enumerate(_slots(run, [True] * len(run), past, 0)):
            found.append(slot)
            if virtual == "between" and i + 1 == len(run):
                break
            generated = dataclasses.replace(
                slot,
                before=tuple(run[max(0, i + 1 - past) : i]),
                behind=(run[i + 1],) if virtual == "between" else (),
                rendered=False,
                first=False,
                full=i + 1 >= past,
                virtual=virtual,
            )
            for k in range(1, factor):
                found.append(dataclasses.replace(generated, distance=k, fraction=Fraction(k, factor)))
    return found


def needed_slots(slots: Items[Slot], wanted: Items[bool], *, memory: bool) -> list[bool]:
    """Which frames a method has to be shown for some to be generated.

    Args:
        slots: in order of display.
        wanted: of each, whether it is to be generated.
        memory: whether the method has one: then every frame from the start of the run to the last that is wanted.
    """
    if not memory:
        return list(wanted)
    needed = list(wanted)
    starts = [i for i, slot in enumerate(slots) if slot.first] + [len(slots)]
    for start, stop in itertools.pairwise(starts):
        last = max((i for i in range(start, stop) if wanted[i]), default=start - 1)
        needed[start : last + 1] = [True] * (last + 1 - start)
    return needed
