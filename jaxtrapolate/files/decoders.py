"""Image files other than EXR, each kind told by its first bytes, its header checked before memory is asked for.

| kind | pixels | by |
|---|---|---|
| PNG, 1 to 16 bits a channel | codes | Pillow |
| JPEG, BMP, TGA, 8 bits | codes | Pillow |
| TIFF, 8 and 16 bits | codes | tifffile, and Pillow for 8 bits in a compression that tifffile lacks |
| TIFF, 32 and 64 bits and floats | values | tifffile |
| Radiance HDR (RGBE) | values | here, as no small library reads it |
| Middlebury `.flo`, unknown vectors become NaN | values | here |
| NumPy `.npy` `[H, W]` or `[H, W, C]` | codes where they are uint8 or uint16, else values | NumPy |

Codes are steps between 0 and 255 or 65535. Values are meant as they are stored. Nothing else is opened, in particular
nothing that Pillow would start a program for, and nothing whose colours are not grey or RGB (CMYK, Lab).
"""

import dataclasses
import functools
import importlib
import os
import re
import threading
import warnings
from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np

from jaxtrapolate.atomic import os_input_error
from jaxtrapolate.errors import InputError
from jaxtrapolate.files.limits import check_claim, check_pixels
from jaxtrapolate.files.silence import silence
from jaxtrapolate.regular import open_regular

KINDS = "PNG, JPEG, BMP, TGA, TIFF, Radiance HDR, .flo or .npy"
_STORE = "store it as EXR or PNG"
_CHANNELS = {"1": 1, "L": 1, "I;16": 1, "I;16B": 1, "I;16L": 1, "LA": 2, "RGB": 3, "RGBA": 4}
_PLUGINS = {"PNG": "Png", "JPEG": "Jpeg", "BMP": "Bmp", "TGA": "Tga", "TIFF": "Tiff"}


@dataclasses.dataclass(frozen=True)
class ImageHeader:
    """What a file says about its pixels: size (H, W), number of channels, type, and whether the last one is alpha."""

    size: tuple[int, int]
    channels: int
    dtype: np.dtype
    alpha: bool = False

    @property
    def codes(self) -> bool:
        """Whether the pixels are steps between 0 and the type's largest number, not values."""
        return self.dtype in (np.uint8, np.uint16)


Decoded = tuple[ImageHeader, np.ndarray | None]


def decode(path: str | os.PathLike[str], *, pixels: bool = True) -> Decoded:
    """The header of an image file, and its pixels `[H, W, C]` in the type they are stored in where these are asked for.

    Palettes are resolved to RGB or RGBA, a colour or grey that stands for "transparent" becomes an alpha channel; a
    black-and-white image has the codes 0 and 255.

    Raises:
        InputError: missing, no permission, no regular file, of a kind that is not read, truncated or damaged, too
            large (`jaxtrapolate.files.limits`), of several pictures, or in other colours than grey and RGB.
    """
    try:
        with open_regular(path) as stream, silence():
            head = stream.read(16)
            stream.seek(0)
            header, array = _reader(path, head)(path, stream, pixels)
    except InputError:
        raise
    except Exception as error:  # What the libraries raise on damaged bytes is not documented.
        if isinstance(error, OSError) and error.errno is not None:
            raise os_input_error(path, error) from error
        raise InputError(f"{path}: truncated or damaged; render or copy it again") from error
    if array is not None and array.shape != (*header.size, header.channels):
        raise InputError(f"{path}: truncated or damaged; render or copy it again")
    return header, array


Reader = Callable[[str | os.PathLike[str], BinaryIO, bool], Decoded]


def _reader(path: str | os.PathLike[str], head: bytes) -> Reader:
    for signature, reader in _SIGNATURES:
        if head.startswith(signature):
            return reader
    if os.fsdecode(path).lower().endswith(".tga"):  # which has no signature
        return _TGA
    if not head:
        raise InputError(f"{path}: empty; render or copy it again")
    if head.startswith(b"v/1\x01"):
        raise InputError(f"{path}: is an EXR file; give it the ending .exr")
    raise InputError(f"{path}: not an image of a kind that is read ({KINDS}); {_STORE}")


