"""What all readers of files share: which frame has which files, sizes, repair, conversion, and a memory of one frame.

A reader is a subclass of `FileSequence` that finds the files of each frame and reads one buffer from one file. It is
plain NumPy: nothing is computed with JAX, so that a data loader may fork its workers after the parent has used JAX.
"""

import abc
import collections
import os
import threading
import weakref
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from jaxtrapolate.checks import Size
from jaxtrapolate.errors import InputError
from jaxtrapolate.files.alpha import UNWRITTEN_NOTE, alpha_note, exr_alpha, without_empty
from jaxtrapolate.files.convention import convert
from jaxtrapolate.files.exr import exr_outside, exr_size, layer_channels, pick
from jaxtrapolate.files.ids import Numbering, StaticId, clear_static, distinct, plain
from jaxtrapolate.files.image import image_size
from jaxtrapolate.files.jitter import fingerprint
from jaxtrapolate.files.listing import find_step
from jaxtrapolate.files.repair import fill_nearest, no_depth, nonfinite_pixels, repair
from jaxtrapolate.files.sequence import MotionConvention, Sequence
from jaxtrapolate.records import CHANNELS, DepthKind, Frame, GBuffer, Keyframe

BUFFERS: dict[str, int] = {"color": 3, "motion": 2, **CHANNELS, "forward_flow": 3, "backward_flow": 3}
"""The number of channels of every buffer that a file may hold."""
FLOWS = ("forward_flow", "backward_flow")
OPTIONAL = frozenset({"color", "shadow", "sky", "sky_color", *FLOWS})
"""Buffers that single frames may lack; any other one must be there in all frames or in none."""
GREY = ("color", "albedo", "sky_color")
"""Buffers of colours, which may be stored as one channel of grey."""
_MASKS_KEPT = 64

Files = Mapping[int, Mapping[str, str]]
"""For each frame the file of each buffer, relative to the sequence's folder."""
Opened = dict[str, Any]
"""The decoded files of one frame, so that a file with many layers is read once."""


