"""Damaged and hostile files for every reader: what they may end in, and what they may cost.

    python tests/fuzz_readers.py [--inputs 7000] [--seed 0]

makes good files of every kind that is read, changes them at random, hands each to its reader, and prints how many ended
in something else than a result or one line that names the file, started a program, printed anything, or took longer
than ten seconds, and the largest memory. The inputs are those of the seed, whatever ran before. Readers run in
processes of their own, with a limit on their address space; a process that dies or hangs is counted and another one
goes on.
"""

import argparse
import collections
import contextlib
import dataclasses
import hashlib
import io
import json
import os
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

SECONDS = 10
ADDRESS_SPACE = 24 << 30
PROGRAMS = ("gs", "gswin32c", "gswin64c", "convert", "magick", "ffmpeg", "dcraw", "netpbm", "djpeg", "xdg-open", "sh")
KINDS = ("exr", "png", "tiff", "image", "toml", "json", "npz", "torch", "orbax", "jitter")
SHARES = {
    "exr": 8,
    "png": 5,
    "tiff": 5,
    "image": 5,
    "toml": 4,
    "json": 2,
    "npz": 3,
    "torch": 5,
    "orbax": 1,
    "jitter": 2,
}


# -- good files


def good_files(folder: Path, kinds=KINDS) -> dict[str, list[Path]]:
    """Files of every kind that its reader takes, small ones."""
    makers = {
        "exr": _exr,
        "png": _png,
        "tiff": _tiff,
        "image": _other,
        "toml": _toml,
        "json": _json,
        "npz": _npz,
        "torch": _torch,
        "orbax": _orbax,
        "jitter": _jitter,
    }
    found = {}
    for kind in kinds:
        (folder / kind).mkdir(parents=True)
        makers[kind](folder / kind)
        found[kind] = sorted((folder / kind).iterdir())
    return found


def _exr(folder):
    import OpenEXR

    z = np.random.default_rng(0).random((19, 23)).astype(np.float32)
    base = {"type": OpenEXR.scanlineimage}
    for name in ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "DWAA"):
        header = base | {"compression": getattr(OpenEXR, f"{name}_COMPRESSION")}
        half = name == "B44"
        channels = {c: z.astype(np.float16) if half else z for c in "RGBA"}
        OpenEXR.File(header, channels).write(str(folder / f"{name}.exr"))
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    OpenEXR.File({**tiles, "compression": OpenEXR.ZIP_COMPRESSION}, {"Y": z}).write(str(folder / "tiles.exr"))
    parts = [OpenEXR.Part({**base, "name": name}, {"Z": z}, name) for name in ("depth", "more")]
    OpenEXR.File(parts).write(str(folder / "parts.exr"))
    layers = {f"View.{layer}.{c}": z for layer in ("A", "B") for c in "XYZ"} | {
        "id": np.arange(437, dtype=np.uint32).reshape(19, 23)
    }
    OpenEXR.File(dict(base), layers).write(str(folder / "layers.exr"))


def _png(folder):
    import cv2
    from PIL import Image

    rng = np.random.default_rng(0)
    for channels in (1, 3, 4):
        for dtype in (np.uint8, np.uint16):
            stored = rng.integers(0, np.iinfo(dtype).max, (17, 21, channels), dtype)
            cv2.imwrite(str(folder / f"{channels}-{np.dtype(dtype).name}.png"), stored)
    Image.fromarray(rng.integers(0, 255, (17, 21), np.uint8)).convert("P").save(folder / "palette.png", transparency=3)
    Image.fromarray(rng.integers(0, 255, (17, 21), np.uint8)).convert("1").save(folder / "bits.png")


