"""Files by pattern: a small TOML file `jaxtrapolate.toml` in the folder says which file holds which buffer.

A full example, for a multi-layer render with PNG masks beside it:

    name = "courtyard"                # for reports; by default the folder's name
    hdr = true                        # colour is HDR; by default where the colour is an EXR
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
- `srgb`: decode 8-bit codes to linear; by default for `color` alone.

A pattern is a path relative to the folder with one `{frame}` in the file's name, with leading zeros as in
`{frame:04d}`. Codes of PNG files become 0..1, save for a stencil's, which are ids. Flows are in the library's own
convention, their third channel in the unit of position. Depth +inf is the sky (`jaxtrapolate.files.repair`).

For the other readers the same file may hold `[motion]` alone: there, what it leaves out keeps the reader's own default.
"""

import dataclasses
import os
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np

from jaxtrapolate.files.atomic import os_input_error
from jaxtrapolate.files.exr import pick, read_exr
from jaxtrapolate.files.image import decode_srgb, read_png
from jaxtrapolate.files.reader import BUFFERS, FileSequence, Opened, list_folder
from jaxtrapolate.files.sequence import InputError, MotionConvention
from jaxtrapolate.motion import Sign, Units, YAxis

SETTINGS_NAME = "jaxtrapolate.toml"
"""The name of the TOML file in a folder of frames."""

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
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise os_input_error(path, error) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML, {' '.join(str(error).split())}; correct it") from error
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
_number = _instance((int, float), "a number")


def _channels(value: Any) -> tuple[str, ...]:
    if not isinstance(value, str | list) or not value or not all(isinstance(c, str) for c in value):
        raise ValueError("a list of names or a string of one-letter names")
    return tuple(value)


def _pattern(value: Any) -> str:
    if not isinstance(value, str) or len(_FIELD.findall(value)) != 1 or not _FIELD.search(os.path.basename(value)):
        raise ValueError("a path with one {frame} or {frame:04d} in the file's name")
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
        super().__init__(
            folder,
            _find(Path(folder), settings),
            name=settings.name or Path(folder).resolve().name,
            hdr=settings.hdr if settings.hdr is not None else color is None or _is_exr(color.file),
            depth=settings.depth,
            convention=motion or settings.convention(MotionConvention()),
            strict=strict,
        )

    def _read(self, path: Path, buffer: str, opened: Opened) -> np.ndarray:
        spec, count = self._buffers[buffer], BUFFERS[buffer]
        name = str(path)
        if _is_exr(name):
            if name not in opened:
                opened[name] = read_exr(path)
            image = pick(opened[name], path=path, count=count, layer=spec.layer, channels=spec.channels)
        else:
            if name not in opened:
                opened[name] = read_png(path)
            image = _values(path, opened[name], buffer, spec)
        if spec.above is not None:
            return (image > spec.above).astype(np.float32)
        if (spec.scale, spec.offset) != (1.0, 0.0):
            with np.errstate(over="ignore"):
                image = image * np.float32(spec.scale) + np.float32(spec.offset)
        return np.float32(1) - image if spec.invert else image


def _is_exr(name: str) -> bool:
    return name.lower().endswith(".exr")


def _values(path: Path, codes: np.ndarray, buffer: str, spec: Buffer) -> np.ndarray:
    """The float32 values of a PNG's codes, `[H, W, count]`."""
    count = BUFFERS[buffer]
    available = "Y" if codes.shape[-1] <= 2 else "RGBA"
    names = spec.channels or tuple(available[:count])
    places = [available[: codes.shape[-1]].find(name) if len(name) == 1 else -1 for name in names]
    if len(places) < count or min(places) < 0:
        have = ", ".join(available[: codes.shape[-1]])
        raise InputError(f"{path}: {buffer} needs {count} channels ({', '.join(names)}), has {have}; correct the TOML")
    codes = codes[..., places]
    if buffer == "stencil":
        return codes.astype(np.float32)
    if spec.srgb and codes.dtype == np.uint8:
        return decode_srgb(codes)
    return codes.astype(np.float32) / np.float32(np.iinfo(codes.dtype).max)


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
        found = [(int(match[1]), name) for name in listed[parent] if (match := pattern.fullmatch(name))]
        if not found:
            raise InputError(f"{folder}: no file for {buffer}, {spec.file}; correct the pattern in {settings.path}")
        for frame, name in found:
            files.setdefault(frame, {})[buffer] = os.path.join(parent, name)
    return files
