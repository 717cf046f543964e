"""EXR files: against files made by calling OpenEXR directly, round trips, damaged files, interrupted writes."""

import builtins
import errno
import os
import random

import numpy as np
import pytest

from jaxtrapolate.errors import InputError
from jaxtrapolate.files import read_exr, write_exr
from jaxtrapolate.files.exr import HALF_MAX, exr_channels, exr_size, layer_channels, pick
from jaxtrapolate.files.exr_header import read_header

OpenEXR = pytest.importorskip("OpenEXR")

SIZES = [(5, 7), (1, 1), (17, 3), (64, 33)]


def header(**fields):
    return {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **fields}


def window(x0, y0, x1, y1):
    return np.array([x0, y0], np.int32), np.array([x1, y1], np.int32)


def image(height, width, channels=3, dtype=np.float32, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(height, width, channels)).astype(np.float16).astype(dtype)


def one_line(error, path):
    text = str(error.value)
    assert "\n" not in text
    assert str(path) in text
    return text


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("half", [True, False])
def test_round_trip(tmp_path, size, channels, half):
    path, pixels = tmp_path / "a.exr", image(*size, channels)
    write_exr(path, pixels, half=half)
    stored = read_exr(path)
    assert {plane.dtype for plane in stored.values()} == {np.dtype(np.float16 if half else np.float32)}
    np.testing.assert_array_equal(pick(stored, path=path, count=channels), pixels)
    assert exr_size(path) == size
    assert os.listdir(tmp_path) == ["a.exr"]


@pytest.mark.parametrize("compression", ["none", "rle", "zips", "zip", "piz"])
def test_compressions(tmp_path, compression):
    path, pixels = tmp_path / "a.exr", image(70, 9)
    write_exr(path, pixels, half=False, compression=compression)
    np.testing.assert_array_equal(pick(read_exr(path), path=path, count=3), pixels)


def test_written_file_is_what_openexr_expects(tmp_path):
    path, pixels = tmp_path / "a.exr", image(6, 4)
    write_exr(path, pixels)
    with OpenEXR.File(str(path)) as file:
        np.testing.assert_array_equal(file.channels()["RGB"].pixels, pixels.astype(np.float16))


def test_half_clips_finite_values_only(tmp_path):
    path = tmp_path / "a.exr"
    write_exr(path, np.array([[1e6, -1e6, np.inf, np.nan]], np.float32))
    np.testing.assert_array_equal(read_exr(path)["Y"], [[HALF_MAX, -HALF_MAX, np.inf, np.nan]])


def test_unknown_compression(unchecked, tmp_path):
    with pytest.raises(ValueError, match="compression: expected one of 'none', 'rle'"):
        write_exr(tmp_path / "a.exr", image(2, 2), compression="best")


def test_mapping_of_layers_and_integers(tmp_path):
    path, ids = tmp_path / "a.exr", np.arange(12, dtype=np.uint32).reshape(3, 4)
    write_exr(path, {"id": ids, "a.Z": ids.astype(np.float32) / 3}, half=False)
    stored = read_exr(path)
    assert stored["id"].dtype == np.uint32
    np.testing.assert_array_equal(stored["id"], ids)
    np.testing.assert_array_equal(stored["a.Z"], ids.astype(np.float32) / 3)


@pytest.mark.parametrize("shape", [(3,), (2, 3, 5), (0, 3, 3)])
def test_shapes_that_cannot_be_written(tmp_path, shape):
    with pytest.raises(ValueError, match="expected"):
        write_exr(tmp_path / "a.exr", np.zeros(shape))


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("grouped", [True, False])
def test_reads_openexr_channels(tmp_path, dtype, grouped):
    path, pixels = tmp_path / "a.exr", image(5, 7, dtype=dtype)
    planes = {c: np.ascontiguousarray(pixels[..., k]) for k, c in enumerate("RGB")}
    OpenEXR.File(header(), {"RGB": pixels} if grouped else planes).write(str(path))
    stored = read_exr(path)
    assert exr_channels(path) == ("B", "G", "R")
    assert all(plane.dtype == dtype for plane in stored.values())
    np.testing.assert_array_equal(pick(stored, path=path, count=3), pixels)
    np.testing.assert_array_equal(pick(stored, path=path, count=1), pixels[..., :1])


def layered(path):
    pixels = image(5, 7, 4)
    planes = [np.ascontiguousarray(pixels[..., k]) for k in range(4)]
    channels = {f"ViewLayer.Combined.{c}": planes[k] for k, c in enumerate("RGBA")}
    channels |= {"ViewLayer.Depth.Z": planes[3], "ViewLayer.Vector.Y": planes[1], "ViewLayer.Vector.X": planes[0]}
    OpenEXR.File(header(), channels).write(str(path))
    return pixels


