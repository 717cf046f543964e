"""PNG files, the sRGB curve, and frames written as their input was."""

import errno
import os

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxtrapolate.errors import InputError
from jaxtrapolate.files import read_exr, read_png, write_frame, write_png
from jaxtrapolate.files.exr import pick
from jaxtrapolate.files.image import decode_srgb, encode_srgb, image_size


@pytest.mark.parametrize("size", [(5, 7), (1, 1), (8, 3)])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_png_round_trip(tmp_path, size, channels):
    codes = np.random.default_rng(0).integers(0, 256, (*size, channels), np.uint8)
    write_png(tmp_path / "a.png", codes)
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), codes)
    assert image_size(tmp_path / "a.png") == size
    assert os.listdir(tmp_path) == ["a.png"]


def test_modes_of_pillow(tmp_path):
    codes = np.array([[0, 255], [255, 0]], np.uint8)
    Image.fromarray(codes).convert("1").save(tmp_path / "bits.png")
    np.testing.assert_array_equal(read_png(tmp_path / "bits.png")[..., 0], codes)
    Image.fromarray(codes).convert("RGB").convert("P").save(tmp_path / "palette.png")
    np.testing.assert_array_equal(read_png(tmp_path / "palette.png"), np.stack([codes] * 3, -1))
    deep = np.array([[0, 65535], [258, 1]], np.uint16)
    Image.fromarray(deep).save(tmp_path / "deep.png")
    np.testing.assert_array_equal(read_png(tmp_path / "deep.png")[..., 0], deep)


def test_srgb_curve():
    codes = np.arange(256, dtype=np.uint8)
    linear = decode_srgb(codes)
    np.testing.assert_array_equal(encode_srgb(linear), codes)
    # IEC 61966-2-1: the linear part below 0.04045, and a value of the power part by hand.
    np.testing.assert_allclose(linear[10], 10 / 255 / 12.92, rtol=1e-6)
    np.testing.assert_allclose(linear[188], 0.502886, rtol=1e-5)
    np.testing.assert_array_equal(encode_srgb([-1, 2, np.nan, np.inf, -np.inf]), [0, 255, 0, 255, 0])


def test_write_frame(tmp_path):
    color = jnp.linspace(0, 3, 5 * 7 * 3).reshape(5, 7, 3)
    hdr = write_frame(tmp_path / "Scene.0001", color, True)
    assert hdr == tmp_path / "Scene.0001.exr"
    np.testing.assert_array_equal(pick(read_exr(hdr), path=hdr, count=3), np.asarray(color, np.float16))
    full = write_frame(tmp_path / "full.png", color, True, half=False)
    np.testing.assert_array_equal(pick(read_exr(full), path=full, count=3), np.asarray(color))
    ldr = write_frame(tmp_path / "x.exr", color, False)
    assert ldr == tmp_path / "x.png"
    np.testing.assert_array_equal(read_png(ldr), encode_srgb(color))
    with pytest.raises(ValueError, match=r"expected shape \[H, W, 3\], got \[5, 7, 1\]"):
        write_frame(tmp_path / "y", color[..., :1], True)


def test_codes_that_cannot_be_written(tmp_path):
    with pytest.raises(TypeError, match="uint8"):
        write_png(tmp_path / "a.png", np.zeros((2, 2, 3)))
    with pytest.raises(ValueError, match="expected"):
        write_png(tmp_path / "a.png", np.zeros((2, 2, 5), np.uint8))


@pytest.mark.parametrize("where", ["save", "replace"])
def test_full_disk(tmp_path, monkeypatch, where):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(*((Image.Image, "save", full) if where == "save" else (os, "replace", full)))
    with pytest.raises(InputError, match="disk is full") as error:
        write_png(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))
    assert str(tmp_path / "a.png") in str(error.value)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("kind, text", [("missing", "does not exist"), ("text", "not an image"), ("cut", "truncated")])
def test_bad_files(tmp_path, kind, text):
    path = tmp_path / "a.png"
    if kind == "text":
        path.write_text("no image")
    elif kind == "cut":
        write_png(path, np.random.default_rng(0).integers(0, 256, (40, 40, 3), np.uint8))
        path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(InputError, match=text) as error:
        read_png(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