def _pillow(path: str | os.PathLike[str], stream: BinaryIO, pixels: bool, kind: str) -> Decoded:
    if kind == "PNG" and _animated(stream):
        raise InputError(f"{path}: holds several pictures (an animated PNG); store one in each file")
    image = _open(kind, stream)
    check_pixels(path, image.height, image.width)
    raw = str(image.tile[0][3]) if image.tile else ""
    wide = ";16" in raw and kind == "PNG"
    if image.mode in ("P", "PA"):
        alpha = image.mode == "PA" or "transparency" in image.info
        channels = 4 if alpha else 3
    elif image.mode in _CHANNELS:
        keyed = "transparency" in image.info and image.mode != "LA" and image.mode != "RGBA"
        channels = 2 if raw == "LA;16B" else _CHANNELS[image.mode] + keyed
        alpha = channels in (2, 4)
    else:
        raise InputError(f"{path}: its colours are {image.mode}, not grey or RGB; {_STORE}")
    dtype = np.dtype(np.uint16 if wide or image.mode.startswith("I;16") else np.uint8)
    header = ImageHeader((image.height, image.width), channels, dtype, alpha)
    if not pixels:
        return header, None
    if wide and not image.mode.startswith("I;16"):
        codes = _wide(image, raw, stream)
    elif image.mode in ("P", "PA"):
        codes = np.array(image.convert("RGBA" if alpha else "RGB"))
    else:
        codes = np.array(image.convert("L") if image.mode == "1" else image).astype(dtype, copy=False)
    codes = codes if codes.ndim == 3 else codes[..., None]
    if codes.shape[-1] < channels:
        codes = _with_key(codes, image.info["transparency"], raw)
    return header, codes


def _open(kind: str, stream: BinaryIO) -> Any:
    """A Pillow image of this one kind: no other plugin looks at the file."""
    name = _PLUGINS[kind]
    stream.seek(0)
    return getattr(importlib.import_module(f"PIL.{name}ImagePlugin"), f"{name}ImageFile")(stream)


def _animated(stream: BinaryIO) -> bool:
    """Whether a PNG has the chunk of animations before its pixels."""
    stream.seek(8)
    while len(start := stream.read(8)) == 8:
        if start[4:] in (b"IDAT", b"acTL"):
            return start[4:] == b"acTL"
        stream.seek(int.from_bytes(start[:4], "big") + 4, os.SEEK_CUR)
    return False


def _wide(image: Any, raw: str, stream: BinaryIO) -> np.ndarray:
    """The 16-bit codes of a PNG with several channels, of which Pillow keeps the upper bytes alone.

    It decodes the file's bytes by a layout, though, that can be set: the upper bytes, then the lower ones; or, for
    grey with alpha, all four bytes of a pixel.
    """

    if raw == "LA;16B":
        both = _bytes_by(stream, "RGBA")
        return both[..., 0::2] << 8 | both[..., 1::2]
    return _bytes_by(stream, f"{image.mode};16B") << 8 | _bytes_by(stream, f"{image.mode};16L")


def _bytes_by(stream: BinaryIO, layout: str) -> np.ndarray:
    image = _open("PNG", stream)
    image.tile = [t._replace(args=layout) if hasattr(t, "_replace") else (*t[:3], layout) for t in image.tile]
    return np.array(image).astype(np.uint16)


def _with_key(codes: np.ndarray, key: Any, raw: str) -> np.ndarray:
    """Codes with alpha: 0 where the colour is the one that a PNG names as transparent."""
    scale = {"1": 255, "L;2": 85, "L;4": 17}.get(raw, 1)
    opaque = (codes != np.array(key, np.int64) * scale).any(axis=-1, keepdims=True)
    return np.concatenate([codes, opaque.astype(codes.dtype) * np.iinfo(codes.dtype).max], axis=-1)