def test_multi_layer(tmp_path):
    path = tmp_path / "a.exr"
    pixels = layered(path)
    stored = read_exr(path)
    np.testing.assert_array_equal(pick(stored, path=path, count=3, layer="ViewLayer.Combined"), pixels[..., :3])
    np.testing.assert_array_equal(pick(stored, path=path, count=1, layer="Depth"), pixels[..., 3:])
    np.testing.assert_array_equal(pick(stored, path=path, count=2, layer="Vector"), pixels[..., :2])
    swapped = pick(stored, path=path, count=2, layer="Vector", channels=("Y", "X"))
    np.testing.assert_array_equal(swapped, pixels[..., 1::-1])


def test_multi_part_of_mixed_types(tmp_path):
    path, pixels = tmp_path / "a.exr", image(5, 7)
    depth, ids = pixels[..., 0] * np.float32(np.pi), np.arange(35, dtype=np.uint32).reshape(5, 7)
    parts = [
        OpenEXR.Part(header(), {"RGB": pixels.astype(np.float16)}, "beauty"),
        OpenEXR.Part(header(), {"Z": depth}, "depth"),
        OpenEXR.Part(header(), {"id.ID": ids}, "id"),
    ]
    OpenEXR.File(parts).write(str(path))
    stored = read_exr(path)
    assert sorted(stored) == ["beauty.B", "beauty.G", "beauty.R", "depth.Z", "id.ID"]
    np.testing.assert_array_equal(pick(stored, path=path, count=3, layer="beauty"), pixels)
    np.testing.assert_array_equal(stored["depth.Z"], depth)
    np.testing.assert_array_equal(pick(stored, path=path, count=1, layer="id")[..., 0], ids)


@pytest.mark.parametrize("origin", [(0, 0), (-3, 10)])
def test_data_window_is_placed_in_the_display_window(tmp_path, origin):
    path, pixels = tmp_path / "a.exr", image(3, 4)
    x, y = origin
    windows = {
        "displayWindow": window(x, y, x + 8, y + 6),
        "dataWindow": window(x + 1, y + 2, x + 4, y + 4),
    }
    OpenEXR.File(header(**windows), {"RGB": pixels}).write(str(path))
    expected = np.zeros((7, 9, 3), np.float32)
    expected[2:5, 1:5] = pixels
    assert exr_size(path) == (7, 9)
    np.testing.assert_array_equal(pick(read_exr(path), path=path, count=3), expected)


def test_overscan_is_cropped(tmp_path):
    path, pixels = tmp_path / "a.exr", image(9, 8)
    windows = {"displayWindow": window(0, 0, 4, 4), "dataWindow": window(-2, -1, 5, 7)}
    OpenEXR.File(header(**windows), {"RGB": pixels}).write(str(path))
    np.testing.assert_array_equal(pick(read_exr(path), path=path, count=3), pixels[1:6, 2:7])


def test_data_window_apart_from_the_display_window(tmp_path):
    path = tmp_path / "a.exr"
    windows = {"displayWindow": window(0, 0, 4, 4), "dataWindow": window(10, 10, 12, 11)}
    OpenEXR.File(header(**windows), {"RGB": image(2, 3)}).write(str(path))
    np.testing.assert_array_equal(pick(read_exr(path), path=path, count=3), np.zeros((5, 5, 3)))


def test_tiled_file_and_its_truncation(tmp_path):
    path, pixels = tmp_path / "a.exr", image(40, 70)
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    fields = {"type": OpenEXR.tiledimage, "tiles": tiles}
    OpenEXR.File(header(**fields), {"RGB": pixels}).write(str(path))
    np.testing.assert_array_equal(pick(read_exr(path), path=path, count=3), pixels)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match="truncated") as error:
        read_exr(path)
    one_line(error, path)


def test_layer_channels():
    names = ("B", "G", "R", "a.Z", "b.c.X", "b.c.Y", "d.Z")
    assert layer_channels(names) == ("R", "G", "B")
    assert layer_channels(names, "c") == ("b.c.X", "b.c.Y")
    assert layer_channels(names, "missing") == ()
    assert layer_channels(("x.c.Y", "y.c.Y"), "c") == ()
    assert layer_channels(("only.G", "only.R")) == ("only.R", "only.G")


def test_too_few_channels_are_named(tmp_path):
    path = tmp_path / "a.exr"
    write_exr(path, image(2, 2, 1))
    with pytest.raises(InputError, match="needs 3 channels, has Y") as error:
        pick(read_exr(path), path=path, count=3)
    one_line(error, path)
    with pytest.raises(InputError, match="channels A, B of layer 'x'"):
        pick(read_exr(path), path=path, count=2, layer="x", channels=("A", "B"))


