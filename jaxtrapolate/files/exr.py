"""EXR files: every channel of a file by name, layers picked from it, and files that are written in full or not at all.

A channel's name is "layer.channel", or "channel" alone in the unnamed layer: "R", "ViewLayer.Combined.R", "depth.Z".
In a file of several parts the part's name is put before it where it is not there already, so that a part "depth" with
a channel "Z" gives "depth.Z" as the layer "depth" of a single part would.

Images are placed in the display window: pixels outside the data window are 0, pixels of the data window outside the
display window (overscan) are left out. OpenEXR is imported when a file is read or written, not before. Images larger
than `jaxtrapolate.files.limits` says are refused.
"""

import errno
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxtrapolate.atomic import atomic_path, os_input_error
from jaxtrapolate.checks import check_choice
from jaxtrapolate.errors import InputError
from jaxtrapolate.files.exr_header import ExrPart, check_limits, read_header
from jaxtrapolate.files.silence import silence

Compression = Literal["none", "rle", "zips", "zip", "piz"]
HALF_MAX = 65504.0
"""The largest finite half float; `write_exr` clips finite values to it rather than let them become infinite."""

_ORDERS = ("RGBA", "XYZ", "UVW", "Y", "Z")
_COMPRESSIONS = {
    "none": "NO_COMPRESSION",
    "rle": "RLE_COMPRESSION",
    "zips": "ZIPS_COMPRESSION",
    "zip": "ZIP_COMPRESSION",
    "piz": "PIZ_COMPRESSION",
}
_NAMES = {1: "Y", 2: "RG", 3: "RGB", 4: "RGBA"}


def _openexr(path: str | os.PathLike[str]) -> Any:
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError(f"{path}: EXR files need the OpenEXR package; run: pip install OpenEXR") from error
    if not hasattr(OpenEXR, "File"):
        raise InputError(f"{path}: the installed OpenEXR package is too old; run: pip install 'OpenEXR>=3.3'")
    return OpenEXR


def exr_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """`(H, W)` of the display window, from the header alone; raises `InputError` where the file is not whole."""
    parts = read_header(path)
    check_limits(path, parts)
    return parts[0].size


