"""Packed PNG clips: files made with Pillow, the formula of the format, and a real clip."""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxtrapolate.errors import InputError
from jaxtrapolate.files import MotionConvention, PackedSequence, open_sequence
from jaxtrapolate.files.image import decode_srgb, encode_srgb
from jaxtrapolate.files.packed import decode_motion, encode_motion

DATA = os.environ.get("JAXTRAPOLATE_DATA")


def clip(folder, numbers=(0, 1), size=(3, 5)):
    rng = np.random.default_rng(0)
    codes = {
        "color": rng.integers(0, 256, (*size, 3)),
        "motion": rng.integers(0, 256, (*size, 4)),
        "depth": rng.integers(0, 256, size),
        "stencil": rng.choice([0, 255], size),
        "shadow": rng.integers(0, 256, size),
    }
    for name, image in codes.items():
        (folder / name).mkdir(parents=True, exist_ok=True)
        for number in numbers:
            Image.fromarray(image.astype(np.uint8)).save(folder / name / f"{number:04d}.png")
    return codes


@pytest.mark.parametrize("size", [(3, 5), (1, 1)])
def test_every_buffer(tmp_path, size):
    codes = clip(tmp_path, size=size)
    sequence = open_sequence(tmp_path)
    assert isinstance(sequence, PackedSequence)
    assert (sequence.numbers, sequence.size) == ((0, 1), size)
    assert (sequence.hdr, sequence.depth, sequence.forward_motion) == (False, "ordinal", False)
    frame = sequence.frame(1)
    assert frame.color.dtype == frame.motion.dtype == np.float32
    np.testing.assert_array_equal(encode_srgb(frame.color), codes["color"])
    np.testing.assert_array_equal(frame.gbuffer.depth[..., 0], (256 - codes["depth"]) / 256)
    assert frame.gbuffer.sky is None
    np.testing.assert_array_equal(frame.gbuffer.stencil[..., 0], codes["stencil"] > 0)
    np.testing.assert_allclose(frame.gbuffer.shadow[..., 0], codes["shadow"] / 255, atol=1e-6)
    # The formula of the format: previous = (x - mv_x, y - mv_y), rows downwards.
    r, g, b, a = np.moveaxis(codes["motion"] / 255, -1, 0)
    mv_x, mv_y = (2 * (r + g / 255) - 1) * size[1], -(2 * (b + a / 255) - 1) * size[0]
    np.testing.assert_allclose(frame.motion, np.stack([-mv_x, -mv_y], -1), atol=1e-5)
    assert sequence.keyframe(1) is None
    assert sequence.invalid(1) is None
    assert str(sequence.convention) == "current_minus_previous,uv,up"


def test_motion_codes():
    motion = np.random.default_rng(0).uniform(-1, 1, (20, 7, 2)).astype(np.float32)
    codes = encode_motion(motion)
    np.testing.assert_allclose(decode_motion(codes), motion, atol=1.01 / 255**2)
    np.testing.assert_array_equal(encode_motion(decode_motion(codes)), codes)
    zero = encode_motion(np.zeros((1, 1, 2)))
    np.testing.assert_allclose(decode_motion(zero), 0, atol=2 / 255**2)
    extremes = np.array([[[-1.0, 1.0]]])
    np.testing.assert_allclose(decode_motion(encode_motion(extremes)), extremes, atol=1e-6)


def test_ids_stay_ids(tmp_path):
    clip(tmp_path)
    Image.fromarray(np.array([[0, 1, 2, 3, 255]] * 3, np.uint8)).save(tmp_path / "stencil" / "0000.png")
    sequence = PackedSequence(tmp_path)
    assert [sequence.stored_id(number) for number in (1, 2, 255)] == [255, 2, 1]
    np.testing.assert_array_equal(PackedSequence(tmp_path).frame(0).gbuffer.stencil[0, :, 0], [0, 255, 2, 3, 1])


def test_clip_in_a_subfolder(tmp_path):
    clip(tmp_path / "540p")
    (tmp_path / "1080p" / "color").mkdir(parents=True)
    assert open_sequence(tmp_path).numbers == (0, 1)
    assert open_sequence(tmp_path / "540p").name == f"{tmp_path.name}/540p"
    assert open_sequence(tmp_path).name == tmp_path.name
    clip(tmp_path / "720p")
    with pytest.raises(InputError, match="several clips"):
        open_sequence(tmp_path)


def test_color_alone_and_missing_color(tmp_path):
    codes = clip(tmp_path, numbers=(4, 5))
    (tmp_path / "color" / "0005.png").unlink()
    sequence = PackedSequence(tmp_path, motion=MotionConvention("previous_minus_current", "uv", "down"))
    assert sequence.frame(5).color is None
    np.testing.assert_allclose(sequence.frame(5).motion, decode_motion(codes["motion"]) * [5, 3], atol=1e-5)
    for name in ("motion", "depth", "stencil", "shadow"):
        for file in (tmp_path / name).iterdir():
            file.unlink()
        (tmp_path / name).rmdir()
    only = PackedSequence(tmp_path)
    assert (only.numbers, only.depth) == ((4,), "absent")
    frame = only.frame(4)
    assert frame.gbuffer is None
    assert frame.motion is None
    np.testing.assert_array_equal(frame.color, decode_srgb(codes["color"].astype(np.uint8)))


@pytest.mark.parametrize("buffer, mode", [("color", "L"), ("motion", "RGB")])
def test_wrong_channels(tmp_path, buffer, mode):
    clip(tmp_path)
    path = tmp_path / buffer / "0001.png"
    Image.new(mode, (5, 3)).save(path)
    sequence = PackedSequence(tmp_path)
    with pytest.raises(InputError, match=f"a packed {buffer} has") as error:
        sequence.frame(1)
    assert str(path) in str(error.value)


@pytest.mark.skipif(DATA is None, reason="JAXTRAPOLATE_DATA is not set")
def test_real_clip():
    sequence = open_sequence(Path(DATA or "") / "bunker")
    assert (sequence.name, sequence.numbers, sequence.size) == ("bunker", tuple(range(20)), (540, 960))
    frame, previous = sequence.frame(5), sequence.frame(4)
    runner = frame.gbuffer.stencil[..., 0] > 0
    assert set(np.unique(frame.gbuffer.stencil)) == {0, 1}
    assert 0.005 < runner.mean() < 0.05
    # Larger = farther: the floor at the bottom is nearer than the end of the hall.
    assert frame.gbuffer.depth[-20:].mean() < frame.gbuffer.depth[200:220].mean()
    # The vectors lead back to where the runner was: nearest-pixel warp against none.
    rows, columns = np.mgrid[:540, :960]
    y = np.rint(rows + frame.motion[..., 1]).astype(int).clip(0, 539)
    x = np.rint(columns + frame.motion[..., 0]).astype(int).clip(0, 959)
    warped, still = previous.color[y, x] - frame.color, previous.color - frame.color
    assert np.mean(warped**2) < 0.4 * np.mean(still**2)
    # 255 = shadow: the floor is darker in it.
    luminance, shadow = frame.color.mean(axis=-1)[300:], frame.gbuffer.shadow[300:, :, 0]
    assert luminance[shadow > 0.9].mean() < 0.9 * luminance[shadow < 0.1].mean()
