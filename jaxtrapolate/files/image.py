"""Images that are no EXR: read by what they hold, and one function that writes a frame as its input was.

What is read is in `jaxtrapolate.files.decoders`; written are EXR for HDR and PNG for 8-bit.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.errors import InputError
from jaxtrapolate.files.decoders import ImageHeader, decode
from jaxtrapolate.files.exr import write_exr

_MODES = {1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}


def _curve(largest: int) -> np.ndarray:
    """The linear value of every sRGB code from 0 to `largest` (IEC 61966-2-1), float32."""
    code = np.arange(largest + 1) / float(largest)
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4).astype(np.float32)


_LINEAR = _curve(255)


def decode_srgb(codes: np.ndarray) -> np.ndarray:
    """Linear float32 values of 8-bit or 16-bit sRGB codes, by the exact curve; `encode_srgb` gives 8-bit ones back."""
    if codes.dtype == np.uint16:
        return _curve(65535)[codes]
    return _LINEAR[codes]


def encode_srgb(linear: Any) -> np.ndarray:
    """8-bit sRGB codes of linear values: clipped to 0..1, exact curve, rounded to the nearest; NaN becomes 0."""
    linear = np.clip(np.nan_to_num(np.asarray(linear, np.float64), nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    code = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(code * 255.0).astype(np.uint8)


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """`(H, W)` of an image file, from its header alone."""
    return image_header(path).size


def image_header(path: str | os.PathLike[str]) -> ImageHeader:
    """Size, channels, type and alpha of an image file, from its header alone; raises `InputError` as `read_image`."""
    return decode(path, pixels=False)[0]


def read_image(path: str | os.PathLike[str]) -> tuple[ImageHeader, np.ndarray]:
    """An image file's header, and its pixels `[H, W, C]` in the type they are stored in, alpha as the last channel.

    Raises:
        InputError: missing, no permission, no regular file, of a kind that is not read, truncated or damaged, too
            large, of several pictures, or in other colours than grey and RGB.
    """
    header, pixels = decode(path)
    assert pixels is not None
    return header, pixels


def read_png(path: str | os.PathLike[str]) -> np.ndarray:
    """The stored codes `[H, W, C]` of a PNG, or of another image file of codes: uint8, or uint16 where it has 16 bits.

    Palettes are resolved to RGB or RGBA; a black-and-white image becomes 0 and 255.

    Raises:
        InputError: as `read_image`; and an image of other numbers than codes of 8 or 16 bits.
    """
    header, pixels = read_image(path)
    if not header.codes:
        raise InputError(f"{path}: holds values of {header.dtype}, where 8-bit or 16-bit codes are needed")
    return pixels


def write_png(path: str | os.PathLike[str], codes: Any) -> None:
    """Write 8-bit codes `[H, W, C]` (C from 1 to 4) or `[H, W]` as a PNG, in full or not at all (`atomic_path`).

    Raises:
        InputError: no such folder, no permission, or disk full.
    """
    array = np.asarray(codes)
    array = array[..., None] if array.ndim == 2 else array
    if array.dtype != np.uint8:
        raise TypeError(f"codes: expected dtype uint8, got {array.dtype}")
    if array.ndim != 3 or array.shape[-1] not in _MODES or 0 in array.shape:
        raise ValueError(f"codes: expected [H, W, C] with C from 1 to 4, or [H, W], got {list(array.shape)}")
    array = np.ascontiguousarray(array[..., 0] if array.shape[-1] == 1 else array)
    with atomic_path(path) as temporary:
        Image.fromarray(array).save(temporary, format="PNG")


def write_frame(path: str | os.PathLike[str], color: Any, hdr: bool, *, half: bool = True) -> Path:
    """Write a frame's linear colour `[H, W, 3]` in the kind of file its input had.

    Args:
        path: where to; `.exr` or `.png` is appended, or exchanged for the other.
        color: linear radiance, a NumPy or JAX array.
        hdr: EXR, unchanged, else an 8-bit sRGB PNG, clipped to 0..1.
        half: 16-bit floats in the EXR, else 32-bit.

    Returns:
        The path of the file that was written.
    """
    path = Path(path)
    stem = path.stem if path.suffix.lower() in (".exr", ".png") else path.name
    path = path.with_name(stem + (".exr" if hdr else ".png"))
    color = np.asarray(color)
    if color.ndim != 3 or color.shape[-1] != 3:
        raise ValueError(f"color: expected shape [H, W, 3], got {list(color.shape)}")
    if hdr:
        write_exr(path, color, half=half)
    else:
        write_png(path, encode_srgb(color))
    return path
