"""Files by pattern: a small TOML file `jaxtrapolate.toml` in the folder says which file holds which buffer.

A full example, for a multi-layer render with PNG masks beside it:

    name = "courtyard"                # for reports; by default the folder's name
    hdr = true                        # colour is HDR; by default where the colour is an EXR
    depth = "metric"                  # in the unit of position, or "ordinal": only larger = farther
    step = 1                          # from one frame's number to the next one's; by default it is found
    static_ids = [7, "9e3779b1"]      # ids of the stencil that do not move: walls that have an id, as they are stored

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
  the order RGBA, XYZ, UVW, Y, Z; of colours (`color`, `albedo`, `sky_color`) that have only one channel that one, as
  grey, which a note says.
- `scale`, `offset`: the value is stored * scale + offset, e.g. 2 and -1 for normals in a PNG.
- `invert`: 1 - value, after scale and offset: masks of the other polarity, ordinal depth that is larger when nearer.
- `above`, `below`: for masks: 1 where the stored value is above (below) this number, else 0; scale, offset and invert
  do not apply.
- `nothing_above`, `nothing_below`: for depth: where the stored value is above (below) this number nothing was hit, and
  depth is +inf, as it is in any case where it is not positive or under the sky mask (`jaxtrapolate.files.repair`).
- `srgb`: decode 8-bit codes to linear; by default for `color` alone.

A pattern is a path relative to the folder with one `{frame}` in the file's name, with leading zeros as in
`{frame:04d}`; its folders are separated by forward slashes (in single quotes a backslash does as well). Frames may have
negative numbers where the sign cannot be taken for a hyphen, that is unless a letter or digit stands before `{frame}`.
A file that is left out, since another one is of the same frame (`1` and `0001`) or its number has too few digits, is
named in a note. With a step (0, 2, 4, ...), motion leads to the frame one step before; vectors that lead to the frame
with the number before need `scale = 2` there.

Codes of PNG files become 0..1, save for a stencil's, which are ids: of a picture in colour without `channels` the
three codes together, each colour an id. Ids in EXR files may be hashes, as integers or as floats (Cryptomatte's first
channel): they are numbered so that all stay apart (`jaxtrapolate.files.ids`); an antialiased mask is rounded. Most
renderers give walls an id too: without `static_ids` they count as moving objects. `jaxtrapolate check` finds them.

Flows are in the library's own convention, their third channel in the unit of position. Depth +inf is the sky. Ordinal
depth may have 0 for its nearest value, and less: it is moved to positive numbers in the same order, v + 1/256, and
below 0 to 1 / (256 - 65536 v).

For the other readers the same file may hold `[motion]`, `name`, `step` and `static_ids`; what `[motion]` leaves out
keeps the reader's own default there.
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
from jaxtrapolate.files.exr import layer_channels, read_exr
from jaxtrapolate.files.ids import StaticId, color_ids, hexadecimal
from jaxtrapolate.files.image import decode_srgb, read_png
from jaxtrapolate.files.listing import Files, collect, folder_name, list_folder, some
from jaxtrapolate.files.reader import BUFFERS, GREY, FileSequence, Opened, is_exr, pick_channels
from jaxtrapolate.files.sequence import InputError, MotionConvention
from jaxtrapolate.motion import Sign, Units, YAxis

SETTINGS_NAME = "jaxtrapolate.toml"
"""The name of the TOML file in a folder of frames."""

_BACKSLASH = "forward slashes, or single quotes around it, since in double quotes a backslash starts an escape"
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
    below: float | None = None
    nothing_above: float | None = None
    nothing_below: float | None = None
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
    step: int | None = None
    static_ids: tuple[StaticId, ...] = ()

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
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))  # Editors put a byte order mark before it.
    except OSError as error:
        raise os_input_error(path, error) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not valid TOML, it is no UTF-8 text; save it as UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        text = " ".join(str(error).split())
        remedy = f"write paths with {_BACKSLASH}" if "scape" in text or "hex" in text else "correct it"
        raise InputError(f"{path}: not valid TOML, {text}; {remedy}") from error
    kinds = {
        "name": _text,
        "hdr": _flag,
        "depth": _choice("metric", "ordinal"),
        "step": _step,
        "static_ids": _static,
        "motion": _table,
        "buffers": _table,
    }
    content = _checked(path, "", content, kinds)
    motion = _checked(
        path,
        "motion.",
        content.pop("motion", {}),
        {"sign": _choice(*get_args(Sign)), "units": _choice(*get_args(Units)), "y_axis": _choice(*get_args(YAxis))},
    )
    buffers = _checked(path, "buffers.", content.pop("buffers", {}), dict.fromkeys(BUFFERS, _text_or_table))
    if not buffers and (unused := [key for key in ("hdr", "depth") if key in content]):
        raise InputError(f"{path}: {unused[0]} is for files that [buffers] describes; remove it, or add that table")
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


def _path_text(value: Any) -> str:
    value = _text(value)
    if any(ord(character) < 32 for character in value):
        raise ValueError(_BACKSLASH)
    return value.replace("\\", "/")


def _static(value: Any) -> tuple[StaticId, ...]:
    numbers = [v for v in value if isinstance(v, int) and not isinstance(v, bool)] if isinstance(value, list) else []
    texts = [v for v in value if isinstance(v, str)] if isinstance(value, list) else []
    if not isinstance(value, list) or len(numbers) + len(texts) != len(value):
        raise ValueError('a list of ids, as numbers or as the hexadecimal digits of hashes, such as [7, "9e3779b1"]')
    for text in texts:
        try:
            hexadecimal(text)
        except ValueError:
            raise ValueError(f"eight hexadecimal digits in each text, not {text!r}") from None
    return tuple(value)


def _step(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ValueError("a whole number, 1 or more")
    return value


def _pattern(value: Any) -> str:
    value = _path_text(value) if isinstance(value, str) else value
    if not isinstance(value, str) or len(_FIELD.findall(value)) != 1 or not _FIELD.search(os.path.basename(value)):
        raise ValueError("a path with one {frame} or {frame:04d} in the file's name")
    return value


def _buffer(path: Path, name: str, value: str | dict[str, Any]) -> Buffer:
    kinds = {
        "file": _pattern,
        "layer": _path_text,
        "channels": _channels,
        "scale": _number,
        "offset": _number,
        "invert": _flag,
        "above": _number,
        "below": _number,
        "nothing_above": _number,
        "nothing_below": _number,
        "srgb": _flag,
    }
    table = _checked(path, f"buffers.{name}.", {"file": value} if isinstance(value, str) else value, kinds)
    if "file" not in table:
        raise InputError(f'{path}: buffers.{name}: no file; add one such as file = "{name}.{{frame:04d}}.exr"')
    if len(table.get("channels", ())) not in (0, BUFFERS[name]):
        raise InputError(f"{path}: buffers.{name}.channels: expected {BUFFERS[name]}, got {len(table['channels'])}")
    for key in ("above", "below"):
        if name == "depth" and key in table:
            text = f"makes a mask; where depth {key} a number is nothing, write nothing_{key}"
            raise InputError(f"{path}: buffers.depth.{key}: {text} = {table[key]}")
        if name != "depth" and f"nothing_{key}" in table:
            text = f"is for depth; for a mask of what is {key} a number, write {key}"
            raise InputError(f"{path}: buffers.{name}.nothing_{key}: {text} = {table[f'nothing_{key}']}")
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
        self._path = settings.path
        color = settings.buffers.get("color")
        files, left_out = _find(Path(folder), settings)
        super().__init__(
            folder,
            files,
            name=settings.name or folder_name(folder),
            hdr=settings.hdr if settings.hdr is not None else color is None or is_exr(color.file),
            depth=settings.depth,
            convention=motion or settings.convention(MotionConvention()),
            step=settings.step,
            static_ids=settings.static_ids,
            left_out=left_out,
            strict=strict,
        )

    def _read(self, path: Path, buffer: str, opened: Opened) -> np.ndarray:
        spec, name = self._buffers[buffer], str(path)
        if name not in opened:
            opened[name] = read_exr(path) if is_exr(name) else read_png(path)
        if is_exr(name):
            image = pick_channels(opened[name], path=path, buffer=buffer, **self._layer(buffer))
            grey = (
                spec.channels is None
                and BUFFERS[buffer] > 1
                and len(layer_channels(tuple(opened[name]), spec.layer)) == 1
            )
        else:
            image = _values(path, opened[name], buffer, spec, self._path)
            grey = spec.channels is None and BUFFERS[buffer] > 1 and opened[name].shape[-1] < 3
        if grey and buffer in GREY:
            self._note(f"{buffer} has one channel and is taken for grey")
        if spec.above is not None or spec.below is not None:
            return (_beyond(image, spec.above, spec.below)).astype(np.float32)
        nothing = _beyond(image, spec.nothing_above, spec.nothing_below)
        if (spec.scale, spec.offset) != (1.0, 0.0):
            with np.errstate(over="ignore"):
                image = image * np.float32(spec.scale) + np.float32(spec.offset)
        image = np.float32(1) - image if spec.invert else image
        if buffer == "depth":
            image = _positive(image) if self.depth == "ordinal" else image
            image = np.where(nothing, np.float32(np.inf), image) if nothing.any() else image
        return image

    def _layer(self, buffer: str) -> dict[str, Any]:
        spec = self._buffers[buffer]
        return {"layer": spec.layer, "channels": spec.channels}

    def _hashed_ids(self) -> bool:
        spec = self._buffers["stencil"]
        return is_exr(spec.file) and "crypto" in f"{spec.layer}.{'.'.join(spec.channels or ())}".lower()

    def _sky_follows(self) -> bool:
        spec = self._buffers.get("depth")
        limits = spec is not None and (spec.nothing_above, spec.nothing_below) != (None, None)
        return self.depth == "metric" or (spec is not None and (limits or is_exr(spec.file)))


def _beyond(image: np.ndarray, above: float | int | None, below: float | int | None) -> np.ndarray:
    """Where the stored values are above or below the limits that are there."""
    out = np.zeros(image.shape, bool)
    if above is not None:
        out |= image > above
    if below is not None:
        out |= image < below
    return out


def _positive(ordinal: np.ndarray) -> np.ndarray:
    """Positive numbers in the same order, the same for all frames: v + 1/256, below 0 1 / (256 - 65536 v)."""
    below = (ordinal < 0) & (ordinal > -np.inf)
    return np.where(below, 1 / (256 - 65536 * np.where(below, ordinal, 0)), ordinal + 1 / 256).astype(np.float32)


def _values(path: Path, codes: np.ndarray, buffer: str, spec: Buffer, settings: Path) -> np.ndarray:
    """The float32 values of a PNG's codes, `[H, W, count]`; the ids of a stencil."""
    count = BUFFERS[buffer]
    available = "Y" if codes.shape[-1] <= 2 else "RGBA"[: codes.shape[-1]]
    if buffer == "stencil" and spec.channels is None and len(available) >= 3:
        if codes.dtype != np.uint8:
            raise InputError(
                f"{path}: ids as colours of {codes.dtype} do not fit into 24 bits; store them as 8-bit RGB"
            )
        return color_ids(codes)
    names = spec.channels or tuple(available[:count])
    if buffer in GREY and available == "Y" and spec.channels is None:
        names = ("Y", "Y", "Y")
    places = [available.find(name) if len(name) == 1 else -1 for name in names]
    if len(places) < count or min(places) < 0:
        wanted = f"needs {count} channels" + (f" ({', '.join(names)})" if spec.channels else "")
        remedy = f"name {count} of them, such as channels = {available[0] * count!r}".replace("'", '"')
        raise InputError(f"{path}: {buffer} {wanted}, has {', '.join(available)}; in {settings}, {remedy}")
    codes = codes[..., places]
    if buffer == "stencil":
        return codes
    if spec.srgb and codes.dtype == np.uint8:
        return decode_srgb(codes)
    return codes.astype(np.float32) / np.float32(np.iinfo(codes.dtype).max)


