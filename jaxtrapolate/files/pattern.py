"""Files by pattern: a small TOML file `jaxtrapolate.toml` in the folder says which file holds which buffer.

A full example, for a multi-layer render with PNG masks beside it:

    name = "courtyard"                # for reports; by default the folder's name
    hdr = true                        # colour is HDR; by default where the colour is an EXR or other values
    depth = "metric"                  # in the unit of position, or "ordinal": only larger = farther

    [motion]                          # how motion vectors are stated; what is left out: the library's convention
    sign = "current_minus_previous"   # or "previous_minus_current"
    units = "pixels"                  # or "uv" (the frame is 0..1) or "ndc" (-1..1)
    y_axis = "up"                     # or "down"

    [buffers]
    color = "beauty.{frame:04d}.exr"
    depth = { file = "multi.{frame:04d}.exr", layer = "ViewLayer.Depth", channels = "Z", scale = 0.01 }
    sky = { file = "multi.{frame:04d}.exr", layer = "ViewLayer.Depth", channels = "Z", above = 1e9 }
    normal = { file = "multi.{frame:04d}.exr", layer = "ViewLayer.Normal" }
    motion = { file = "multi.{frame:04d}.exr", layer = "ViewLayer.Vector", channels = ["X", "Y"] }
    albedo = { file = "albedo/{frame}.png", srgb = true }
    stencil = "mask/{frame:04d}.png"
    shadow = { file = "light/{frame:04d}.png", invert = true }

A buffer is `color`, `motion`, a field of `GBuffer`, `forward_flow` or `backward_flow`; its value is a pattern or a
table with `file` and some of

- `layer`: of an EXR, or the end of its name; the part's name in a multi-part file. By default the unnamed layer.
- `channels`: their names in the layer, a list or a string of one-letter names. By default the first ones needed, in
  the order RGBA, XYZ, UVW, Y, Z.
- `scale`, `offset`: the value is stored * scale + offset, e.g. 2 and -1 for normals in a PNG.
- `invert`: 1 - value, after scale and offset: masks of the other polarity, ordinal depth that is larger when nearer.
- `above`: 1 where the stored value is above this number, else 0; scale, offset and invert do not apply.
- `srgb`: decode codes of 8 or 16 bits to linear; by default for `color` alone.
- `codes`: take the codes of an image of 8 or 16 bits as they are stored, not as 0..1, before scale and offset.
- `valid`: a channel of the file that is 0 where it holds no value: there the buffer is not finite, so the pixel is
  counted and becomes a hole.

So this reads motion in the encoding of the KITTI benchmark, PNG files of 16 bits with u = (R - 2^15) / 64, v likewise
from G, and B = 0 where nothing was measured (`[motion]` says what u and v mean):

    motion = { file = "{frame:06d}_10.png", codes = true, scale = 0.015625, offset = -512, valid = "B" }

A pattern is a path relative to the folder with one `{frame}` in the file's name, with leading zeros as in
`{frame:04d}`. Codes of images (PNG and others, of 8 or 16 bits) become 0..1, save for a stencil's, which are ids; other
numbers (TIFF of 32 bits or floats, Radiance HDR, `.flo`, `.npy`) are values as they are stored, and never sRGB;
`jaxtrapolate.files.decoders` lists the files. Their channels are named Y, RG, RGB by their number, and A is alpha; more
than four are named "0", "1" and so on. Colour with alpha 0 is a hole (`jaxtrapolate.files.alpha`). Flows are in the
library's own convention, their third channel in the unit of position. Depth +inf is the sky
(`jaxtrapolate.files.repair`).

For the other readers the same file may hold `[motion]` alone: there, what it leaves out keeps the reader's own default.
"""

import dataclasses
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np

from jaxtrapolate.files.alpha import without_empty
from jaxtrapolate.files.decoders import ImageHeader
from jaxtrapolate.files.exr import pick, quiet, read_exr
from jaxtrapolate.files.image import decode_srgb, image_header, read_image
from jaxtrapolate.files.reader import BUFFERS, FileSequence, Opened, frame_number, list_folder
from jaxtrapolate.files.sequence import InputError, MotionConvention
from jaxtrapolate.files.text import read_toml
from jaxtrapolate.motion import Sign, Units, YAxis

SETTINGS_NAME = "jaxtrapolate.toml"
"""The name of the TOML file in a folder of frames."""

_LARGEST_NUMBER = float(np.finfo(np.float32).max)
_MOST_DIGITS = 15
_FIELD = re.compile(r"\{frame(?::0?(\d*)d)?\}")


@dataclasses.dataclass(frozen=True)
class Buffer:
    """Where a buffer lies and how its values are to be read; the module's docstring explains the fields."""

    file: str
    layer: str = ""
    channels: tuple[str, ...] | None = None
    scale: float = 1.0
    offset: float = 0.0
    invert: bool = False
    above: float | None = None
    srgb: bool = False
    codes: bool = False
    valid: str = ""