def _tiff(folder):
    import tifffile
    from PIL import Image

    rng = np.random.default_rng(0)
    for dtype in (np.uint8, np.uint16, np.int32, np.float32):
        for compression in (None, "zlib"):
            stored = (rng.random((17, 21, 3)) * 200).astype(dtype)
            name = f"{np.dtype(dtype).name}-{compression}.tif"
            tifffile.imwrite(folder / name, stored, photometric="rgb", compression=compression, metadata=None)
    tifffile.imwrite(folder / "tiles.tif", np.ones((40, 40), np.float32), tile=(16, 16), photometric="minisblack")
    tifffile.imwrite(folder / "big.tif", np.ones((9, 9), np.uint16), bigtiff=True, photometric="minisblack")
    grey = Image.fromarray(rng.integers(0, 255, (17, 21), np.uint8))
    for name, mode, compression in (
        ("lzw", "RGB", "tiff_lzw"),
        ("palette", "P", None),
        ("jpeg", "RGB", "jpeg"),
        ("fax", "1", "group4"),
    ):
        grey.convert(mode).save(folder / f"{name}.tif", compression=compression)


def _other(folder):
    import cv2
    from PIL import Image

    rng = np.random.default_rng(0)
    values = rng.random((17, 21, 3)).astype(np.float32)
    cv2.imwrite(str(folder / "runs.hdr"), values)
    cv2.imwrite(str(folder / "plain.hdr"), values[:, :5])
    cv2.writeOpticalFlow(str(folder / "a.flo"), values[..., :2])
    np.save(folder / "a.npy", values)
    np.save(folder / "b.npy", np.asfortranarray((values * 255).astype(np.uint8)))
    codes = Image.fromarray((values * 255).astype(np.uint8))
    for name in ("a.jpg", "a.bmp", "a.tga"):
        codes.save(folder / name)
    codes.save(folder / "progressive.jpg", progressive=True)


TOML = """name = "courtyard"
hdr = true
depth = "metric"
[motion]
sign = "current_minus_previous"
units = "pixels"
y_axis = "up"
[buffers]
color = "{frame:04d}.png"
depth = { file = "{frame:04d}.png", channels = ["R"], scale = 0.01, offset = 1e3, invert = true }
sky = { file = "{frame:04d}.png", layer = "View.Depth", channels = "R", above = 1e9, srgb = false }
motion = { file = "{frame:04d}.png", codes = true, valid = "B", channels = "RG" }
"""
JITTERED = range(1, 8)
RUN = {"task": "extranet", "steps": 100, "optimizer": {"peak_learning_rate": 0.001}, "options": {"crop": [64, 64]}}


def _toml(folder):
    (folder / "pattern.toml").write_text(TOML)
    lines = (
        'task = "extranet"',
        "steps = 100",
        "[optimizer]",
        "peak_learning_rate = 1e-3",
        "[options]",
        "crop = [64, 64]",
        "",
    )
    (folder / "run.toml").write_text("\n".join(lines))


def _json(folder):
    (folder / "config.json").write_text(json.dumps(RUN))


def _jitter(folder):
    lines = ["frame x y"] + [f"{k}, {k / 8 - 0.5}; {0.5 - k / 8}  # Halton" for k in JITTERED]
    (folder / "jitter.txt").write_text("\n".join(lines))


def _npz(folder):
    from jaxtrapolate.weights import save_weights

    tree = {"a": {"kernel": np.ones((3, 4), np.float32)}, "b": np.arange(5, dtype=np.float16)}
    save_weights(folder, "extranet", tree, config={"k": [1, 2]}, note="a note")


def _torch(folder):
    from torch_files import tensor, write

    values = np.arange(60, dtype=np.float32)
    state = {f"layer{i}.weight": tensor("FloatStorage", str(i), 60, 0, (3, 4, 5), (20, 5, 1)) for i in range(3)}
    write(folder / "a.pth.tar", {"epoch": 1, "state_dict": state}, {str(i): values.tobytes() for i in range(3)})


def _orbax(folder):
    import orbax.checkpoint as ocp

    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save((folder / "plain").resolve(), {"a": np.ones((3, 4), np.float32), "b": {"c": np.arange(5)}})


# -- changes

NUMBERS = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 30000, 2**24, 2**30, 2**31 - 1, 2**31, 2**32 - 1)