def _find(folder: Path, settings: Settings) -> tuple[Files, list[str]]:
    """For each frame the file of each buffer, from the patterns; and a line for what is left out."""
    found: list[tuple[int, str, str, bool]] = []
    short: dict[str, None] = {}
    listed: dict[str, list[str]] = {}
    for buffer, spec in settings.buffers.items():
        parent, base = os.path.split(spec.file)
        if parent not in listed:
            listed[parent] = list_folder(folder / parent)
        before, digits, after = _FIELD.split(base)
        width = int(digits) if digits else 1
        sign = "" if before[-1:].isalnum() else rf"|-\d{{{max(width - 1, 1)},}}"
        number = re.compile(rf"\d{{{width},}}{sign}")
        pattern = re.compile(rf"{re.escape(before)}(-?\d+){re.escape(after)}")
        matches = [
            (match[1], os.path.join(parent, name)) for name in listed[parent] if (match := pattern.fullmatch(name))
        ]
        fit = [(text, path) for text, path in matches if number.fullmatch(text)]
        if not fit:
            raise InputError(f"{folder}: no file for {buffer}, {spec.file}; correct the pattern in {settings.path}")
        found += [(int(text), buffer, path, text == f"{int(text):0{width}d}") for text, path in fit]
        short |= {path: None for text, path in matches if not number.fullmatch(text)}
    files, left_out = collect(found)
    taken = {name for _, _, name, _ in found}
    if others := [name for name in short if name not in taken]:
        left_out.append(f"{some(others)} left out: not numbered as the pattern in {settings.path.name} says")
    return files, left_out
