"""What all readers of files share: which frame has which files, sizes, repair, conversion, and a memory of one frame.

A reader is a subclass of `FileSequence` that finds the files of each frame and reads one buffer from one file.
"""

import abc
import collections
import os
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxtrapolate.checks import Size
from jaxtrapolate.files.alpha import UNWRITTEN_NOTE, alpha_note, exr_alpha, without_empty
from jaxtrapolate.files.atomic import os_input_error
from jaxtrapolate.files.convention import convert
from jaxtrapolate.files.exr import exr_size
from jaxtrapolate.files.image import image_size
from jaxtrapolate.files.repair import fill_nearest, nonfinite_pixels, repair
from jaxtrapolate.files.sequence import InputError, MotionConvention, Sequence
from jaxtrapolate.records import CHANNELS, Frame, GBuffer, Keyframe

BUFFERS: dict[str, int] = {"color": 3, "motion": 2, **CHANNELS, "forward_flow": 3, "backward_flow": 3}
"""The number of channels of every buffer that a file may hold."""
FLOWS = ("forward_flow", "backward_flow")
OPTIONAL = frozenset({"color", "shadow", "sky", "sky_color", *FLOWS})
"""Buffers that single frames may lack; any other one must be there in all frames or in none."""
_MASKS_KEPT = 64

Files = Mapping[int, Mapping[str, str]]
"""For each frame the file of each buffer, relative to the sequence's folder."""
Opened = dict[str, Any]
"""The decoded files of one frame, so that a file with many layers is read once."""


class FileSequence(Sequence):
    """A sequence of files in a folder.

    The first frame is left out where it has no motion while others have (an engine has nothing to compare it with);
    a note says so. Sizes of the first frame's buffers and of one file of every frame are checked when the sequence is
    opened, those of the others, and that files are whole, when they are read. Safe to use from several threads.

    Args:
        folder: where the files are.
        files: the files of each frame.
        name: for reports.
        hdr: as in `Sequence`.
        depth: as in `Sequence`, where there is a depth buffer at all.
        convention: of the stored motion vectors.
        strict: raise on reading a frame with a non-finite pixel.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        files: Files,
        *,
        name: str,
        hdr: bool,
        depth: Literal["metric", "ordinal"],
        convention: MotionConvention,
        strict: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self.name = name
        self.hdr = hdr
        self.convention = convention
        self.strict = strict
        self._files = _checked_files(self.folder, files)
        if len(self._files) < len(files):
            self.notes = (f"frame {min(files)} left out: it has no motion vectors",)
        self.numbers = tuple(self._files)
        self.depth = depth if any("depth" in buffers for buffers in self._files.values()) else "absent"
        self.forward_motion = any("forward_flow" in buffers for buffers in self._files.values())
        self.size = self._check_sizes()
        self._note_alpha()
        self._lock = threading.RLock()
        self._loaded: tuple[int, Frame, np.ndarray | None] | None = None
        self._counts: dict[int, int] = {}
        self._masks: collections.OrderedDict[int, np.ndarray] = collections.OrderedDict()

    def _note_alpha(self) -> None:
        """Say that colour has alpha, by the first file of colour."""
        first = next((buffers["color"] for buffers in self._files.values() if "color" in buffers), None)
        if first is not None and (note := alpha_note(self.folder / first, self._color_layer)):
            self.notes = (*self.notes, note)

    _color_layer = ""
    """The layer of an EXR that colour is read from."""
    _unwritten = False

    def _exr_color(self, path: Path, color: np.ndarray, stored: Mapping[str, np.ndarray]) -> np.ndarray:
        """Colour of an EXR without the pixels of alpha 0 (`jaxtrapolate.files.alpha`)."""
        alpha = exr_alpha(stored, self._color_layer)
        if alpha is not None and not alpha.any():
            if not self._unwritten:
                self.notes = (*self.notes, UNWRITTEN_NOTE.format(name=path.name))
            self._unwritten = True
            return color
        return without_empty(color, alpha)

    @abc.abstractmethod
    def _read(self, path: Path, buffer: str, opened: Opened) -> np.ndarray:
        """One buffer in the library's convention, motion as it is stored; float32 `[H, W, BUFFERS[buffer]]`."""

    def _derive(self, buffers: dict[str, np.ndarray]) -> None:
        """Add the buffers that follow from others (the sky from normals), before repair."""

    def files(self, number: int) -> dict[str, Path]:
        """The file of each stored buffer of a frame."""
        if number not in self._files:
            raise InputError(f"{self.folder}: no frame {number}; there are {self.numbers[0]} to {self.numbers[-1]}")
        return {buffer: self.folder / file for buffer, file in self._files[number].items()}

    def frame(self, number: int) -> Frame:
        """The frame with every buffer that is there; its arrays are read-only."""
        return self._load(number)[0]

    def has_color(self, number: int) -> bool:
        """Whether the frame has a file of colour."""
        return "color" in self.files(number)

    def stored_motion(self, number: int) -> np.ndarray | None:
        """The motion vectors as they are stored, non-finite ones included."""
        return self._load(number)[1]

    def nonfinite(self, number: int) -> int:
        """How many pixels of the frame had a non-finite value in some buffer, or colour of alpha 0."""
        with self._lock:
            if number not in self._counts:
                self._load(number)
            return self._counts[number]

    def invalid(self, number: int) -> np.ndarray | None:
        """The pixels with a non-finite value in some buffer, or colour of alpha 0, bool `[H, W]`, or `None`."""
        with self._lock:
            if self.nonfinite(number) == 0:
                return None
            if number not in self._masks:  # Forgotten: it is found again by reading the frame again.
                self._loaded = None
                self._load(number)
            height, width = self.size
            bits = np.unpackbits(self._masks[number], count=height * width)
        return bits.astype(bool).reshape(height, width)

    def keyframe(self, number: int) -> Keyframe | None:
        """Colour, depth, stencil and the flows to both neighbours; `None` where the frame has no flow."""
        files = self.files(number)
        if not any(flow in files for flow in FLOWS):
            return None
        frame = self.frame(number)
        opened: Opened = {}
        flows: dict[str, Any] = {}
        for flow in FLOWS:
            if flow in files:
                image = self._checked(files[flow], flow, opened)
                flows[flow] = fill_nearest(image, nonfinite_pixels(image))
                flows[flow].setflags(write=False)
        gbuffer = frame.gbuffer or GBuffer()
        return Keyframe(frame.color, gbuffer.depth, gbuffer.stencil, time=frame.time, **flows)

    def _load(self, number: int) -> tuple[Frame, np.ndarray | None]:
        with self._lock:
            if self._loaded is None or self._loaded[0] != number:
                self._loaded = None  # One frame in memory, not two.
                self._loaded = (number, *self._decode(number))
            return self._loaded[1:]

    def _decode(self, number: int) -> tuple[Frame, np.ndarray | None]:
        opened: Opened = {}
        files = self.files(number)
        buffers = {b: self._checked(path, b, opened) for b, path in files.items() if b not in FLOWS}
        stored = buffers.get("motion")
        if stored is not None:
            buffers["motion"] = convert(stored, self.convention)
        self._derive(buffers)
        buffers, invalid = repair(buffers)
        self._remember(number, invalid)
        for image in buffers.values():
            image.setflags(write=False)
        images: dict[str, Any] = buffers
        fields = {field: images[field] for field in CHANNELS if field in images}
        gbuffer = GBuffer(**fields) if fields else None
        return Frame(images.get("color"), gbuffer, images.get("motion"), time=float(number)), stored

    def _remember(self, number: int, invalid: np.ndarray | None) -> None:
        count = 0 if invalid is None else int(invalid.sum())
        self._counts[number] = count
        if invalid is None:
            return
        if self.strict:
            remedy = "render it again, or read it without strict"
            raise InputError(f"{self.folder}: frame {number} has {count} non-finite pixels (or of alpha 0); {remedy}")
        self._masks[number] = np.packbits(invalid)
        while len(self._masks) > _MASKS_KEPT:
            self._masks.popitem(last=False)

    def _checked(self, path: Path, buffer: str, opened: Opened) -> np.ndarray:
        image = self._read(path, buffer, opened)
        if image.shape[:2] != self.size:
            got, expected = _show(image.shape), _show(self.size)
            raise InputError(f"{path}: its size is {got}, that of {self._reference} {expected}; render it again")
        return image

    def _check_sizes(self) -> Size:
        """The common size of the first frame's files, after comparing one file of every frame with it."""
        first = {self.folder / file: None for file in self._files[self.numbers[0]].values()}
        others = (self.folder / next(iter(buffers.values())) for buffers in self._files.values())
        self._reference = next(iter(first))
        size = stored_size(self._reference)
        for path in (*first, *others):
            if (got := stored_size(path)) != size:
                text = f"its size is {_show(got)}, that of {self._reference} {_show(size)}"
                raise InputError(f"{path}: {text}; all buffers and frames must have one size")
        return size