def _tiff(path: str | os.PathLike[str], stream: BinaryIO, pixels: bool) -> Decoded:
    import tifffile

    with tifffile.TiffFile(stream, name="image.tif") as file:
        page: Any = file.pages.first
        height, width, samples = int(page.imagelength), int(page.imagewidth), int(page.samplesperpixel)
        check_pixels(path, height, width, samples)
        dtype = page.dtype
        photometric = int(page.photometric)
        if photometric not in (0, 1, 2, 3, 6):  # white is 0, black is 0, RGB, palette, YCbCr
            name = getattr(page.photometric, "name", photometric)
            raise InputError(f"{path}: its colours are {name}, not grey or RGB; {_STORE}")
        if int(getattr(page, "imagedepth", 1)) != 1 or _several(file):
            raise InputError(f"{path}: holds several pictures; store one in each file")
        if dtype is None or dtype.kind not in "buif":
            raise InputError(f"{path}: pixels of {page.bitspersample} bits cannot be read; {_STORE}")
        plain = photometric in (1, 2) and dtype.kind != "b"
        extra = tuple(int(kind) for kind in page.extrasamples)
        if not plain:
            if dtype.kind != "b" and dtype != np.uint8:
                raise InputError(f"{path}: {page.photometric.name.lower()} of {dtype} cannot be read; {_STORE}")
            return _pillow_tiff(path, stream, pixels)
        header = ImageHeader((height, width), samples, dtype, samples in (2, 4) and bool(extra) and extra[-1] in (1, 2))
        if not pixels:
            return header, None
        check_claim(path, height * width * samples * dtype.itemsize, os.fstat(stream.fileno()).st_size)
        try:
            array = np.asarray(page.asarray(maxworkers=1))
        except ValueError as error:
            if "imagecodecs" not in str(error):
                raise
            if dtype == np.uint8:
                return _pillow_tiff(path, stream, pixels)
            name = getattr(page.compression, "name", page.compression)
            text = f"compressed by {name}, for which the package imagecodecs is needed"
            raise InputError(f"{path}: {text}; run: pip install imagecodecs, or {_STORE}") from error
        if str(page.axes).startswith("S"):  # one plane after the other
            array = np.moveaxis(array, 0, -1)
        array = array.astype(dtype.newbyteorder("="), copy=False)
        return header, array if array.ndim == 3 else array[..., None]


_warnings = threading.Lock()


def _pillow_tiff(path: str | os.PathLike[str], stream: BinaryIO, pixels: bool) -> Decoded:
    """What tifffile cannot decode; Pillow warns of odd tags, and the filters of warnings are one for all threads."""
    with _warnings, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return _pillow(path, stream, pixels, "TIFF")


def _several(file: Any) -> bool:
    """Whether there is a second picture that is no smaller copy or mask of the first."""
    try:
        return not int(file.pages[1].subfiletype) & 5
    except IndexError:
        return False


def _claimed(stream: BinaryIO, count: int) -> bytes:
    """The next bytes of a file, after checking that so many are left."""
    if count > os.fstat(stream.fileno()).st_size - stream.tell():
        raise EOFError("fewer bytes than the header states")
    return stream.read(count)


def _npy(path: str | os.PathLike[str], stream: BinaryIO, pixels: bool) -> Decoded:
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise InputError(f"{path}: an array with named fields is no image; {_STORE}")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(stream)
    if dtype.kind not in "fiub" or len(shape) not in (2, 3):
        raise InputError(f"{path}: an array {list(shape)} of {dtype} is no image [H, W, C] of numbers; {_STORE}")
    height, width, channels = (*shape, 1)[:3]
    check_pixels(path, height, width, channels)
    plain = np.dtype(np.uint8) if dtype.kind == "b" else dtype.newbyteorder("=")
    header = ImageHeader((height, width), channels, plain)
    if not pixels:
        return header, None
    data = np.frombuffer(_claimed(stream, height * width * channels * dtype.itemsize), dtype)
    array = data.reshape(shape, order="F" if fortran else "C").reshape(height, width, channels)
    return header, array.astype(plain) * np.uint8(255) if dtype.kind == "b" else array.astype(plain)


def _flo(path: str | os.PathLike[str], stream: BinaryIO, pixels: bool) -> Decoded:
    """Middlebury's flow file (vision.middlebury.edu/flow/code/flow-code/README.txt): beyond 1e9 it is unknown."""
    stream.seek(4)
    width, height = np.frombuffer(_claimed(stream, 8), "<i4").tolist()
    check_pixels(path, height, width, 2)
    header = ImageHeader((height, width), 2, np.dtype(np.float32))
    if not pixels:
        return header, None
    flow = np.frombuffer(_claimed(stream, height * width * 8), "<f4").astype(np.float32).reshape(height, width, 2)
    unknown = ~(np.abs(flow) <= 1e9).all(axis=-1, keepdims=True)
    return header, np.where(unknown, np.float32(np.nan), flow)


