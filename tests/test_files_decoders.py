"""Image files against other writers: 16 bits, values, alpha, colours that are not RGB, and limits."""

import os
import struct
import sys
import threading
import zlib

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image

from jaxtrapolate.errors import InputError, printable
from jaxtrapolate.files import open_sequence, read_exr, read_png, write_exr, write_png
from jaxtrapolate.files.exr import exr_size
from jaxtrapolate.files.image import decode_srgb, image_header, image_size, read_image


def codes(dtype, *shape, seed=0):
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def folder(path, text):
    path.mkdir(exist_ok=True)
    (path / "jaxtrapolate.toml").write_text(text)
    return path


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(path, width, height, bits, colour, rows, *, interlace=0, extra=b""):
    """A PNG by the specification, without a library: rows are filtered bytes."""
    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, interlace)
    content = chunk(b"IHDR", header) + extra + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + content)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("size", [(9, 13), (1, 1)])
def test_png_of_16_bits(tmp_path, channels, size):
    stored = codes(np.uint16, *size, channels)
    order = [2, 1, 0, 3][:channels] if channels > 1 else [0]
    assert cv2.imwrite(str(tmp_path / "a.png"), stored[..., order])
    read = read_png(tmp_path / "a.png")
    assert read.dtype == np.uint16
    np.testing.assert_array_equal(read, stored)
    header = image_header(tmp_path / "a.png")
    assert (header.size, header.channels, header.alpha, header.codes) == (size, channels, channels == 4, True)


def test_grey_with_alpha_of_16_bits(tmp_path):
    stored = codes(np.uint16, 3, 5, 2)
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in stored)
    png(tmp_path / "a.png", 5, 3, 16, 4, rows)
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), stored)


@pytest.mark.parametrize("bits, dtype", [(8, np.uint8), (16, np.uint16)])
@pytest.mark.parametrize("colour", [0, 2])
def test_a_colour_that_stands_for_transparent(tmp_path, bits, dtype, colour):
    channels = 3 if colour == 2 else 1
    stored = codes(dtype, 2, 4, channels)
    key = stored[1, 2]
    stored[0, 0, 0] = key[0] ^ 1  # differs in the lowest bit alone
    stored[0, 0, 1:] = key[1:]
    rows = b"".join(b"\0" + row.astype(f">u{bits // 8}").tobytes() for row in stored)
    png(tmp_path / "a.png", 4, 2, bits, colour, rows, extra=chunk(b"tRNS", key.astype(">u2").tobytes()))
    read = read_png(tmp_path / "a.png")
    np.testing.assert_array_equal(read[..., :channels], stored)
    np.testing.assert_array_equal(read[..., channels] > 0, [[True] * 4, [True, True, False, True]])
    assert image_header(tmp_path / "a.png").alpha


def test_srgb_of_16_bits_is_that_of_8(tmp_path):
    every = np.arange(256, dtype=np.uint8)
    np.testing.assert_allclose(decode_srgb(every.astype(np.uint16) * 257), decode_srgb(every), rtol=2e-7)
    # IEC 61966-2-1 by hand at 32576 / 65535 = 0.4970779.
    np.testing.assert_allclose(decode_srgb(np.uint16([32576])), ((0.4970779 + 0.055) / 1.055) ** 2.4, rtol=1e-5)
    for name, stored in (("g8", np.full((4, 4), 128, np.uint8)), ("g16", np.full((4, 4), 128 * 257, np.uint16))):
        path = folder(tmp_path / name, '[buffers]\ncolor = { file = "{frame}.png", channels = "YYY" }\n')
        cv2.imwrite(str(path / "1.png"), stored)
        np.testing.assert_allclose(open_sequence(path).frame(1).color, 0.21586, atol=1e-5)


def test_flow_of_kitti(tmp_path):
    text = 'motion = { file = "{frame}_10.png", codes = true, scale = 0.015625, offset = -512, valid = "B" }'
    path = folder(tmp_path / "kitti", f"[buffers]\n{text}\n")
    flow = np.array([[[-3.0, 2.5], [0.0, 0.0]], [[511.984375, -512.0], [7.0, 1 / 64]]])
    stored = np.ones((2, 2, 3), np.uint16)
    stored[..., :2] = flow * 64 + 2**15
    stored[0, 1] = 0
    cv2.imwrite(str(path / "1_10.png"), stored[..., ::-1])
    sequence = open_sequence(path)
    motion = sequence.frame(1).motion
    valid = np.array([[True, False], [True, True]])
    np.testing.assert_array_equal(motion[valid], flow[valid])
    assert np.isnan(motion[~valid]).all()
    np.testing.assert_array_equal(sequence.invalid(1), ~valid)
    assert sequence.nonfinite(1) == 1


