"""A sequence of frames on disk or from a scene: the one interface between inputs and everything else.

A further reader is one file with one subclass of `Sequence`, named in `jaxtrapolate.files.open_sequence`.
"""

import abc
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np

from jaxtrapolate.errors import InputError
from jaxtrapolate.records import DepthOrAbsent, Frame, Keyframe, Sign, Units, YAxis


@dataclasses.dataclass(frozen=True)
class MotionConvention:
    """How a file states motion vectors; the fields are the options of `jaxtrapolate.convert_motion`.

    The default is the library's own convention: pixels to add, y down, to reach the previous frame.
    """

    sign: Sign = "previous_minus_current"
    units: Units = "pixels"
    y_axis: YAxis = "down"

    def __str__(self) -> str:
        return f"{self.sign},{self.units},{self.y_axis}"

    @classmethod
    def parse(cls, text: str, *, base: "MotionConvention | None" = None) -> "MotionConvention":
        """From "current_minus_previous,pixels,up": up to three words in any order, separated by commas.

        What the text does not say is taken from `base`, by default the library's own convention.
        """
        fields = {}
        for word in filter(None, (w.strip() for w in text.split(","))):
            for field, choices in (("sign", get_args(Sign)), ("units", get_args(Units)), ("y_axis", get_args(YAxis))):
                if word in choices:
                    fields[field] = word
                    break
            else:
                valid = ", ".join(get_args(Sign) + get_args(Units) + get_args(YAxis))
                raise InputError(f"motion convention {text!r}: {word!r} is not one of {valid}")
        return dataclasses.replace(base or cls(), **fields)


class Sequence(abc.ABC):
    """Frames by number, read lazily; every leaf is a NumPy float32 array.

    Attributes:
        name: of the input, for reports.
        numbers: of the frames that are there, ascending, negative ones too; a gap resets a method's history.
        step: how far apart the numbers of neighbouring frames are (2 where every second frame was rendered); gaps and
            runs are counted in it, and motion leads to the frame `step` before.
        size: `(H, W)`.
        hdr: whether colour is HDR (scored after x / (1 + x) and gamma 1 / 2.2, written as EXR) or 8-bit sRGB
            (scored in sRGB, written as PNG). `Frame.color` is linear either way.
        convention: how the stored motion vectors are stated; `frame` has converted them.
        depth: "metric" (in the unit of position), "ordinal" (larger = farther, and no more than that) or "absent".
        cuts: numbers of frames that begin another shot: no motion leads from them to the frame before, and a method's
            history and memory start anew.
        larger: the same frames rendered larger, by a whole factor: what methods that super sample are compared with.
        forward_motion: whether `keyframe` gives flows to the next frame as well.
        notes: what the reader did that a user should know, one line each ("frame 0 left out: ..."); reading frames may
            add to it.
    """

    name: str
    numbers: tuple[int, ...]
    size: tuple[int, int]
    hdr: bool
    convention: MotionConvention
    depth: DepthOrAbsent
    step: int = 1
    cuts: tuple[int, ...] = ()
    larger: "Sequence | None" = None
    forward_motion: bool = False
    notes: tuple[str, ...] = ()

    @property
    def scale(self) -> int:
        """How many times larger `larger` is in each direction, 1 where there is none."""
        return 1 if self.larger is None else self.larger.size[0] // self.size[0]

    @abc.abstractmethod
    def frame(self, number: int) -> Frame:
        """The frame with every buffer that is there; colour `None` where only buffers were drawn; time its number.

        Depth is +inf where nothing was hit, and ids of the stencil are integers that float32 tells apart. Non-finite
        pixels have been replaced as `jaxtrapolate.files.repair` says.
        """

    def files(self, number: int) -> Mapping[str, Path]:
        """The file of each stored buffer of a frame; none where frames are not read from files."""
        return {}

    def identity(self) -> dict[str, Any]:
        """What, besides the content of `files`, decides about what frames hold: what JSON holds, the same in a copy.

        The name is part of it where there are no files.
        """
        read = {} if self.files(self.numbers[0]) else {"input": self.name}
        read |= {"size": list(self.size), "hdr": self.hdr, "depth": self.depth, "motion": str(self.convention)}
        read |= {"cuts": list(self.cuts)} if self.cuts else {}
        return read if self.larger is None else read | {"larger": self.larger.identity()}

    def has_color(self, number: int) -> bool:
        """Whether the frame has colour, without reading it."""
        return True

    def stored_motion(self, number: int) -> np.ndarray | None:
        """The motion vectors `[H, W, 2]` as they are stored, before `convention` is applied."""
        return None

    def keyframe(self, number: int) -> Keyframe | None:
        """The frame's 3D flows to its neighbours in the numbering, `None` where the input has none.

        Flows are in the library's convention, the change of depth in the unit of position. They are finite: where a
        stored one is not, the nearest finite one stands in.
        """
        return None

    def invalid(self, number: int) -> np.ndarray | None:
        """The pixels, bool `[H, W]`, non-finite in some buffer or of alpha 0; `None` where there is none.

        They hold made-up values (`jaxtrapolate.files.repair`), so scores leave them out.
        """
        return None

    def no_depth(self, number: int) -> dict[str, int]:
        """How many pixels of the frame have no depth and are taken for infinitely far, by why ("not positive", ...)."""
        return {}

    def stored_id(self, number: int) -> int | str:
        """An id of the stencil as the input states it: a number, or the hexadecimal digits of its bits."""
        return number

    def nonfinite(self, number: int) -> int:
        """How many pixels of the frame had a non-finite value in some buffer, or alpha 0."""
        return 0