class FileSequence(Sequence):
    """A sequence of files in a folder.

    The first frame is left out where it has no motion while others have (an engine has nothing to compare it with);
    a note says so. Sizes of the first frame's buffers and of one file of every frame are checked when the sequence is
    opened, those of the others, and that files are whole, when they are read. Safe to use from several threads, from
    processes that were forked off, and to pickle.

    Attributes:
        outside: what lies outside an EXR's data window is nothing: the values of buffers for which that is not 0.
        jitter: of each frame, float32 `[2]` in pixels, where it is known (`jaxtrapolate.files.jitter`).

    Args:
        folder: where the files are.
        files: the files of each frame.
        name: for reports.
        hdr: as in `Sequence`.
        depth: as in `Sequence`, where there is a depth buffer at all.
        convention: of the stored motion vectors.
        step: between the numbers of neighbouring frames; by default it is found (`find_step`).
        static_ids: ids of the stencil that are static, as they are stored (`jaxtrapolate.files.ids`).
        left_out: a line for each file of a frame that is not read: notes, and refused where `strict`.
        strict: raise where something is left out, and on reading a frame with a non-finite pixel.
    """

    outside: Mapping[str, float] = MappingProxyType({"depth": np.inf, "sky": 1.0})
    jitter: Mapping[int, np.ndarray] = MappingProxyType({})

    def __init__(
        self,
        folder: str | os.PathLike[str],
        files: Files,
        *,
        name: str,
        hdr: bool,
        depth: DepthKind,
        convention: MotionConvention,
        step: int | None = None,
        static_ids: Iterable[StaticId] = (),
        left_out: Iterable[str] = (),
        strict: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self.name = name
        self.hdr = hdr
        self.convention = convention
        self.static_ids = tuple(static_ids)
        self.strict = strict
        self._files = _checked_files(self.folder, files)
        self.notes = tuple(left_out)
        if len(self._files) < len(files):
            self.notes += (f"frame {min(files)} left out: it has no motion vectors",)
        if strict and self.notes:
            remedy = "remove or rename its files, or read it without {argument}"
            raise InputError(f"{self.folder}: {self.notes[0]}; {remedy}", argument="strict")
        self.numbers = tuple(self._files)
        self.step, found = find_step(self.folder, self.numbers, step)
        self.notes += (found,) if found else ()
        self.depth = depth if any("depth" in buffers for buffers in self._files.values()) else "absent"
        self.forward_motion = any("forward_flow" in buffers for buffers in self._files.values())
        self.size = self._check_sizes()
        self._note_alpha()
        self._loaded: tuple[int, Frame, np.ndarray | None] | None = None
        self._counts: dict[int, int] = {}
        self._no_depth: dict[int, dict[str, int]] = {}
        self._masks: collections.OrderedDict[int, np.ndarray] = collections.OrderedDict()
        self._numbering: Numbering | None = None
        self._renew_lock()

    def _renew_lock(self) -> None:
        self._lock = threading.RLock()
        _SEQUENCES.add(self)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_lock"} | {"_loaded": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._renew_lock()

    def _note_alpha(self) -> None:
        """Say that colour has alpha, by the first file of colour."""
        first = next((buffers["color"] for buffers in self._files.values() if "color" in buffers), None)
        if first is not None and (note := alpha_note(self.folder / first, self._color_layer)):
            self.notes = (*self.notes, note)

    _color_layer = ""
    """The layer of an EXR that colour is read from."""
    _unwritten = False

    def _exr_color(self, path: Path, color: np.ndarray, stored: Mapping[str, np.ndarray]) -> np.ndarray:
        """Colour of an EXR without the pixels of alpha 0 (`jaxtrapolate.files.alpha`).

        Those outside the data window stay: nothing was hit there, which depth and the sky mask say.
        """
        alpha = exr_alpha(stored, self._color_layer)
        if alpha is not None and not np.count_nonzero(alpha):
            if not self._unwritten:
                self._note(UNWRITTEN_NOTE.format(name=path.name))
            self._unwritten = True
            return color
        if alpha is not None and (outside := exr_alpha(exr_outside(path), self._color_layer)) is not None:
            alpha = np.where(outside, 1, alpha)
        return without_empty(color, alpha)

    @abc.abstractmethod
    def _read(self, path: Path, buffer: str, opened: Opened) -> np.ndarray:
        """One buffer in the library's convention, motion as it is stored; float32 `[H, W, BUFFERS[buffer]]`.

        The stencil has the type that it is stored in, for ids to stay exact.
        """

    def _number(self, values: np.ndarray) -> np.ndarray:
        """The ids float32 of a stencil as it is stored; see `jaxtrapolate.files.ids`."""
        values = clear_static(values, self.static_ids)
        if plain(values).all():
            return values.astype(np.float32)
        try:
            if self._numbering is None:
                self._numbering = self._number_ids()
            return self._numbering.apply(values)
        except ValueError as error:
            raise InputError(f"{self.folder}: {error}") from error

    def _number_ids(self) -> Numbering:
        """Reads the stencils of all frames, once."""
        found, bits = [], False
        for number in self.numbers:
            values = clear_static(self._checked(self.files(number)["stencil"], "stencil", {}), self.static_ids)
            bits |= values.dtype.kind == "f"
            found.append(distinct(values))
        numbering = Numbering.of(np.concatenate(found), crypto=self._hashed_ids(), bits=bits)
        if numbering.hashes:
            first, last = int(numbering.given[0]), int(numbering.given[-1])
            text = "which float32 does not keep apart as they are stored; here they are numbered"
            self._note(f"stencil: {len(numbering.given)} ids are hashes, {text} {first} to {last}")
        return numbering

    def _layer(self, buffer: str) -> dict[str, Any]:
        """Which channels of an EXR hold a buffer: the options layer and channels of `pick`."""
        return {}

    def _hashed_ids(self) -> bool:
        """Whether the stencil's description says that its values are hashes."""
        return False

    def stored_id(self, number: int) -> StaticId:
        """An id of the stencil as it is stored, and as `static_ids` names it."""
        return number if self._numbering is None else self._numbering.stated(number)

    def _note(self, text: str) -> None:
        with self._lock:
            if text not in self.notes:
                self.notes = (*self.notes, text)

    def _derive(self, buffers: dict[str, np.ndarray]) -> None:
        """Add the buffers that follow from others (the sky from normals), before repair."""

    def _sky_follows(self) -> bool:
        """Whether depth tells where nothing is, in every frame alike."""
        return self.depth == "metric"

    def files(self, number: int) -> dict[str, Path]:
        """The file of each stored buffer of a frame."""
        if number not in self._files:
            there = f"there are {self.numbers[0]} to {self.numbers[-1]}" + f", step {self.step}" * (self.step > 1)
            raise InputError(f"{self.folder}: no frame {number}; {there}")
        return {buffer: self.folder / file for buffer, file in self._files[number].items()}

    def identity(self) -> dict[str, Any]:
        """Beside what all sequences have: the step, the ids that count as static, and a hash of the jitter."""
        known = super().identity() | {"step": self.step, "static_ids": list(self.static_ids)}
        return known | ({"jitter": fingerprint(self.jitter)} if self.jitter else {})

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

    def no_depth(self, number: int) -> dict[str, int]:
        """How many pixels of the frame have no depth, by why; they are taken for infinitely far."""
        with self._lock:
            if number not in self._no_depth:
                self._load(number)
            return self._no_depth[number]

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
        if "stencil" in buffers:
            buffers["stencil"] = self._number(buffers["stencil"])
        self._derive(buffers)
        self._no_depth[number] = no_depth(buffers)
        buffers, invalid = repair(buffers, sky=self._sky_follows())
        self._remember(number, invalid)
        for image in buffers.values():
            image.setflags(write=False)
        images: dict[str, Any] = buffers
        fields = {field: images[field] for field in CHANNELS if field in images}
        gbuffer = GBuffer(**fields) if fields else None
        jitter: Any = self.jitter.get(number)
        return Frame(images.get("color"), gbuffer, images.get("motion"), jitter=jitter, time=float(number)), stored

    def _remember(self, number: int, invalid: np.ndarray | None) -> None:
        count = 0 if invalid is None else int(invalid.sum())
        self._counts[number] = count
        if invalid is None:
            return
        if self.strict:
            remedy = "render it again, or read it without {argument}"
            text = f"frame {number} has {count} non-finite pixels (or of alpha 0); {remedy}"
            raise InputError(f"{self.folder}: {text}", argument="strict")
        self._masks[number] = np.packbits(invalid)
        while len(self._masks) > _MASKS_KEPT:
            self._masks.popitem(last=False)

    def _checked(self, path: Path, buffer: str, opened: Opened) -> np.ndarray:
        image = self._read(path, buffer, opened)
        if image.shape[:2] != self.size:
            got, expected = _show(image.shape), _show(self.size)
            raise InputError(f"{path}: its size is {got}, that of {self._reference} {expected}; render it again")
        if buffer in self.outside and is_exr(path):
            masks = exr_outside(path)
            if masks:
                outside = pick_channels(masks, path=path, buffer=buffer, **self._layer(buffer)).any(-1, keepdims=True)
                image = np.where(outside, np.float32(self.outside[buffer]), image)
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
    return exr_size(path) if is_exr(path) else image_size(path)


def is_exr(path: str | Path) -> bool:
    """Whether a file's name is that of an EXR."""
    return str(path).lower().endswith(".exr")


def pick_channels(
    stored: Mapping[str, np.ndarray],
    *,
    path: Path,
    buffer: str,
    layer: str = "",
    channels: tuple[str, ...] | None = None,
) -> np.ndarray:
    """The channels of a buffer in an EXR file, `[H, W, BUFFERS[buffer]]`; float32, but ids as they are stored.

    Raises:
        InputError: naming the channels that are there.
    """
    if buffer == "stencil":
        return pick(stored, path=path, count=1, layer=layer, channels=channels, exact=True)
    if buffer in GREY and channels is None and len(names := layer_channels(tuple(stored), layer)) == 1:
        channels = (names[0].rpartition(".")[2],) * 3
    return pick(stored, path=path, count=BUFFERS[buffer], layer=layer, channels=channels)


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


_SEQUENCES: "weakref.WeakSet[FileSequence]" = weakref.WeakSet()


def _after_fork() -> None:
    """In a process forked off: a lock that another thread held there would never be given back here."""
    for sequence in list(_SEQUENCES):
        sequence._renew_lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