def test_valid_channel_of_an_exr(tmp_path):
    path = folder(tmp_path / "exr", '[buffers]\nmotion = { file = "{frame}.exr", channels = "RG", valid = "B" }\n')
    image = np.ones((2, 3, 3), np.float32)
    image[1, 2, 2] = 0
    write_exr(path / "1.exr", image)
    np.testing.assert_array_equal(np.argwhere(open_sequence(path).invalid(1)), [[1, 2]])


@pytest.mark.parametrize("dtype", [np.int32, np.uint32, np.int16, np.float16, np.float32, np.float64])
@pytest.mark.parametrize("channels", [1, 3])
def test_tiff_values_are_what_is_stored(tmp_path, dtype, channels):
    stored = (np.random.default_rng(0).normal(0, 1000, (5, 7, channels)) + 614300 * (dtype == np.int32)).astype(dtype)
    tifffile.imwrite(
        tmp_path / "a.tif", stored, photometric="rgb" if channels > 1 else "minisblack", compression="zlib"
    )
    header, read = read_image(tmp_path / "a.tif")
    np.testing.assert_array_equal(read, stored)
    assert read.dtype == dtype
    assert not header.codes
    assert not header.alpha
    with pytest.raises(InputError, match=r"a\.tif: holds values of .*codes are needed"):
        read_png(tmp_path / "a.tif")


@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("byteorder", ["<", ">"])
def test_tiff_codes(tmp_path, planar, dtype, byteorder):
    stored = codes(dtype, 6, 5, 4)
    options = {"photometric": "rgb", "extrasamples": ["unassalpha"], "byteorder": byteorder}
    planes = stored if planar == "contig" else np.moveaxis(stored, -1, 0)
    tifffile.imwrite(tmp_path / "a.tiff", planes, planarconfig=planar, **options)
    header, read = read_image(tmp_path / "a.tiff")
    np.testing.assert_array_equal(read, stored)
    assert (header.size, header.alpha, header.codes) == ((6, 5), True, True)


def test_tiff_compressed_by_another_library(tmp_path):
    stored = codes(np.uint8, 6, 5, 3)
    Image.fromarray(stored).save(tmp_path / "a.tif", compression="tiff_lzw")
    np.testing.assert_array_equal(read_png(tmp_path / "a.tif"), stored)
    Image.fromarray(stored[..., 0]).convert("P").save(tmp_path / "p.tif")
    assert read_png(tmp_path / "p.tif").shape == (6, 5, 3)


@pytest.mark.parametrize("name", ["a.bmp", "a.tga", "a.jpg"])
def test_other_files_of_codes(tmp_path, name):
    stored = np.full((6, 5, 3), (200, 100, 50), np.uint8)
    Image.fromarray(stored).save(tmp_path / name, **({"quality": 100, "subsampling": 0} if name == "a.jpg" else {}))
    read = read_png(tmp_path / name)
    np.testing.assert_allclose(read.astype(int), stored, atol=2 if name == "a.jpg" else 0)
    assert image_header(tmp_path / name).size == (6, 5)


def test_integers_of_a_tiff_are_ids(tmp_path):
    path = folder(tmp_path / "ids", '[buffers]\nstencil = "{frame}.tif"\n')
    Image.fromarray(np.full((4, 4), 614300, np.int32)).save(path / "1.tif")
    np.testing.assert_array_equal(open_sequence(path).frame(1).gbuffer.stencil, 614300)


def test_radiance_hdr(tmp_path):
    rng = np.random.default_rng(0)
    values = (rng.random((20, 30, 3)) * np.exp(rng.normal(0, 4, (20, 30, 1)))).astype(np.float32)
    values[3:9] = 0.25
    path = folder(tmp_path / "hdr", '[buffers]\ncolor = "{frame}.hdr"\n')
    for number, image in ((1, values), (2, values[:, :5])):  # runs; and too narrow for runs
        target = folder(tmp_path / f"hdr{number}", '[buffers]\ncolor = "{frame}.hdr"\n') / "1.hdr"
        cv2.imwrite(str(target), image[..., ::-1])
        reference = cv2.imread(str(target), cv2.IMREAD_UNCHANGED)[..., ::-1]
        np.testing.assert_array_equal(read_image(target)[1], reference)
        np.testing.assert_allclose(reference, image, atol=image.max() / 100)
        sequence = open_sequence(target.parent)
        assert sequence.hdr
        np.testing.assert_array_equal(sequence.frame(1).color, reference)
    content = (tmp_path / "hdr1" / "1.hdr").read_bytes()
    (path / "1.hdr").write_bytes(content.replace(b"\n\n", b"\nEXPOSURE=2\n\n", 1))
    np.testing.assert_allclose(read_image(path / "1.hdr")[1] * 2, read_image(tmp_path / "hdr1" / "1.hdr")[1])