def changed(data: bytes, rng: np.random.Generator, other: bytes) -> bytes:
    """A good file's bytes after one, two or four changes of the usual kinds."""
    out = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 1, 2, 4]))):
        if not out:
            break
        # Headers decide more than pixels.
        near = min(len(out), 400) if rng.random() < 0.5 else len(out)
        at, end = sorted(int(k) for k in rng.integers(0, near, 2))
        match int(rng.integers(0, 8)):
            case 0:
                out[at] ^= 1 << int(rng.integers(0, 8))
            case 1:
                out[at] = int(rng.integers(0, 256))
            case 2:
                number = NUMBERS[int(rng.integers(0, len(NUMBERS)))]
                out[at : at + 4] = struct.pack("<I" if rng.random() < 0.5 else ">I", number)
            case 3:
                number = NUMBERS[int(rng.integers(0, len(NUMBERS)))] & 0xFFFF
                out[at : at + 2] = struct.pack("<H" if rng.random() < 0.5 else ">H", number)
            case 4:
                del out[int(rng.integers(0, len(out))) :]
            case 5:
                del out[at:end]
            case 6:
                out[at:at] = out[at:end]
            case 7:
                start = int(rng.integers(0, max(len(other), 1)))
                out[at:end] = other[start : start + end - at]
    return bytes(out)


def _number(rng: np.random.Generator) -> str:
    return str(rng.choice(["9" * 5000, "1e999", "-1e999", "nan", "inf", "0x" + "f" * 9000, "9" * 400, "-0", "1_0"]))


def changed_text(text: str, rng: np.random.Generator, kind: str) -> bytes:
    """TOML or JSON after a change that its grammar allows, or nearly: numbers of any size, nesting of any depth."""
    deep = int(rng.choice([3, 50, 70, 500, 5000, 100_000]))
    tokens = text.replace("=", " = ").replace(",", " , ").split(" ")
    place = int(rng.integers(0, len(tokens)))
    nested = "[" * deep + ("]" * deep if rng.random() < 0.8 else "")
    tables = ('{"a":' if kind == "json" else "{a=") * min(deep, 20_000) + "1" + "}" * min(deep, 20_000)
    match int(rng.integers(0, 9)):
        case 0:
            tokens[place] = _number(rng)
        case 1:
            tokens[place] = nested
        case 2:
            tokens[place] = tables
        case 3:
            tokens[place] = (
                '"{frame:0' + str(rng.choice(["99999999999d}", "9" * 5000 + "d}", "4d}{frame}", "-1d}"])) + '.png"'
            )
        case 4:
            tokens[place] = '"' + "\\ud800" * int(rng.integers(1, 5)) + '"'
        case 5:
            tokens.insert(place, ".".join(["a"] * deep) + " = 1\n")
        case 6:
            tokens[place] = str(rng.choice(["true", "[]", "{}", '""', "1979-05-27T07:32:00Z", "\x00", "\ufeff", "'''"]))
        case 7:
            other = int(rng.integers(0, len(tokens)))
            tokens[place], tokens[other] = tokens[other], tokens[place]
        case 8:
            tokens[place] = '"' + "x" * 200_000 + '"'
    return " ".join(tokens).encode("utf-8", "surrogatepass")


def make_input(kind: str, index: int, seed: int, good: dict[str, list[Path]], folder: Path) -> Path:
    """The input of a number, in a folder of its own."""
    rng = np.random.default_rng([seed, index, KINDS.index(kind)])
    folder.mkdir()
    files = good[kind]
    chosen = files[int(rng.integers(0, len(files)))]
    special = SPECIAL.get(kind, ())
    if index < len(special):
        return special[index](folder, chosen)
    if kind == "orbax":
        shutil.copytree(chosen, folder / "checkpoint")
        inside = sorted(p for p in (folder / "checkpoint").rglob("*") if p.is_file())
        target = inside[int(rng.integers(0, len(inside)))]
        target.write_bytes(changed(target.read_bytes(), rng, inside[0].read_bytes()))
        return folder / "checkpoint"
    other = files[int(rng.integers(0, len(files)))].read_bytes()
    data = chosen.read_bytes()
    if kind in ("toml", "json") and rng.random() < 0.7:
        data = changed_text(data.decode(), rng, kind)
    elif kind == "torch" and rng.random() < 0.6:
        data = _changed_pickle(data, rng)
    else:
        data = changed(data, rng, other)
    if kind == "png" and rng.random() < 0.7:
        data = _with_sums(data)
    name = chosen.name
    if kind == "npz" and rng.random() < 0.9:  # else the hash alone refuses it
        name = f"extranet-{hashlib.sha256(data).hexdigest()[:8]}.npz"
    path = folder / name
    path.write_bytes(data)
    return path


