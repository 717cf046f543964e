"""The header of an EXR file, read without the OpenEXR library.

OpenEXR prints to the terminal and drops whole parts when a file is cut short. This module finds that before the
library sees the file, and gives sizes and channel names without decoding a pixel. The layout is that of the OpenEXR
file format (openexr.com, "OpenEXR File Layout"): magic and version, one list of attributes a part, the table of the
chunks' offsets, the chunks.
"""

import dataclasses
import os
import struct
from typing import BinaryIO

import numpy as np

from jaxtrapolate.atomic import os_input_error
from jaxtrapolate.errors import InputError
from jaxtrapolate.files.limits import check_claim, check_pixels
from jaxtrapolate.regular import open_regular

_MAGIC = 20000630
_TILED, _DEEP, _MULTIPART = 0x200, 0x800, 0x1000
_LARGEST_HEADER = 1 << 26
_FARTHEST = 1 << 24
_LARGEST_PARTS = 1024


@dataclasses.dataclass(frozen=True)
class ExrPart:
    """One part: `size` is that of the display window, (H, W); windows are x0, y0, x1, y1, both ends inclusive."""

    name: str
    channels: tuple[str, ...]
    display: tuple[int, int, int, int]
    data: tuple[int, int, int, int]
    storage: str
    subsampled: bool

    @property
    def size(self) -> tuple[int, int]:
        """`(H, W)` of the display window."""
        x0, y0, x1, y1 = self.display
        return y1 - y0 + 1, x1 - x0 + 1


def read_header(path: str | os.PathLike[str]) -> tuple[ExrPart, ...]:
    """The parts of an EXR file, after checking that the file is there in full.

    Raises:
        InputError: missing, no permission, not an EXR, truncated, never finished, or a damaged header.
    """
    try:
        with open_regular(path) as stream:
            length = os.fstat(stream.fileno()).st_size
            data = stream.read(1 << 16)
            if len(data) < 8 or struct.unpack_from("<I", data)[0] != _MAGIC:
                raise InputError(f"{path}: {'empty' if not length else 'not an EXR file'}; render or copy it again")
            try:
                parts, position = _parse(data)
            except (IndexError, ValueError, struct.error):
                stream.seek(0)
                parts, position = _parse(stream.read(_LARGEST_HEADER))
            if not _complete(stream, parts, position, length, bool(data[5] & (_MULTIPART >> 8))):
                raise InputError(f"{path}: truncated ({length} bytes, more are expected); render or copy it again")
    except OSError as error:
        raise os_input_error(path, error) from error
    except (IndexError, ValueError, KeyError, struct.error) as error:
        raise InputError(f"{path}: truncated or damaged in its header; render or copy it again") from error
    return parts


def check_limits(path: str | os.PathLike[str], parts: tuple[ExrPart, ...]) -> None:
    """Raise `InputError` where the windows that a header states, with all channels, exceed `jaxtrapolate.files.limits`.

    The display window is what is asked for when channels are put into it, the data window what the library asks for.
    """
    channels = sum(len(part.channels) for part in parts)
    claimed = 0
    for part in parts:
        check_pixels(path, *part.size, channels)
        x0, y0, x1, y1 = part.data
        check_pixels(path, y1 - y0 + 1, x1 - x0 + 1, channels)
        claimed += (y1 - y0 + 1) * (x1 - x0 + 1) * len(part.channels) * 2
        if max(map(abs, part.data + part.display)) > _FARTHEST:
            text = f"its windows {part.display} and {part.data} lie more than {_FARTHEST} pixels away"
            raise InputError(f"{path}: {text}; render or copy it again")
    check_claim(path, claimed, os.stat(path).st_size)


def _parse(data: bytes) -> tuple[tuple[ExrPart, ...], int]:
    """The parts and the offset at which the table of the chunks begins."""
    flags = struct.unpack_from("<I", data, 4)[0]
    position, parts = 8, []
    while True:
        attributes: dict[str, bytes] = {}
        while data[position]:
            name, position = _string(data, position)
            _, position = _string(data, position)
            size = struct.unpack_from("<i", data, position)[0]
            position += 4
            if size < 0 or position + size > len(data):
                raise ValueError(name)
            attributes[name] = data[position : position + size]
            position += size
        position += 1
        parts.append(_part(attributes, flags))
        if not flags & _MULTIPART:
            return tuple(parts), position
        if not data[position]:
            return tuple(parts), position + 1
        if len(parts) >= _LARGEST_PARTS:
            raise ValueError("parts")


def _string(data: bytes, position: int) -> tuple[str, int]:
    end = data.index(b"\0", position)
    return data[position:end].decode("utf-8", "replace"), end + 1


def _part(attributes: dict[str, bytes], flags: int) -> ExrPart:
    names, subsampled = [], False
    channels, position = attributes["channels"], 0
    while channels[position]:
        name, position = _string(channels, position)
        sampling = struct.unpack_from("<ii", channels, position + 8)
        subsampled = subsampled or sampling != (1, 1)
        names.append(name)
        position += 16
    if len(set(names)) < len(names):
        raise ValueError("channels")
    display: tuple[int, int, int, int] = struct.unpack("<4i", attributes["displayWindow"])
    if display[2] < display[0] or display[3] < display[1]:
        raise ValueError("displayWindow")
    storage = attributes.get("type", b"").decode("ascii", "replace")
    if not storage:
        storage = "deepscanline" if flags & _DEEP else "tiledimage" if flags & _TILED else "scanlineimage"
    return ExrPart(
        name=attributes.get("name", b"").decode("utf-8", "replace"),
        channels=tuple(names),
        display=display,
        data=struct.unpack("<4i", attributes["dataWindow"]),
        storage=storage,
        subsampled=subsampled,
    )


def _complete(stream: BinaryIO, parts: tuple[ExrPart, ...], position: int, length: int, multipart: bool) -> bool:
    """Whether every chunk has an offset and the last one ends within the file."""
    stream.seek(position)
    first = stream.read(8)
    if len(first) < 8:
        return False
    bound = struct.unpack("<Q", first)[0]
    if not position < bound < length:
        return False
    # The first chunk follows the table, so the table ends at the lowest offset seen so far.
    stream.seek(position)
    table = np.frombuffer(stream.read((bound - position) // 8 * 8), "<u8")
    ends = position + 8 * np.arange(1, len(table) + 1, dtype=np.uint64)
    finished = ends >= np.minimum.accumulate(table)
    table = table[: int(np.argmax(finished)) + 1]
    last = int(table.max())
    if not table.all() or last + 8 > length:
        return False
    stream.seek(last)
    leader = stream.read(24)
    start, storage = 0, parts[0].storage
    if multipart:
        index = struct.unpack_from("<i", leader)[0]
        if not 0 <= index < len(parts):
            return False
        start, storage = 4, parts[index].storage
    if storage.startswith("deep"):
        return True
    start += 16 if storage == "tiledimage" else 4
    if len(leader) < start + 4:
        return False
    size = struct.unpack_from("<i", leader, start)[0]
    return size >= 0 and last + start + 4 + size <= length