def test_flow_files(tmp_path):
    flow = np.random.default_rng(0).normal(0, 5, (4, 6, 2)).astype(np.float32)
    path = folder(tmp_path / "flo", '[buffers]\nmotion = "{frame}.flo"\n')
    assert cv2.writeOpticalFlow(str(path / "1.flo"), flow)
    np.testing.assert_array_equal(open_sequence(path).frame(1).motion, flow)
    flow[2, 3] = 1.7e9  # Middlebury's mark of a vector that is not known
    cv2.writeOpticalFlow(str(path / "1.flo"), flow)
    np.testing.assert_array_equal(np.argwhere(open_sequence(path).invalid(1)), [[2, 3]])


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<i8", "?"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays(tmp_path, dtype, order):
    stored = np.asarray(np.random.default_rng(0).normal(0, 100, (3, 5, 2)).astype(dtype), order=order)
    np.save(tmp_path / "a.npy", stored)
    header, read = read_image(tmp_path / "a.npy")
    np.testing.assert_array_equal(read, stored.astype(np.uint8) * 255 if dtype == "?" else stored)
    assert header.codes == (dtype == "?")
    assert header.size == (3, 5)
    np.save(tmp_path / "a.npy", stored[..., 0])
    assert read_image(tmp_path / "a.npy")[1].shape == (3, 5, 1)


def cmyk(path):
    Image.new("CMYK", (4, 4), (10, 20, 30, 40)).save(path, format="JPEG" if path.suffix == ".jpg" else "TIFF")


def lab(path):
    Image.new("LAB", (4, 4), (10, 20, 30)).save(path, format="TIFF")


def animated(path):
    first, second = Image.new("RGB", (4, 4)), Image.new("RGB", (4, 4), (9, 9, 9))
    first.save(path, format="PNG", save_all=True, append_images=[second])


def pages(path):
    tifffile.imwrite(path, np.zeros((2, 8, 9), np.float32), photometric="minisblack")


def lzw(path):
    tifffile.imwrite(path, np.zeros((4, 5), np.float32))
    content = bytearray(path.read_bytes())
    at = content.index(struct.pack("<HHI", 259, 3, 1))  # the tag of compression
    content[at + 8 : at + 10] = struct.pack("<H", 5)
    path.write_bytes(content)


def written(content):
    return lambda path: path.write_bytes(content)


