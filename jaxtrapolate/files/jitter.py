"""The jitter of a folder's frames: a text file of numbers, which `[jitter]` of a `jaxtrapolate.toml` names.

A line for each frame: its number, then x and y, with spaces, tabs, commas or semicolons between them. What follows a
`#` is a comment; a first line without a number is a heading.
"""

import dataclasses
import math
import re
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from jaxtrapolate.checks import Size
from jaxtrapolate.errors import InputError
from jaxtrapolate.files.text import read_lines
from jaxtrapolate.records import Units, YAxis

Shifted = Literal["samples", "image"]
"""What a file's numbers shift: the samples, so that pixel p shows the screen at p + jitter; or the image, as where they
are added to the projection, so that pixel p shows it at p - jitter."""


@dataclasses.dataclass(frozen=True)
class JitterFile:
    """A file of jitter, and how it states it.

    Attributes:
        file: its path, relative to the folder of the description.
        units: as of motion vectors.
        y_axis: as of motion vectors.
        shifts: see `Shifted`.
    """

    file: str
    units: Units = "pixels"
    y_axis: YAxis = "down"
    shifts: Shifted = "samples"


def read_jitter(path: Path, stated: JitterFile, numbers: Iterable[int], size: Size) -> dict[int, np.ndarray]:
    """The jitter of frames in the library's convention, float32 `[2]` in pixels, by number.

    Args:
        path: of the file.
        stated: how it states it.
        numbers: of the frames that there are.
        size: `(H, W)` of the frames.

    Raises:
        InputError: no such file, a line that is not three numbers, a frame twice or not at all.
    """
    found: dict[int, np.ndarray] = {}
    height, width = size
    pixels = {"pixels": (1.0, 1.0), "uv": (width, height), "ndc": (width / 2, height / 2)}[stated.units]
    scale = np.array(pixels) * (1, -1 if stated.y_axis == "up" else 1) * (-1 if stated.shifts == "image" else 1)
    for row, line in enumerate(read_lines(path), 1):
        words = [word for word in re.split(r"[\s,;]+", line.partition("#")[0]) if word]
        if not words or (not found and not any(map(_is_number, words))):
            continue
        if len(words) != 3 or not all(map(_is_number, words)) or not float(words[0]).is_integer():
            raise InputError(f"{path}: line {row}: expected a frame's number, x and y, got {line.strip()!r}")
        number = int(float(words[0]))
        if number in found:
            raise InputError(f"{path}: line {row}: frame {number} again; leave one of its lines")
        found[number] = np.asarray(scale * [float(word) for word in words[1:]], np.float32)
    if missing := [n for n in numbers if n not in found]:
        raise InputError(f"{path}: has no line for frame {missing[0]}; add it")
    return {n: found[n] for n in numbers}


def fingerprint(jitter: Mapping[int, np.ndarray]) -> str:
    """A hash of the jitter of all frames, which is the same in a copy of the folder."""
    return f"{zlib.crc32(np.stack(list(jitter.values())).tobytes()):08x}"


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word)) and abs(float(word)) < 2**31
    except ValueError:
        return False