@dataclasses.dataclass(frozen=True)
class Settings:
    """The content of a `jaxtrapolate.toml`; `motion` holds the fields of `MotionConvention` that it states."""

    path: Path
    buffers: dict[str, Buffer]
    motion: dict[str, str]
    name: str | None = None
    hdr: bool | None = None
    depth: Literal["metric", "ordinal"] = "metric"

    def convention(self, base: MotionConvention) -> MotionConvention:
        """`base` with what `[motion]` states."""
        return dataclasses.replace(base, **cast("dict[str, Any]", self.motion))


def read_settings(path: str | os.PathLike[str]) -> Settings:
    """Read and check a `jaxtrapolate.toml`.

    Raises:
        InputError: missing, not TOML, an unknown key or a value of the wrong kind, named.
    """
    path = Path(path)
    content = read_toml(path)
    kinds = {"name": _text, "hdr": _flag, "depth": _choice("metric", "ordinal"), "motion": _table, "buffers": _table}
    content = _checked(path, "", content, kinds)
    motion = _checked(
        path,
        "motion.",
        content.pop("motion", {}),
        {"sign": _choice(*get_args(Sign)), "units": _choice(*get_args(Units)), "y_axis": _choice(*get_args(YAxis))},
    )
    buffers = _checked(path, "buffers.", content.pop("buffers", {}), dict.fromkeys(BUFFERS, _text_or_table))
    return Settings(path, {name: _buffer(path, name, value) for name, value in buffers.items()}, motion, **content)


Kind = Callable[[Any], Any]


def _checked(path: Path, prefix: str, table: dict[str, Any], kinds: dict[str, Kind]) -> dict[str, Any]:
    """The values of a table, after checking that each has a known key and a value of its kind."""
    out = {}
    for key, value in table.items():
        if key not in kinds:
            raise InputError(f"{path}: unknown key {prefix + key!r}; one of {', '.join(kinds)} is meant")
        try:
            out[key] = kinds[key](value)
        except ValueError as error:
            raise InputError(f"{path}: {prefix}{key}: expected {error}, got {value!r}; correct it") from error
    return out


def _choice(*choices: str) -> Kind:
    def check(value: Any) -> str:
        if value not in choices:
            raise ValueError(f"one of {', '.join(choices)}")
        return value

    return check


def _instance(kind: type | tuple[type, ...], words: str) -> Kind:
    def check(value: Any) -> Any:
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise ValueError(words)
        return value

    return check


_text = _instance(str, "a text")
_flag = _instance(bool, "true or false")
_table = _instance(dict, "a table")
_text_or_table = _instance((str, dict), "a pattern or a table")
_any_number = _instance((int, float), "a number")


def _number(value: Any) -> Any:
    if not abs(_any_number(value)) <= _LARGEST_NUMBER:  # no NaN either
        raise ValueError("a finite number that 32 bits hold")
    return value


def _channels(value: Any) -> tuple[str, ...]:
    if not isinstance(value, str | list) or not value or not all(isinstance(c, str) for c in value):
        raise ValueError("a list of names or a string of one-letter names")
    return tuple(value)


def _pattern(value: Any) -> str:
    if not isinstance(value, str) or len(_FIELD.findall(value)) != 1 or not _FIELD.search(os.path.basename(value)):
        raise ValueError("a path with one {frame} or {frame:04d} in the file's name")
    digits = _FIELD.findall(value)[0].lstrip("0")
    if len(digits) > 2 or int(digits or 0) > _MOST_DIGITS:
        raise ValueError(f"a frame's number of at most {_MOST_DIGITS} digits")
    return value


def _buffer(path: Path, name: str, value: str | dict[str, Any]) -> Buffer:
    kinds = {
        "file": _pattern,
        "layer": _text,
        "channels": _channels,
        "scale": _number,
        "offset": _number,
        "invert": _flag,
        "above": _number,
        "srgb": _flag,
        "codes": _flag,
        "valid": _text,
    }
    table = _checked(path, f"buffers.{name}.", {"file": value} if isinstance(value, str) else value, kinds)
    if "file" not in table:
        raise InputError(f'{path}: buffers.{name}: no file; add one such as file = "{name}.{{frame:04d}}.exr"')
    if len(table.get("channels", ())) not in (0, BUFFERS[name]):
        raise InputError(f"{path}: buffers.{name}.channels: expected {BUFFERS[name]}, got {len(table['channels'])}")
    return Buffer(**{"srgb": name == "color", **table})