def _changed_pickle(data: bytes, rng: np.random.Generator) -> bytes:
    """A checkpoint whose zip is whole and whose pickle is not."""
    import zipfile

    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            new.writestr(name, changed(content, rng, content) if name.endswith("data.pkl") else content)
    return out.getvalue()


def _with_sums(data: bytes) -> bytes:
    """A PNG whose checksums are right again, so that what is in its chunks is looked at."""
    out, at = bytearray(data[:8]), 8
    while at + 8 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        content = data[at + 4 : at + 8 + length]
        out += data[at : at + 4] + content + struct.pack(">I", zlib.crc32(content))
        at += 12 + length
    return bytes(out)


# -- inputs that are no changed files


def _file(name, content):
    def make(folder, _):
        (folder / name).write_bytes(content)
        return folder / name

    return make


def _link(name, target):
    def make(folder, _):
        (folder / name).symlink_to(target.format(name=name))
        return folder / name

    return make


def _fifo(name):
    def make(folder, _):
        os.mkfifo(folder / name)
        return folder / name

    return make


def _named(name):
    """A good file by a name that is no UTF-8."""

    def make(folder, chosen):
        path = Path(os.fsdecode(os.fsencode(folder) + b"/" + name + os.fsencode(chosen.suffix)))
        shutil.copy(chosen, path)
        return path

    return make


def _window(width, height):
    """The EXR without compression, claiming another display window."""

    def make(folder, chosen):
        content = bytearray(chosen.with_name("NO.exr").read_bytes())
        at = content.index(b"displayWindow\0box2i\0") + 24
        content[at : at + 16] = struct.pack("<4i", 0, 0, width - 1, height - 1)
        (folder / "a.exr").write_bytes(content)
        return folder / "a.exr"

    return make


def _inside(name):
    """An Orbax checkpoint, one file of which is a pipe or a device."""

    def make(folder, chosen):
        shutil.copytree(chosen, folder / "checkpoint")
        target = folder / "checkpoint" / name
        target.unlink(missing_ok=True)
        if name == "_METADATA":
            target.symlink_to("/dev/zero")
        else:
            os.mkfifo(target)
        return folder / "checkpoint"

    return make


def _pth(value):
    def make(folder, _):
        from torch_files import write

        return write(folder / "a.pth.tar", value)

    return make


def _hostile(*names):
    return [
        make
        for name in names
        for make in (_fifo(name), _link(name, "/dev/zero"), _link(name, "{name}"), _file(name, b""))
    ]


_POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n"
SPECIAL: dict[str, list[Callable[[Path, Path], Path]]] = {
    "exr": [
        *_hostile("a.exr"),
        _named(b"caf\xe9"),
        _named(b"two\nlines"),
        _file("a.exr", _POSTSCRIPT),
        _window(30000, 30000),
        _window(1500, 1000),
    ],
    "png": [
        *_hostile("a.png"),
        _named(b"caf\xe9"),
        _file("a.png", _POSTSCRIPT),
        _file("a.png", b"\xc5\xd0\xd3\xc6" + bytes(60)),
    ],
    "tiff": [*_hostile("a.tif"), _named(b"caf\xe9"), _file("a.tif", _POSTSCRIPT)],
    "image": [
        _file(name, _POSTSCRIPT) for name in ("a.tga", "a.bmp", "a.jpg", "a.eps", "a.ps", "a.hdr", "a.npy", "a.flo")
    ],
    "toml": [
        *_hostile("jaxtrapolate.toml"),
        _file("a.toml", b"\xef\xbb\xbf" + TOML.encode()),
        _file("a.toml", b"[buffers]\ncolor = '{frame:099999999999d}.png'\n"),
        _file("a.toml", b"a = " + b"[" * 100_000),
        _file("a.toml", b"hdr = " + b"9" * 5000),
        _file("a.toml", b"x" * (17 << 20)),
    ],
    "json": [*_hostile("a.json"), _file("a.json", b"[" * 100_000), _file("a.json", b"9" * 5000)],
    "jitter": [
        *_hostile("jitter.txt"),
        *(_file("jitter.txt", line) for line in (b"1 1e999 nan", b"9" * 5000 + b" 0 0", b"-1 0 0", b"1 0 0\n1 0 0")),
    ],
    "npz": _hostile("extranet-12345678.npz"),
    "torch": [
        *_hostile("a.pth.tar"),
        *map(_pth, ({"state_dict": []}, {"state_dict": {1: 2}}, {"state_dict": {"a": 3}})),
    ],
    "orbax": [_inside("_METADATA"), _inside("manifest.ocdbt"), _link("checkpoint", "{name}")],
}


