"""The pictures of evaluated frames: of what methods generated, kept as it comes, and of the frames that are shown."""

import re
import shutil
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from jaxtrapolate.checks import check_present
from jaxtrapolate.evaluation.score import causes_of, display, truth_for
from jaxtrapolate.evaluation.windows import Window
from jaxtrapolate.files import Sequence, read_png, write_png
from jaxtrapolate.methods.frames import rendered
from jaxtrapolate.ops.holes import hole_masks
from jaxtrapolate.ops.jitter import shift_motion
from jaxtrapolate.records import CHANNELS, GBuffer
from jaxtrapolate.report import colorize_causes, colorize_error
from jaxtrapolate.runtime.output import writable_folder


def file_name(text: str) -> str:
    """The name of a file for a method as it was named, with its options: guided_warp_keep=1."""
    return re.sub(r"[^\w.+=-]", "_", text)


def eight_bit(image: Any) -> np.ndarray:
    """Display values 0..1 as 8-bit RGB."""
    codes = np.round(np.nan_to_num(np.clip(np.asarray(image, np.float32), 0, 1)) * 255).astype(np.uint8)
    return np.repeat(codes, 3, -1) if codes.shape[-1] == 1 else codes


def buffer_picture(name: str, value: Any, sky: Any = None) -> np.ndarray:
    """A buffer as a picture: normals from -1..1, what has no range of its own between its 1st and 99th percentile.

    Where there is a sky its far values do not count for the range. Depth is shown as log(1 + depth / its median): what
    is near is told apart although most of a scene is far.
    """
    value = np.asarray(value, np.float32)
    if name == "normal":
        return eight_bit(value * 0.5 + 0.5)
    if name in ("depth", "position", "stencil"):
        counts = np.isfinite(value)
        if sky is not None and name != "stencil":
            counts = counts & (np.asarray(sky) < 0.5)
        if name == "depth" and counts.any():
            middle = max(float(np.median(value[counts])), 1e-6)
            value = np.log1p(np.maximum(value, 0) / middle)
        finite = np.where(counts, value, np.nan)
        low, high = np.nanpercentile(finite, (1, 99), axis=(0, 1)) if counts.any() else (0.0, 1.0)
        high = np.maximum(high, value.max(axis=(0, 1))) if name == "stencil" else high
        return eight_bit((np.nan_to_num(value) - low) / np.maximum(high - low, 1e-6))
    return eight_bit(value)


def motion_picture(motion: Any) -> np.ndarray:
    """Motion as a picture: x in red, y in green, grey where nothing moves."""
    motion = np.asarray(motion)
    largest = max(float(np.nanpercentile(np.abs(motion), 99)), 1e-3)
    return eight_bit(
        np.concatenate([motion / largest * 0.5 + 0.5, np.full((*motion.shape[:2], 1), 0.5, np.float32)], -1)
    )


class Gallery:
    """8-bit pictures of generated frames and of their errors, in a folder for each frame.

    Which frames are shown is only known when all are scored; until then all are kept, so that none is generated again.

    Args:
        folder: gets a folder `pictures`.
        hdr: whether colour is HDR, as of `display`.
    """

    def __init__(self, folder: Path, *, hdr: bool) -> None:
        self._folder, self._hdr = folder, hdr

    def _path(self, number: int, name: str) -> Path:
        return self._folder / "pictures" / f"{number:04d}" / f"{name}.png"

    def _put(self, number: int, name: str, codes: np.ndarray) -> str:
        path = self._path(number, name)
        writable_folder(path.parent)
        write_png(path, codes)
        return path.relative_to(self._folder).as_posix()

    def has(self, method: str, number: int) -> bool:
        """Whether a generated frame is kept."""
        names = file_name(method), f"{file_name(method)}_error"
        return all(self._path(number, name).is_file() for name in names)

    def put(self, method: str, window: Window, image: Any) -> None:
        """Keeps a generated frame and its error."""
        truth = np.asarray(self.display(truth_for(window, image).color))
        shown = np.asarray(self.display(image))
        self._put(window.number, file_name(method), eight_bit(shown))
        self._put(window.number, f"{file_name(method)}_error", colorize_error(np.abs(shown - truth).mean(-1)))

    def display(self, color: Any) -> Any:
        """Colour in display values."""
        return display(check_present("color", color, needed_by="pictures"), hdr=self._hdr)

    def codes(self, method: str, number: int) -> np.ndarray:
        """A generated frame that is kept, `[H, W, 3]`."""
        return read_png(self._path(number, file_name(method)))

    def keep_only(self, numbers: Collection[int]) -> None:
        """Removes the pictures of all frames but these."""
        kept = {f"{n:04d}" for n in numbers}
        folder = self._folder / "pictures"
        for entry in folder.iterdir() if folder.is_dir() else ():
            if entry.is_dir() and entry.name not in kept:
                shutil.rmtree(entry)
        if not kept and folder.is_dir():
            shutil.rmtree(folder)

    def describe(self, sequence: Sequence, window: Window, methods: Iterable[str]) -> dict[str, Any]:
        """Writes the pictures of what surrounds a shown frame; returns the paths of all its pictures in the folder."""
        number, frame = window.number, window.truth
        truth = np.asarray(self.display(frame.color))
        newest = window.history[rendered(window.history)[0]]
        here, there = window.target.gbuffer or GBuffer(), newest.gbuffer or GBuffer()
        pictures: dict[str, Any] = {
            "number": number,
            "truth": self._put(number, "truth", eight_bit(truth)),
            "previous": self._put(number, "previous", eight_bit(self.display(newest.color))),
            "methods": {},
            "buffers": {},
        }
        causes = causes_of(sequence, window)
        if causes is not None:
            pictures["causes"] = self._put(number, "causes", colorize_causes(causes))
        if window.target.motion is not None and newest is window.history[-1]:
            motion = shift_motion(window.target.motion, window.target, newest)
            holes = hole_masks(here, there, motion).any
            marked = np.where(np.asarray(holes), np.array([0.1, 0.9, 0.2], np.float32), truth * 0.5)
            pictures["holes"] = self._put(number, "holes", eight_bit(marked))
        for method in methods:
            paths = (self._path(number, f"{file_name(method)}{end}") for end in ("", "_error"))
            image, error = (path.relative_to(self._folder).as_posix() for path in paths)
            pictures["methods"][method] = {"image": image, "error": error}
        buffers = frame.gbuffer or GBuffer()
        for name in CHANNELS:
            value = getattr(buffers, name)
            if value is not None:
                picture = display(value, hdr=True) if name == "sky_color" else value
                codes = buffer_picture(name, picture, buffers.sky)
                pictures["buffers"][name] = self._put(number, f"buffer_{name}", codes)
        if frame.motion is not None:
            pictures["buffers"]["motion"] = self._put(number, "buffer_motion", motion_picture(frame.motion))
        return pictures