_SIZE = re.compile(rb"-Y ([0-9]{1,9}) \+X ([0-9]{1,9})")


def _hdr(path: str | os.PathLike[str], stream: BinaryIO, pixels: bool) -> Decoded:
    """Radiance HDR, the layout of most writers: RGBE, top row first, rows in runs or plain (Ward, Graphics Gems II).

    A value is mantissa * 2^(exponent - 136), as OpenCV and stb_image have it, without Ward's half step; what the
    header says of the exposure is divided out.
    """
    exposure = 1.0
    for _ in range(256):
        line = stream.readline(4096).strip()
        if not line:
            break
        if line.startswith(b"FORMAT=") and line != b"FORMAT=32-bit_rle_rgbe":
            raise InputError(f"{path}: its colours are {line[7:40].decode('ascii', 'replace')}, not RGB; {_STORE}")
        if line.startswith((b"EXPOSURE=", b"COLORCORR=")):
            values = line.split(b"=", 1)[1].split()
            if line.startswith(b"COLORCORR=") and {float(value) for value in values} != {1.0}:
                raise InputError(f"{path}: has a colour correction, which is not read; {_STORE}")
            exposure *= float(values[0])
    match = _SIZE.fullmatch(stream.readline(64).strip())
    if match is None:
        raise InputError(f"{path}: its header states no size '-Y height +X width'; {_STORE}")
    height, width = int(match[1]), int(match[2])
    check_pixels(path, height, width, 4)
    header = ImageHeader((height, width), 3, np.dtype(np.float32))
    if not pixels:
        return header, None
    codes = _rgbe(path, stream.read(), height, width)
    if not 0 < exposure < 1e30:
        raise ValueError("exposure")
    scale = np.where(codes[..., 3:] > 0, np.ldexp(1.0 / exposure, codes[..., 3:].astype(np.int32) - 136), 0.0)
    with np.errstate(over="ignore"):
        return header, (codes[..., :3] * scale).astype(np.float32)


def _rgbe(path: str | os.PathLike[str], data: bytes, height: int, width: int) -> np.ndarray:
    """The four bytes of every pixel, `[H, W, 4]`."""
    lead = bytes((2, 2, width >> 8, width & 255)) if 8 <= width < 32768 else b""
    if not (lead and data.startswith(lead)):
        plain = np.frombuffer(data, np.uint8, len(data) // 4 * 4).reshape(-1, 4)[: height * width]
        if (plain[:, :3] == 1).all(axis=-1).any():
            raise InputError(f"{path}: Radiance HDR in runs of the layout before 1991, which is not read; {_STORE}")
        return plain.reshape(height, width, 4)
    if len(data) < height * (4 + 4 * 2 * -(-width // 127)):
        raise EOFError("fewer bytes than the header states")
    rows = []
    at = 0
    for _ in range(height):
        if data[at : at + 4] != lead:
            raise ValueError("a row does not begin with its width")
        at += 4
        row = bytearray()
        while len(row) < 4 * width:
            count = data[at]
            if count > 128:
                row += data[at + 1 : at + 2] * (count - 128)
                at += 2
            elif count and len(data) > at + count:
                row += data[at + 1 : at + 1 + count]
                at += 1 + count
            else:
                raise ValueError("a run of no pixels")
        if len(row) > 4 * width:
            raise ValueError("a row longer than its width")
        rows.append(np.frombuffer(row, np.uint8).reshape(4, width))
    return np.stack(rows).transpose(0, 2, 1)


_SIGNATURES: tuple[tuple[bytes, Reader], ...] = (
    (b"\x89PNG\r\n\x1a\n", functools.partial(_pillow, kind="PNG")),
    (b"\xff\xd8\xff", functools.partial(_pillow, kind="JPEG")),
    (b"II*\0", _tiff),
    (b"MM\0*", _tiff),
    (b"II+\0", _tiff),
    (b"MM\0+", _tiff),
    (b"#?", _hdr),
    (b"PIEH", _flo),
    (b"\x93NUMPY", _npy),
    (b"BM", functools.partial(_pillow, kind="BMP")),
)
_TGA = functools.partial(_pillow, kind="TGA")