# -- readers


def read(kind: str, path: Path) -> None:
    """Hands a file to what reads its kind."""
    from jaxtrapolate import weights
    from jaxtrapolate.files import exr, image, open_sequence
    from jaxtrapolate.files.description import read_settings
    from jaxtrapolate.files.jitter import JitterFile, read_jitter
    from jaxtrapolate.files.text import read_json
    from jaxtrapolate.methods.extranet import load_extranet
    from jaxtrapolate.training.config import load_config

    steps: dict[str, tuple[Callable[..., object], ...]] = {
        "exr": (exr.exr_size, exr.exr_channels, exr.read_exr, sequence),
        "toml": (read_settings, load_config, open_sequence),
        "json": (read_json,),
        "jitter": (lambda path: read_jitter(path, JitterFile(path.name), JITTERED, (9, 16)),),
        "npz": (weights.load_weights,),
        "torch": (load_extranet if path.stat().st_size < 500 else weights.read_torch,)
        if path.is_file()
        else (load_extranet,),
        "orbax": (weights.load_orbax,),
    }
    refused: Exception | None = None
    for step in steps.get(kind, (image.image_size, image.read_image, image.read_png, sequence)):
        try:
            step(path)
        except refusals(kind) as error:
            refused = error
            check_line(error, path)
    if refused is not None:
        raise refused


def sequence(path: Path) -> None:
    """The file as the colour and the depth of a sequence's only frame, by a link to it with a number in its name."""
    from jaxtrapolate.files import open_sequence

    folder = path.parent / "sequence"
    if not folder.exists():
        folder.mkdir()
        name = f"1{path.suffix}"
        (folder / name).symlink_to(path)
        pattern = f"{{frame}}{path.suffix}"
        toml = f'[buffers]\ncolor = "{pattern}"\ndepth = {{ file = "{pattern}", scale = 2, invert = true }}\n'
        (folder / "jaxtrapolate.toml").write_text(toml)
    opened = open_sequence(folder)
    opened.frame(1)
    opened.invalid(1)


def refusals(kind: str) -> tuple[type[Exception], ...]:
    """What may leave a reader of a kind, by its documentation."""
    from jaxtrapolate.errors import InputError

    return (ValueError, OSError) if kind in ("npz", "torch", "orbax") else (InputError,)


def check_line(error: Exception, path: Path) -> None:
    """Raise `AssertionError` unless an error is one that is documented: one line, printable, that names the file."""
    from jaxtrapolate.errors import printable

    text = str(error)
    assert isinstance(error, OSError) or printable(path.parent) in text, f"does not name the file: {text[:200]}"
    assert isinstance(error, OSError) or ("\n" not in text and len(text) < 3000), f"is no line: {text[:200]}"
    assert isinstance(error, OSError) or text.isprintable(), f"cannot be printed: {text[:200]!r}"


@dataclasses.dataclass
class Count:
    """What came of a number of inputs."""

    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    tracebacks: list[str] = dataclasses.field(default_factory=list)
    printed: list[str] = dataclasses.field(default_factory=list)
    hangs: list[str] = dataclasses.field(default_factory=list)
    deaths: list[str] = dataclasses.field(default_factory=list)
    programs: int = 0
    largest_mib: float = 0.0
    largest: str = ""
    slowest: float = 0.0