REFUSED = {
    "cmyk.jpg": (cmyk, "its colours are CMYK, not grey or RGB"),
    "cmyk.tif": (cmyk, "its colours are SEPARATED, not grey or RGB"),
    "lab.tif": (lab, "its colours are CIELAB, not grey or RGB"),
    "animated.png": (animated, "several pictures"),
    "pages.tif": (pages, "several pictures"),
    "lzw.tif": (lzw, "compressed by LZW, .*imagecodecs"),
    "gif.png": (lambda path: Image.new("L", (4, 4)).save(path, format="GIF"), "not an image of a kind that is read"),
    "exr.png": (lambda path: write_exr(f"{path}", np.zeros((2, 2, 3))), r"is an EXR file; give it the ending \.exr"),
    "postscript.png": (written(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"), "not an image of a kind"),
    "empty.png": (written(b""), "empty"),
    "objects.npy": (lambda path: np.save(path, np.array([[None]])), "is no image"),
    "line.npy": (lambda path: np.save(path, np.zeros(4)), "is no image"),
    "claims.npy": (
        lambda path: path.write_bytes(
            b"\x93NUMPY\x01\0v\0" + b"{'descr': '<f4', 'fortran_order': False, 'shape': (9, 9)}".ljust(117) + b"\n"
        ),
        "truncated or damaged",
    ),
    "short.flo": (written(b"PIEH" + struct.pack("<ii", 4, 4) + b"\0" * 8), "truncated or damaged"),
    "xyz.hdr": (written(b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\n\0\0\0\0"), "32-bit_rle_xyze, not RGB"),
    "turned.hdr": (written(b"#?RADIANCE\n\n+X 1 -Y 1\n\0\0\0\0"), "states no size"),
    "old.hdr": (written(b"#?RADIANCE\n\n-Y 1 +X 3\n" + b"\x09" * 4 + b"\1\1\1\2"), "layout before 1991"),
}


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_what_cannot_be_read_is_said_truly(tmp_path, name, capfd):
    make, text = REFUSED[name]
    make(tmp_path / name)
    with pytest.raises(InputError, match=text) as error:
        read_image(tmp_path / name)
    assert str(tmp_path / name) in str(error.value)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_no_program_is_started(tmp_path, monkeypatch):
    """A PostScript file by the name of a PNG; the first gs in PATH tells whether it ran."""
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "gs"
    program.write_text(f"#!/bin/sh\necho ran > {tmp_path}/ran\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:{os.environ['PATH']}")
    for name in ("a.png", "a.tga", "a.eps"):
        (tmp_path / name).write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n")
        with pytest.raises(InputError):
            read_png(tmp_path / name)
    assert not (tmp_path / "ran").exists()


# -- alpha


def test_alpha_of_a_png_is_a_hole(tmp_path):
    path = folder(tmp_path / "png", '[buffers]\ncolor = "{frame}.png"\n')
    stored = np.full((3, 4, 4), 200, np.uint8)
    stored[1, 2] = (10, 20, 30, 0)
    stored[2, 2] = (10, 20, 30, 1)
    write_png(path / "1.png", stored)
    sequence = open_sequence(path)
    np.testing.assert_array_equal(np.argwhere(sequence.invalid(1)), [[1, 2]])
    color = sequence.frame(1).color
    np.testing.assert_array_equal(color[1, 2], color[0, 0])  # the nearest pixel that is there
    np.testing.assert_array_equal(color[2, 2], decode_srgb(np.uint8([10, 20, 30])))
    (note,) = sequence.notes
    assert "alpha" in note
    assert "not scored" in note
    assert "straight" in note
    with pytest.raises(InputError, match=r"frame 1 has 1 non-finite pixels \(or of alpha 0\)"):
        open_sequence(path, strict=True).frame(1)


def test_a_png_of_nothing_has_no_pixels(tmp_path):
    path = folder(tmp_path / "png", '[buffers]\ncolor = "{frame}.png"\n')
    Image.new("RGBA", (4, 4), (200, 10, 10, 0)).save(path / "1.png")
    sequence = open_sequence(path)
    assert sequence.nonfinite(1) == 16
    np.testing.assert_array_equal(sequence.frame(1).color, 0)


def test_alpha_of_a_packed_clip(tmp_path):
    (tmp_path / "color").mkdir()
    stored = np.full((2, 2, 4), 255, np.uint8)
    stored[0, 1, 3] = 0
    write_png(tmp_path / "color" / "0001.png", stored)
    sequence = open_sequence(tmp_path)
    np.testing.assert_array_equal(np.argwhere(sequence.invalid(1)), [[0, 1]])
    assert len(sequence.notes) == 1


@pytest.mark.parametrize("reader", ["unreal", "layer"])
def test_alpha_of_an_exr(tmp_path, reader):
    image = np.random.default_rng(0).uniform(1, 2, (3, 4, 4)).astype(np.float32)
    image[1, 2] = 0
    image[2, 2, 3] = 0.25
    if reader == "unreal":
        for number in (1, 2):
            write_exr(tmp_path / f"APreTonemapHDRColor.{number:04d}.exr", image, half=False)
            image = image * np.float32([1, 1, 1, 0])
    else:
        folder(tmp_path, '[buffers]\ncolor = { file = "{frame}.exr", layer = "View.Combined" }\n')
        for number in (1, 2):
            layers = {f"View.Combined.{c}": image[..., k] for k, c in enumerate("RGBA")}
            write_exr(tmp_path / f"{number}.exr", {**layers, "View.Z.A": image[..., 0]}, half=False)
            image = image * np.float32([1, 1, 1, 0])
    sequence = open_sequence(tmp_path)
    assert ["premultiplied" in note for note in sequence.notes] == [True]
    np.testing.assert_array_equal(np.argwhere(sequence.invalid(1)), [[1, 2]])
    np.testing.assert_array_equal(sequence.frame(1).color[2, 2], image[2, 2, :3])
    assert sequence.nonfinite(2) == 0  # alpha that is 0 everywhere was not written
    assert "2.exr: its alpha is 0 everywhere" in sequence.notes[-1]
    np.testing.assert_array_equal(sequence.frame(2).color, image[..., :3])


def test_alpha_of_signalling_nans_warns_of_nothing(tmp_path):
    """Which raise a floating-point flag in sums over them; any number but 0 is alpha."""
    image = np.ones((4, 5, 4), np.float32)
    image[..., 3] = np.full((4, 5), 0x7F800001, np.uint32).view(np.float32)
    folder(tmp_path, '[buffers]\ncolor = "{frame}.exr"\n')
    write_exr(tmp_path / "1.exr", image, half=False)
    np.testing.assert_array_equal(open_sequence(tmp_path).frame(1).color, image[..., :3])


# -- limits


def exr_of(path, display, data=(0, 0, 0, 0), channels=1):
    """A small EXR whose header is changed to claim other windows."""
    planes = {f"C{k:04d}": np.ones((1, 1), np.float32) for k in range(channels)}
    OpenEXR.File({"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}, planes).write(str(path))
    content = bytearray(path.read_bytes())
    for name, window in ((b"displayWindow\0box2i\0", display), (b"dataWindow\0box2i\0", data)):
        at = content.index(name) + len(name) + 4
        content[at : at + 16] = struct.pack("<4i", *window)
    path.write_bytes(content)


def claim_png(path):
    png(path, 30000, 30000, 8, 2, b"")


def claim_tiff(path):
    tifffile.imwrite(path, np.zeros((2, 3), np.float32), photometric="minisblack")
    content = bytearray(path.read_bytes())
    at = content.index(struct.pack("<H", 256), 8)  # the tag of the width
    content[at : at + 12] = struct.pack("<HHII", 256, 4, 1, 2**30)
    path.write_bytes(content)


LARGE = {
    "display.exr": lambda path: exr_of(path, (0, 0, 29999, 29999)),
    "data.exr": lambda path: exr_of(path, (0, 0, 0, 0), (0, 0, 2**31 - 2, 2**30)),
    "channels.exr": lambda path: exr_of(path, (0, 0, 0, 0), channels=1100),
    "samples.exr": lambda path: exr_of(path, (0, 0, 7999, 3999), channels=100),
    "a.png": claim_png,
    "a.tif": claim_tiff,
    "a.hdr": lambda path: path.write_bytes(b"#?RADIANCE\n\n-Y 30000 +X 30000\n\2\2"),
    "a.flo": lambda path: path.write_bytes(b"PIEH" + struct.pack("<ii", 2**31 - 1, 2**31 - 1)),
    "a.npy": lambda path: path.write_bytes(
        b"\x93NUMPY\x01\0v\0" + b"{'descr': '<f4', 'fortran_order': False, 'shape': (30000, 30000)}".ljust(117) + b"\n"
    ),
}


@pytest.mark.parametrize("name", sorted(LARGE))
def test_what_is_too_large_is_refused_by_its_header(tmp_path, name):
    LARGE[name](tmp_path / name)
    assert (tmp_path / name).stat().st_size < 200_000
    size, read = (exr_size, read_exr) if name.endswith("exr") else (image_size, read_image)
    for function in (size, read):
        with pytest.raises(InputError, match=r"more than .* (JAXTRAPOLATE_MAX_PIXELS|store fewer)") as error:
            function(tmp_path / name)
        assert "\n" not in str(error.value)


def test_the_limit_can_be_set(tmp_path, monkeypatch):
    write_png(tmp_path / "a.png", np.zeros((10, 11, 3), np.uint8))
    write_exr(tmp_path / "a.exr", np.zeros((10, 11, 3)))
    for limit, fits in (("109", False), ("110", True)):
        monkeypatch.setenv("JAXTRAPOLATE_MAX_PIXELS", limit)
        for read, name in ((read_png, "a.png"), (read_exr, "a.exr")):
            if fits:
                read(tmp_path / name)
            else:
                with pytest.raises(InputError, match="11x10 are more than 109 pixels"):
                    read(tmp_path / name)
    for text in ("many", "-1", "0", "1e9", "9" * 30):
        monkeypatch.setenv("JAXTRAPOLATE_MAX_PIXELS", text)
        with pytest.raises(InputError, match="JAXTRAPOLATE_MAX_PIXELS: expected a whole number"):
            read_png(tmp_path / "a.png")


def test_a_small_file_takes_little_memory(tmp_path):
    """335 bytes that claim a display window just under the limit: what is read is not kept for all of it at once."""
    exr_of(tmp_path / "a.exr", (0, 0, 6999, 4999))
    assert (tmp_path / "a.exr").stat().st_size < 400
    stored = read_exr(tmp_path / "a.exr")["C0000"]
    assert stored.shape == (5000, 7000)
    assert stored[0, 0] == 1
    assert stored.sum() == 1


# -- names and kinds of files


def test_names_that_are_no_utf8(tmp_path):
    base = os.fsencode(tmp_path)
    write_exr(os.fsdecode(base + b"/caf\xe9.exr"), np.ones((2, 3, 3)))
    write_png(os.fsdecode(base + b"/caf\xe9.png"), np.zeros((2, 3, 3), np.uint8))
    assert sorted(os.listdir(base)) == [b"caf\xe9.exr", b"caf\xe9.png"]
    assert read_exr(os.fsdecode(base + b"/caf\xe9.exr"))["R"].shape == (2, 3)
    assert read_png(os.fsdecode(base + b"/caf\xe9.png")).shape == (2, 3, 3)
    for read in (read_exr, read_png):
        with pytest.raises(InputError, match=r"n\\udce9\\nx: does not exist") as error:
            read(os.fsdecode(base + b"/n\xe9\nx"))
        str(error.value).encode("utf-8")
        assert "\n" not in str(error.value)


def test_printable():
    assert printable("größer 猫 ok") == "größer 猫 ok"
    assert printable("a\nb\x1b[31m\udcff") == r"a\nb\x1b[31m\udcff"
    assert len(printable("x" * 10**6)) < 2100


def pipe(path):
    os.mkfifo(path)


def circle(path):
    path.symlink_to(path.name)


def zeros(path):
    path.symlink_to("/dev/zero")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
@pytest.mark.parametrize(
    "make, text",
    [(pipe, "is a named pipe, not a regular file"), (circle, "leads back to itself"), (zeros, "is a device, not a")],
)
@pytest.mark.parametrize("name", ["a.exr", "a.png", "jaxtrapolate.toml"])
def test_only_regular_files_are_opened(tmp_path, make, text, name):
    make(tmp_path / name)
    if name.endswith("toml"):
        with pytest.raises(InputError, match=text):
            open_sequence(tmp_path)
        return
    for read in (read_exr, exr_size) if name.endswith("exr") else (read_png, image_size):
        with pytest.raises(InputError, match=text) as error:
            read(tmp_path / name)
        assert "\n" not in str(error.value)


# -- what is printed


def damaged_exr(path):
    write_exr(path, np.random.default_rng(0).random((64, 64, 3)), half=False)
    content = bytearray(path.read_bytes())
    for k in range(len(content) // 3, len(content) // 3 * 2, 7):
        content[k] ^= 0x55
    path.write_bytes(content)


def test_damage_prints_nothing_while_another_thread_draws(tmp_path, capfd):
    """OpenEXR prints two lines in C and one in Python for such a file; what other threads print meanwhile stays."""
    damaged_exr(tmp_path / "a.exr")
    stop = threading.Event()
    drawn = []

    def draw():
        while not stop.is_set():
            os.write(2, b"x")
            print("y", end="", file=sys.stderr, flush=True)
            print("z", end="", flush=True)
            drawn.append(1)

    thread = threading.Thread(target=draw)
    thread.start()
    try:
        for _ in range(20):
            with pytest.raises(InputError, match="damaged"):
                read_exr(tmp_path / "a.exr")
    finally:
        stop.set()
        thread.join()
    out, err = capfd.readouterr()
    assert out == "z" * len(drawn)
    assert err == "xy" * len(drawn)


def test_two_threads_may_read_damaged_files(tmp_path, capfd):
    damaged_exr(tmp_path / "a.exr")
    write_exr(tmp_path / "b.exr", np.ones((64, 64, 3)))
    before = sys.stdout
    failed = []

    def read():
        for _ in range(10):
            try:
                read_exr(tmp_path / "a.exr")
            except InputError:
                failed.append(1)
            read_exr(tmp_path / "b.exr")

    threads = [threading.Thread(target=read) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(failed) == 40
    assert sys.stdout is before
    assert capfd.readouterr() == ("", "")
