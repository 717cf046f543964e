"""The video of an evaluation: truth and methods side by side, rendered frames and generated ones in turn."""

from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Items
from pathlib import Path

import numpy as np
from PIL import Image

from jaxtrapolate.evaluation.pictures import Gallery, eight_bit
from jaxtrapolate.evaluation.schedule import Slot
from jaxtrapolate.evaluation.windows import load
from jaxtrapolate.files import Sequence
from jaxtrapolate.report import side_by_side, write_video


def write_evaluation_video(
    path: Path,
    sequence: Sequence,
    slots: Items[Slot],
    labels: Mapping[str, str],
    gallery: Gallery,
    *,
    fps: float | int,
) -> None:
    """Writes held-back frames, each newest rendered frame before them, and what methods generated.

    Args:
        path: of the video.
        sequence: the frames.
        slots: the held-back frames, in order of display.
        labels: what stands above each method's pictures, by its name.
        gallery: holds what the methods generated.
        fps: frames a second.
    """

    def shown() -> Iterator[list[np.ndarray]]:
        last = None
        for slot, window in load(sequence, slots):
            newest = slot.before[-slot.distance]
            if newest != last:
                yield [eight_bit(gallery.display(window.history[-slot.distance].color))] * (1 + len(labels))
            last = newest
            truth = eight_bit(gallery.display(window.truth.color))
            yield [truth, *(gallery.codes(name, slot.number) for name in labels)]

    def alike(row: list[np.ndarray]) -> list[np.ndarray]:
        """All of the largest one's size, by repeated pixels."""
        height = max(picture.shape[0] for picture in row)
        return [p.repeat(height // p.shape[0], 0).repeat(height // p.shape[0], 1) for p in row]

    starts = {slot.before[-slot.distance] for slot in slots}
    frames: Iterator[Image.Image] = (side_by_side(alike(row), ["truth", *labels.values()]) for row in shown())
    write_video(path, frames, count=len(slots) + len(starts), fps=fps)
