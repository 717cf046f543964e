"""Packed PNG clips: folders `color`, `motion`, `depth`, `stencil`, `shadow` of `NNNN.png`, all of them 8-bit.

- color: sRGB, decoded to linear by the exact curve.
- motion: RGBA; with R to A in 0..1, (2 (R + G / 255) - 1, 2 (B + A / 255) - 1) is current minus previous as a fraction
  of the frame, y up. That is what `stored_motion` gives; its convention is "current_minus_previous,uv,up", so that
  previous = (x - mv_x, y - mv_y) with mv_x = (2 (R + G / 255) - 1) W and mv_y = -(2 (B + A / 255) - 1) H.
- depth: larger = nearer in the files. Ordinal only: (256 - code) / 256 is given, larger = farther, and no distances;
  it is positive, since the nearest code, 255, is a surface like others and not "nothing hit".
- stencil: 0 static, else dynamic. A mask's 255 becomes the id 1 (and 1, should it be there too, 255); other codes are
  ids as they are.
- shadow: 255 = full shadow, so code / 255. (In the known clip the mask also marks some static surfaces.)

Every folder is optional, but there must be color or motion. Numbers may be negative; a file with another name is left
out, and so is 1.png where there is 0001.png; notes name them.
"""

import os
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from jaxtrapolate.errors import InputError
from jaxtrapolate.files.alpha import without_empty
from jaxtrapolate.files.ids import StaticId
from jaxtrapolate.files.image import decode_srgb, read_png
from jaxtrapolate.files.listing import collect, folder_name, frame_number, list_folder, some
from jaxtrapolate.files.reader import FileSequence, Opened
from jaxtrapolate.files.sequence import MotionConvention

FOLDERS = ("color", "motion", "depth", "stencil", "shadow")
CONVENTION = MotionConvention("current_minus_previous", "uv", "up")
"""How a packed clip states its motion vectors, once they are decoded."""

_FILE = re.compile(r"(-?\d+)\.png", re.IGNORECASE)
_OTHER = re.compile(r".*\d\.(png|jpe?g|exr|tiff?|webp|bmp|tga)", re.IGNORECASE)
_CHANNELS = {"color": 3, "motion": 4, "depth": 1, "stencil": 1, "shadow": 1}


def packed_folder(folder: str | os.PathLike[str]) -> Path | None:
    """Where the clip of an input folder lies: the folder itself, or its only subfolder (as `540p`) with a clip.

    A clip is a folder with `motion`, and with `color` where several qualify. `None` where there is none.

    Raises:
        InputError: several subfolders hold clips.
    """
    folder = Path(folder)
    names = list_folder(folder)
    if {"color", "motion"} & {name for name in names if (folder / name).is_dir()}:
        return folder
    clips = [name for name in names if (folder / name / "motion").is_dir()]
    if len(clips) > 1:
        raise InputError(f"{folder}: holds several clips ({', '.join(clips)}); give the folder of one")
    return folder / clips[0] if clips else None


class PackedSequence(FileSequence):
    """A packed PNG clip; see the module's docstring for the files.

    Args:
        folder: that with the folders `color`, `motion`, ..., or one whose only subfolder with `motion` it is.
        motion: how the decoded motion vectors are stated, where it is not the default `CONVENTION`.
        name: for reports; by default the folder's.
        step: as in `FileSequence`.
        static_ids: as in `FileSequence`.
        strict: as for the other readers; 8-bit files have no non-finite pixels.

    Raises:
        InputError: no such folder or files, a missing file, files of different sizes.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        motion: MotionConvention | None = None,
        name: str | None = None,
        step: int | None = None,
        static_ids: Iterable[StaticId] = (),
        strict: bool = False,
    ) -> None:
        clip = packed_folder(folder)
        if clip is None:
            raise InputError(f"{folder}: no folders color or motion of NNNN.png; give the folder of the clip")
        found, others = [], []
        for buffer in FOLDERS:
            for file in list_folder(clip / buffer) if (clip / buffer).is_dir() else ():
                path = os.path.join(buffer, file)
                if match := _FILE.fullmatch(file):
                    number = frame_number(match[1], path)
                    found.append((number, buffer, path, match[1] == f"{number:04d}"))
                elif _OTHER.fullmatch(file):
                    others.append(path)
        files, left_out = collect(found)
        if others:
            left_out.append(f"{some(others)} left out: a packed clip's files are named NNNN.png")
        if not files:
            raise InputError(f"{clip}: its folders hold no files named NNNN.png; give the folder of the clip")
        super().__init__(
            clip,
            files,
            name=name or folder_name(folder),
            hdr=False,
            depth="ordinal",
            convention=motion or CONVENTION,
            step=step,
            static_ids=static_ids,
            left_out=left_out,
            strict=strict,
        )
        if unread := [name for name in list_folder(clip) if name not in FOLDERS and (clip / name).is_dir()]:
            self.notes += (f"{some(unread)} not read: a packed clip's folders are {', '.join(FOLDERS)}",)

    def _read(self, path: Path, buffer: str, opened: Opened) -> np.ndarray:
        codes = read_png(path)
        channels = _CHANNELS[buffer]
        if codes.dtype != np.uint8 or codes.shape[-1] < channels:
            got = f"{codes.shape[-1]} channels of {codes.dtype}"
            raise InputError(f"{path}: {got}, a packed {buffer} has {channels} of uint8; store it as such")
        alpha = codes[..., channels] if codes.shape[-1] > channels else None
        codes = codes[..., :channels]
        if buffer == "color":
            return without_empty(decode_srgb(codes), alpha)
        if buffer == "motion":
            return decode_motion(codes)
        if buffer == "depth":
            return (256 - codes.astype(np.float32)) / 256
        if buffer == "stencil":
            return codes
        return codes.astype(np.float32) / 255.0

    def _number(self, values: np.ndarray) -> np.ndarray:
        ids = super()._number(values)
        return np.where(ids == 255, 1, np.where(ids == 1, 255, ids)).astype(np.float32)

    def stored_id(self, number: int) -> StaticId:
        """An id of the stencil as it is stored: 255 for 1, and 1 for 255."""
        return {1: 255, 255: 1}.get(number, number)


def decode_motion(codes: np.ndarray) -> np.ndarray:
    """Fractions of the frame `[H, W, 2]` from RGBA codes `[H, W, 4]`; `encode_motion` is the inverse."""
    value = codes.astype(np.float64) / 255.0
    return (2.0 * (value[..., 0::2] + value[..., 1::2] / 255.0) - 1.0).astype(np.float32)


def encode_motion(fractions: np.ndarray) -> np.ndarray:
    """RGBA codes uint8 `[H, W, 4]` of motion `[H, W, 2]` in fractions of the frame, to within 1 / 65025 of it."""
    steps = np.round((np.clip(fractions, -1.0, 1.0).astype(np.float64) + 1.0) * (0.5 * 255 * 255)).astype(np.int64)
    coarse = np.minimum(steps // 255, 255)
    return np.stack([coarse, steps - coarse * 255], axis=-1).reshape(*steps.shape[:2], 4).astype(np.uint8)