class TooLong(BaseException):
    """A reader took longer than `SECONDS`."""


def _alarm(*_):
    raise TooLong


def run(
    kinds: dict[str, range],
    seed: int,
    folder: Path,
    *,
    printed: Callable[[], str],
    report: Callable[[Count], None] = lambda _: None,
    good: dict[str, list[Path]] | None = None,
) -> Count:
    """Runs inputs by kind and number in this process; `printed` gives what went to the terminal since the last call."""
    import jaxtrapolate.methods.extranet
    import jaxtrapolate.training.config  # noqa: F401  no input pays for imports

    good = good_files(folder / "good", tuple(kinds)) if good is None else good
    count = Count()
    signal.signal(signal.SIGALRM, _alarm)
    printed()
    for kind, numbers in kinds.items():
        for index in numbers:
            name = f"{kind} {index}"
            path = make_input(kind, index, seed, good, folder / "input")
            _reset_peak()
            before, start = _memory("VmRSS"), time.monotonic()
            count.inputs += 1
            signal.setitimer(signal.ITIMER_REAL, SECONDS)
            try:
                read(kind, path)
                count.accepted += 1
            except TooLong:
                count.hangs.append(name)
            except refusals(kind):
                count.refused += 1
            except Exception as error:
                count.tracebacks.append(f"{name}: {type(error).__name__}: {error}"[:300])
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0)
            count.slowest = max(count.slowest, time.monotonic() - start)
            took = _memory("VmHWM") - before
            if took > count.largest_mib:
                count.largest_mib, count.largest = took, name
            if text := printed():
                count.printed.append(f"{name}: {text}"[:300])
            shutil.rmtree(folder / "input")
            report(count)
    return count


def _reset_peak() -> None:
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _memory(field: str) -> float:
    """MiB, of `/proc/self/status`; 0 on systems without it."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(field):
                return int(line.split()[1]) / 1024
    return 0.0


# -- processes


def trap(folder: Path) -> dict[str, str]:
    """An environment whose first programs in PATH only tell that they were started (`started`)."""
    (folder / "bin").mkdir()
    for name in PROGRAMS:
        program = folder / "bin" / name
        program.write_text(f"#!/bin/bash\necho {name} >> '{folder}/started'\nexit 1\n")
        program.chmod(0o755)
    return {"PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}"}


def started(folder: Path) -> int:
    """How many programs of `trap` were started."""
    path = folder / "started"
    return len(path.read_text().splitlines()) if path.exists() else 0


def numbers(inputs: int, kinds=KINDS) -> dict[str, range]:
    """How many inputs of each kind, of a total."""
    whole = sum(SHARES[kind] for kind in kinds)
    return {kind: range(max(1, inputs * SHARES[kind] // whole)) for kind in kinds}


def fuzz(inputs: int, seed: int, kinds=KINDS, *, say: Callable[[str], None] = lambda _: None) -> Count:
    """All inputs, each kind in processes of its own; see the module's docstring."""
    total = Count()
    with tempfile.TemporaryDirectory() as name:
        base = Path(name)
        environment = os.environ | trap(base) | {"JAX_PLATFORMS": "cpu"}
        for kind, those in numbers(inputs, kinds).items():
            at = 0
            while at < len(those):
                folder = base / f"{kind}-{at}"
                folder.mkdir()
                count, done = _process(kind, at, len(those), seed, folder, environment, total)
                total = _sum(total, count)
                at += done
                shutil.rmtree(folder, ignore_errors=True)
            say(f"{kind}: {len(those)} inputs, {len(total.tracebacks)} tracebacks so far, {total.largest_mib:.0f} MiB")
        total.programs = started(base)
    return total