def stored_size(path: Path) -> Size:
    """`(H, W)` of an EXR or any other image file, from its header alone."""
    return exr_size(path) if path.suffix.lower() == ".exr" else image_size(path)


def frame_number(digits: str, name: str) -> int:
    """The number of a frame from the digits in a file's name; `InputError` where they are more than 15."""
    if len(digits.lstrip("0")) > 15:
        raise InputError(f"{name}: a frame's number of {len(digits)} digits; rename the file, 15 are the most")
    return int(digits)


def list_folder(folder: str | os.PathLike[str]) -> list[str]:
    """The names of the files and folders in a folder that do not start with a dot, sorted.

    Raises:
        InputError: no such folder, a file, or no permission.
    """
    try:
        return sorted(name for name in os.listdir(folder) if not name.startswith("."))
    except NotADirectoryError as error:
        raise InputError(f"{folder}: is a file; give the folder that holds the frames") from error
    except OSError as error:
        raise os_input_error(folder, error) from error


def _show(size: tuple[int, ...]) -> str:
    return f"{size[1]}x{size[0]}"


def _checked_files(folder: Path, files: Files) -> dict[int, Mapping[str, str]]:
    """The frames in order, without a first one that has no motion, after checking that no frame lacks a buffer."""
    examples = {buffer: file for number in sorted(files) for buffer, file in files[number].items()}
    numbers = sorted(files)
    if "motion" in examples and "motion" not in files[numbers[0]]:
        numbers = numbers[1:]
    for number in numbers:
        for buffer in BUFFERS:
            if buffer in examples and buffer not in OPTIONAL and buffer not in files[number]:
                have = f"frame {number} has no {buffer}, while there is {examples[buffer]}"
                raise InputError(f"{folder}: {have}; render it, or remove the other files of frame {number}")
    return {number: {b: files[number][b] for b in BUFFERS if b in files[number]} for number in numbers}