@pytest.mark.parametrize("kind", ["rgb", "parts", "small"])
def test_truncated_files_end_in_one_line_and_print_nothing(tmp_path, kind, capfd):
    path = tmp_path / "a.exr"
    pixels = image(90, 40) if kind != "small" else image(1, 1)
    if kind == "parts":
        parts = [OpenEXR.Part(header(), {"RGB": pixels}, name) for name in ("one", "two")]
        OpenEXR.File(parts).write(str(path))
    else:
        write_exr(path, pixels)
    whole = path.read_bytes()
    lengths = {0, 3, 4, 8, 20, len(whole) // 10, len(whole) // 3, len(whole) // 2, len(whole) - 9, len(whole) - 1}
    for length in sorted(lengths | {random.Random(0).randrange(len(whole)) for _ in range(20)}):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError) as error:
            read_exr(path)
        one_line(error, path)
        with pytest.raises(InputError):
            exr_size(path)
    assert capfd.readouterr() == ("", "")


def test_damaged_in_the_middle(tmp_path):
    path = tmp_path / "a.exr"
    write_exr(path, image(90, 40))
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2 : len(damaged) // 2 + 200] = bytes(200)
    path.write_bytes(damaged)
    with pytest.raises(InputError, match="damaged") as error:
        read_exr(path)
    one_line(error, path)


def test_unfinished_file(tmp_path):
    """A writer that was killed leaves zeros in the table of the chunks."""
    path = tmp_path / "a.exr"
    write_exr(path, image(90, 40))
    data = bytearray(path.read_bytes())
    header_end = next(n for n in range(8, len(data)) if int.from_bytes(data[n : n + 8], "little") == n + 8 * 6)
    data[header_end + 40 : header_end + 48] = bytes(8)
    path.write_bytes(data)
    with pytest.raises(InputError, match="truncated"):
        read_header(path)


@pytest.mark.parametrize(
    "make, text",
    [
        (lambda path: None, "does not exist"),
        (lambda path: path.mkdir(), "is a folder"),
        (lambda path: path.write_bytes(b""), "empty"),
        (lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" * 40), "not an EXR"),
    ],
)
def test_not_an_exr(tmp_path, make, text):
    path = tmp_path / "a.exr"
    make(path)
    with pytest.raises(InputError, match=text) as error:
        read_exr(path)
    one_line(error, path)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may do everything")
def test_no_permission(tmp_path):
    path = tmp_path / "a.exr"
    write_exr(path, image(2, 2))
    path.chmod(0)
    with pytest.raises(InputError, match="no permission to read") as error:
        read_exr(path)
    one_line(error, path)
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(InputError, match="no permission to write"):
            write_exr(tmp_path / "b.exr", image(2, 2))
    finally:
        tmp_path.chmod(0o700)


def test_write_into_missing_folder_and_onto_a_folder(tmp_path):
    with pytest.raises(InputError, match="folder does not exist"):
        write_exr(tmp_path / "no" / "a.exr", image(2, 2))
    (tmp_path / "b.exr").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        write_exr(tmp_path / "b.exr", image(2, 2))


def test_full_disk_while_renaming_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.exr"
    write_exr(path, image(2, 2))
    before = path.read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="disk is full") as error:
        write_exr(path, image(3, 3))
    one_line(error, path)
    assert os.listdir(tmp_path) == ["a.exr"]
    assert path.read_bytes() == before


@pytest.mark.parametrize("half_written", [True, False])
def test_full_disk_while_writing(tmp_path, monkeypatch, half_written):
    """The library raises, or worse, does not notice that the end of the file is missing."""
    real = OpenEXR.File

    class Full:
        def __init__(self, *arguments):
            self.file = real(*arguments)

        def write(self, name):
            self.file.write(name)
            os.truncate(name, os.path.getsize(name) // 2)
            if not half_written:
                raise RuntimeError(f'Failed to write pixel data to image file "{name}". No space left on device.')

    monkeypatch.setattr(OpenEXR, "File", Full)
    with pytest.raises(InputError, match="disk") as error:
        write_exr(tmp_path / "a.exr", image(20, 20))
    one_line(error, tmp_path / "a.exr")
    assert os.listdir(tmp_path) == []


def test_interrupt_while_writing(tmp_path, monkeypatch):
    class Interrupted:
        def __init__(self, *_):
            pass

        def write(self, _):
            raise KeyboardInterrupt

    monkeypatch.setattr(OpenEXR, "File", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_exr(tmp_path / "a.exr", image(2, 2))
    assert os.listdir(tmp_path) == []


def test_without_openexr(tmp_path, monkeypatch):
    path = tmp_path / "a.exr"
    write_exr(path, image(2, 2))
    real = builtins.__import__

    def absent(name, *arguments, **options):
        if name == "OpenEXR":
            raise ImportError(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", absent)
    for call in (lambda: read_exr(path), lambda: write_exr(path, image(2, 2))):
        with pytest.raises(InputError, match="pip install OpenEXR") as error:
            call()
        one_line(error, path)
    assert exr_size(path) == (2, 2)