def exr_channels(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """The full names of a file's channels, from the header alone; raises `InputError` where the file is not whole."""
    parts = read_header(path)
    return tuple(_full_name(part, name, parts) for part in parts for name in part.channels)


def _full_name(part: ExrPart, channel: str, parts: Sequence[ExrPart]) -> str:
    if len(parts) == 1 or not part.name or channel.startswith(part.name + "."):
        return channel
    return f"{part.name}.{channel}"


def read_exr(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Every channel of an EXR file by its full name, `[H, W]` in the type it is stored in (half, float or uint32).

    H and W are those of the display window, see the module's docstring for what lies outside the data window.

    Raises:
        InputError: missing, no permission, not an EXR, truncated or damaged, deep or subsampled, parts of different
            sizes, too large, or OpenEXR not installed. Nothing is printed.
    """
    parts = read_header(path)
    check_limits(path, parts)
    for part in parts:
        if part.storage.startswith("deep"):
            raise InputError(f"{path}: deep EXR files cannot be read; flatten it to one sample a pixel")
        if part.subsampled:
            raise InputError(f"{path}: has subsampled channels (luminance and chroma); write it as RGB")
        if part.size != parts[0].size:
            raise InputError(f"{path}: its parts differ in size, {_show(parts[0].size)} and {_show(part.size)}")
    library = _openexr(path)
    channels: dict[str, np.ndarray] = {}
    try:
        with silence(), library.File(os.fsencode(path), separate_channels=True) as file:
            if len(file.parts) != len(parts):  # The library drops a part that it cannot decode, and only prints.
                raise RuntimeError("a part cannot be decoded")
            for part, stored in zip(parts, file.parts, strict=True):
                for channel in stored.channels.values():
                    channels[_full_name(part, channel.name, parts)] = _place(channel.pixels, part)
    except Exception as error:  # What the library raises on damaged bytes is not documented.
        raise InputError(f"{path}: damaged, its pixels cannot be read; render or copy it again") from error
    return channels


def _show(size: tuple[int, int]) -> str:
    return f"{size[1]}x{size[0]}"


def _place(pixels: np.ndarray, part: ExrPart) -> np.ndarray:
    """The pixels of the data window in the display window, 0 elsewhere."""
    if part.data == part.display:
        return pixels
    height, width = part.size
    out = np.zeros((height, width), pixels.dtype)
    x, y = part.data[0] - part.display[0], part.data[1] - part.display[1]
    rows = slice(max(y, 0), max(min(y + pixels.shape[0], height), 0))
    columns = slice(max(x, 0), max(min(x + pixels.shape[1], width), 0))
    if rows.stop > rows.start and columns.stop > columns.start:
        out[rows, columns] = pixels[rows.start - y : rows.stop - y, columns.start - x : columns.stop - x]
    return out


def exr_outside(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """For every channel of an EXR file the pixels outside its data window, bool `[H, W]`; empty where there is none."""
    parts = read_header(path)
    masks: dict[str, np.ndarray] = {}
    if all(part.data == part.display for part in parts):
        return masks
    for part in parts:
        height, width = part.size
        x, y = part.data[0] - part.display[0], part.data[1] - part.display[1]
        right, bottom = part.data[2] - part.display[0] + 1, part.data[3] - part.display[1] + 1
        outside = np.ones((height, width), bool)
        outside[max(y, 0) : max(bottom, 0), max(x, 0) : max(right, 0)] = False
        masks |= {_full_name(part, name, parts): outside for name in part.channels}
    return masks if any(mask.any() for mask in masks.values()) else {}


def layer_channels(names: Sequence[str], layer: str = "") -> tuple[str, ...]:
    """The channels of a layer in their usual order: RGBA, XYZ, UVW, Y, Z, else by name.

    `layer` may leave out leading parts of the name: "Depth" finds "ViewLayer.Depth" where that is the only one.
    Empty where there is no such layer, or more than one.
    """
    layers: dict[str, list[str]] = {}
    for name in names:
        prefix, _, channel = name.rpartition(".")
        layers.setdefault(prefix, []).append(channel)
    if layer not in layers:
        ends = [name for name in layers if layer and name.endswith("." + layer)]
        if not layer and len(layers) == 1:
            ends = list(layers)
        if len(ends) != 1:
            return ()
        layer = ends[0]
    rank = {c: (k, order.index(c)) for k, order in reversed(list(enumerate(_ORDERS))) for c in order}
    ordered = sorted(layers[layer], key=lambda c: (rank.get(c.upper(), (len(_ORDERS), 0)), c))
    return tuple(f"{layer}.{c}" if layer else c for c in ordered)


def pick(
    stored: Mapping[str, np.ndarray],
    *,
    path: str | os.PathLike[str],
    count: int,
    layer: str = "",
    channels: Sequence[str] | None = None,
    exact: bool = False,
) -> np.ndarray:
    """`count` channels of a layer as float32 `[H, W, count]`, from what `read_exr` gave.

    Args:
        stored: channels by full name.
        path: for the error message.
        count: how many; the first ones of the layer, so one channel stored as grey RGB is found as well.
        layer: its name, or the end of it; "" is the unnamed layer, or the only one.
        channels: their names within the layer, where the first ones in the usual order are not meant.
        exact: 32-bit integers stay what they are, for float32 does not hold all of them.

    Raises:
        InputError: naming the channels that are there.
    """
    names = layer_channels(tuple(stored), layer)
    if channels is not None:
        by_end = {name.rpartition(".")[2]: name for name in names}
        names = tuple(by_end[c] for c in channels if c in by_end)
        wanted = f"the channels {', '.join(channels)}" + (f" of layer {layer!r}" if layer else "")
    else:
        wanted = f"{count} channel{'s'[: count > 1]}" + (f" in layer {layer!r}" if layer else "")
    if len(names) < count:
        have = ", ".join(stored)
        raise InputError(f"{path}: needs {wanted}, has {have}; name the layer and channels in a jaxtrapolate.toml")
    planes = [stored[name] for name in names[:count]]
    if exact and all(plane.dtype == np.uint32 for plane in planes):
        return np.stack(planes, axis=-1)
    return quiet(np.stack([plane.astype(np.float32) for plane in planes], axis=-1))


def quiet(image: np.ndarray) -> np.ndarray:
    """A float image with quiet NaNs, in place: those that signal warn in the arithmetic of every later step."""
    with np.errstate(invalid="ignore"):
        return np.multiply(image, image.dtype.type(1), out=image)


def write_exr(
    path: str | os.PathLike[str],
    image: Any,
    *,
    half: bool = True,
    compression: Compression = "zip",
) -> None:
    """Write an image, or several layers, as a scan-line EXR file, in full or not at all (`atomic_path`).

    Args:
        path: of the file; its folder must exist.
        image: `[H, W, C]` or `[H, W]`, named Y, RG, RGB or RGBA by its number of channels; or a mapping from full
            channel names to `[H, W]`.
        half: 16-bit floats (finite values beyond 65504 are clipped to it, smaller ones rounded), else 32-bit floats.
            In a mapping, unsigned integers stay 32-bit integers.
        compression: all of them are lossless.

    Raises:
        InputError: no such folder, no permission, disk full, or OpenEXR not installed.
    """
    check_choice("compression", compression, tuple(_COMPRESSIONS))
    library = _openexr(path)
    header = {
        "compression": getattr(library, _COMPRESSIONS[compression]),
        "type": library.scanlineimage,
    }
    channels = {name: _encode(plane, half) for name, plane in _planes(image).items()}
    with atomic_path(path) as temporary:
        try:
            library.File(header, channels).write(os.fsencode(temporary))
            read_header(temporary)  # A disk that fills up while the file is closed goes unnoticed otherwise.
        except (RuntimeError, InputError) as error:
            raise _write_error(path, error) from error


def _planes(image: Any) -> dict[str, np.ndarray]:
    if isinstance(image, Mapping):
        planes = {str(name): np.asarray(plane) for name, plane in image.items()}
    else:
        array = np.asarray(image)
        array = array[..., None] if array.ndim == 2 else array
        if array.ndim != 3 or array.shape[-1] not in _NAMES:
            raise ValueError(f"image: expected [H, W, C] with C from 1 to 4, or [H, W], got {list(array.shape)}")
        planes = {name: array[..., k] for k, name in enumerate(_NAMES[array.shape[-1]])}
    shapes = {plane.shape for plane in planes.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2 or 0 in next(iter(shapes)):
        raise ValueError(f"image: expected channels [H, W] of one size, got {sorted(map(list, shapes))}")
    return planes


def _encode(plane: np.ndarray, half: bool) -> np.ndarray:
    if plane.dtype.kind == "u":
        return np.ascontiguousarray(plane, np.uint32)
    plane = np.asarray(plane, np.float32)
    if not half:
        return np.ascontiguousarray(plane)
    clipped = np.where(np.isfinite(plane), np.clip(plane, -HALF_MAX, HALF_MAX), plane)
    return np.ascontiguousarray(clipped.astype(np.float16))


def _write_error(path: str | os.PathLike[str], error: Exception) -> InputError:
    text = " ".join(str(error).split())
    for code in (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS):
        if os.strerror(code) in text:
            return os_input_error(Path(path), OSError(code, os.strerror(code)), action="write")
    return InputError(f"{path}: cannot be written; is the disk full? Free some space and run again")