class PatternSequence(FileSequence):
    """Files by pattern; see the module's docstring for the TOML file that describes them.

    Args:
        folder: that of the frames.
        settings: the TOML file, where it is not `jaxtrapolate.toml` in the folder, or its content.
        motion: how the motion vectors are stated; goes before what the TOML file says.
        strict: raise on reading a frame with a non-finite pixel.

    Raises:
        InputError: no such folder, a TOML file that cannot be used, no files of these names, a missing file, files of
            different sizes.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        settings: str | os.PathLike[str] | Settings | None = None,
        motion: MotionConvention | None = None,
        strict: bool = False,
    ) -> None:
        list_folder(folder)
        if not isinstance(settings, Settings):
            settings = read_settings(Path(folder) / SETTINGS_NAME if settings is None else settings)
        if not settings.buffers:
            raise InputError(f"{settings.path}: names no buffers; add a table [buffers]")
        self._buffers = settings.buffers
        color = settings.buffers.get("color")
        files = _find(Path(folder), settings)
        self._color_layer = "" if color is None else color.layer
        super().__init__(
            folder,
            files,
            name=settings.name or Path(folder).resolve().name,
            hdr=settings.hdr if settings.hdr is not None else _holds_values(Path(folder), files),
            depth=settings.depth,
            convention=motion or settings.convention(MotionConvention()),
            strict=strict,
        )

    def _read(self, path: Path, buffer: str, opened: Opened) -> np.ndarray:
        spec, count = self._buffers[buffer], BUFFERS[buffer]
        name = str(path)
        if name not in opened:
            opened[name] = read_exr(path) if _is_exr(name) else read_image(path)
        if _is_exr(name):
            image = pick(opened[name], path=path, count=count, layer=spec.layer, channels=spec.channels)
            if spec.valid:
                valid = pick(opened[name], path=path, count=1, layer=spec.layer, channels=[spec.valid])[..., 0]
                image = without_empty(image, valid)
            if buffer == "color":
                image = self._exr_color(path, image, opened[name])
        else:
            header, pixels = opened[name]
            image = _values(path, header, pixels, buffer, spec)
        if spec.above is not None:
            return (image > spec.above).astype(np.float32)
        if (spec.scale, spec.offset) != (1.0, 0.0):
            with np.errstate(over="ignore"):
                image = image * np.float32(spec.scale) + np.float32(spec.offset)
        return np.float32(1) - image if spec.invert else image


def _is_exr(name: str) -> bool:
    return name.lower().endswith(".exr")


def _holds_values(folder: Path, files: Mapping[int, Mapping[str, str]]) -> bool:
    """Whether the first colour there is holds values, not codes; true where there is none."""
    color = next((buffers["color"] for _, buffers in sorted(files.items()) if "color" in buffers), None)
    return color is None or _is_exr(color) or not image_header(folder / color).codes


def _values(path: Path, header: ImageHeader, pixels: np.ndarray, buffer: str, spec: Buffer) -> np.ndarray:
    """The float32 values of an image that is no EXR, `[H, W, count]`."""
    count = BUFFERS[buffer]
    names = _names(header)
    wanted = spec.channels or tuple(names[: count if names[:1] != ["Y"] else 1])
    places = [names.index(name) if name in names else -1 for name in (*wanted, *([spec.valid] if spec.valid else []))]
    if len(wanted) < count or min(places) < 0:
        have = ", ".join(names)
        raise InputError(f"{path}: {buffer} needs {count} channels ({', '.join(wanted)}), has {have}; correct the TOML")
    stored = pixels[..., places[: len(wanted)]]
    if buffer == "stencil" or spec.codes or not header.codes:
        with np.errstate(over="ignore", invalid="ignore"):
            image = quiet(stored.astype(np.float32))
    elif spec.srgb:
        image = decode_srgb(stored)
    else:
        image = stored.astype(np.float32) / np.float32(np.iinfo(stored.dtype).max)
    if spec.valid:
        image = without_empty(image, pixels[..., places[-1]])
    return without_empty(image, pixels[..., -1]) if buffer == "color" and header.alpha else image


def _names(header: ImageHeader) -> list[str]:
    """The names of an image's channels; see the module's docstring."""
    if header.channels > 4:
        return [str(k) for k in range(header.channels)]
    return list("YA" if header.alpha and header.channels == 2 else (" Y", "Y", "RG", "RGB", "RGBA")[header.channels])


def _find(folder: Path, settings: Settings) -> dict[int, dict[str, str]]:
    """For each frame the file of each buffer, from the patterns."""
    files: dict[int, dict[str, str]] = {}
    listed: dict[str, list[str]] = {}
    for buffer, spec in settings.buffers.items():
        parent, base = os.path.split(spec.file)
        if parent not in listed:
            listed[parent] = list_folder(folder / parent)
        before, digits, after = _FIELD.split(base)
        number = rf"\d{{{int(digits)},}}" if digits else r"\d+"
        pattern = re.compile(rf"{re.escape(before)}({number}){re.escape(after)}")
        found = [(frame_number(match[1], name), name) for name in listed[parent] if (match := pattern.fullmatch(name))]
        if not found:
            raise InputError(f"{folder}: no file for {buffer}, {spec.file}; correct the pattern in {settings.path}")
        for frame, name in found:
            files.setdefault(frame, {})[buffer] = os.path.join(parent, name)
    return files