def _process(kind, first, last, seed, folder, environment, total) -> tuple[Count, int]:
    """The count of one process, and how many inputs it has dealt with, the one it died of among them."""
    state = folder / "count.json"
    command = [sys.executable, __file__, "--worker", kind, str(first), str(last), "--seed", str(seed), str(folder)]
    with open(folder / "terminal", "wb") as terminal:
        process = subprocess.Popen(command, env=environment, stdout=terminal, stderr=terminal, stdin=subprocess.DEVNULL)
        seen, since = None, time.monotonic()
        limit = 120.0  # for the imports
        while process.poll() is None:
            time.sleep(0.05)
            now = state.stat().st_mtime_ns if state.exists() else None
            if now != seen:
                seen, since, limit = now, time.monotonic(), 3.0 * SECONDS
            if time.monotonic() - since > limit:
                process.kill()
                process.wait()
                break
    with contextlib.suppress(OSError, ValueError):
        count = Count(**json.loads(state.read_text()))
        if process.returncode:
            kinds = count.hangs if process.returncode == -signal.SIGKILL else count.deaths
            kinds.append(f"{kind} {first + count.inputs}: ended by {process.returncode}")
            return count, count.inputs + 1
        return count, count.inputs
    raise RuntimeError(f"{kind}: {(folder / 'terminal').read_text()[-2000:]}")


def _sum(a: Count, b: Count) -> Count:
    larger = a if a.largest_mib >= b.largest_mib else b
    return Count(
        *(
            getattr(a, f.name) + getattr(b, f.name)
            for f in dataclasses.fields(Count)
            if not f.name.startswith(("larg", "slow"))
        ),
        larger.largest_mib,
        larger.largest,
        max(a.slowest, b.slowest),
    )


def _worker(kind: str, first: int, last: int, seed: int, folder: Path) -> None:
    import logging

    import jax  # noqa: F401  its threads take address space

    import jaxtrapolate.files
    import jaxtrapolate.training.config
    import jaxtrapolate.weights  # noqa: F401

    if kind == "orbax":
        logging.disable(logging.CRITICAL)  # Orbax's own log is not the library's
    state = folder / "count.json"
    good = good_files(folder / "good", (kind,))
    state.write_text(json.dumps(dataclasses.asdict(Count())))
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    terminal = folder / "terminal"
    place = 0

    def printed() -> str:
        nonlocal place
        sys.stdout.flush()
        sys.stderr.flush()
        with open(terminal, "rb") as file:
            file.seek(place)
            text = file.read()
        place += len(text)
        return text.decode("utf-8", "replace")

    def report(count: Count) -> None:
        temporary = state.with_suffix(".new")
        temporary.write_text(json.dumps(dataclasses.asdict(count)))
        os.replace(temporary, state)

    run({kind: range(first, last)}, seed, folder, printed=printed, report=report, good=good)


def summary(count: Count) -> str:
    """The count in lines."""
    counted = collections.Counter(line.split(":")[1].strip() for line in count.tracebacks)
    lines = [
        f"inputs tried       {count.inputs} ({count.accepted} read, {count.refused} refused in one line)",
        f"tracebacks         {len(count.tracebacks)} {dict(counted) if counted else ''}".rstrip(),
        f"programs started   {count.programs}",
        f"hangs              {len(count.hangs)} (slowest input {count.slowest:.2f} s)",
        f"processes ended    {len(count.deaths)}",
        f"printed            {len(count.printed)}",
        f"largest memory     {count.largest_mib:.0f} MiB above the process ({count.largest})",
    ]
    for lists in (count.tracebacks, count.hangs, count.deaths, count.printed):
        lines += [f"  {line}" for line in lists[:20]]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=7000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--worker", nargs=3, metavar=("KIND", "FIRST", "LAST"), help=argparse.SUPPRESS)
    parser.add_argument("folder", nargs="?", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        kind, first, last = options.worker
        _worker(kind, int(first), int(last), options.seed, options.folder)
        return 0
    count = fuzz(options.inputs, options.seed, options.kinds.split(","), say=lambda line: print(line, flush=True))
    print(summary(count))
    return int(bool(faults(count)))


def faults(count: Count) -> list[str]:
    """What must not be."""
    programs = [f"{count.programs} programs started"] if count.programs else []
    return [*count.tracebacks, *count.hangs, *count.deaths, *count.printed, *programs]


if __name__ == "__main__":
    sys.exit(main())
