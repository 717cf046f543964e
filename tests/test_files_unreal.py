"""Unreal dumps: round trips of the writer, files made by calling OpenEXR directly, and a real dump."""

import os
from pathlib import Path

import numpy as np
import pytest

from jaxtrapolate.errors import InputError
from jaxtrapolate.files import MotionConvention, UnrealSequence, open_sequence, write_unreal_frame
from jaxtrapolate.files.repair import LOST
from jaxtrapolate.records import CHANNELS, Frame, GBuffer, Keyframe

OpenEXR = pytest.importorskip("OpenEXR")
DATA = os.environ.get("JAXTRAPOLATE_DATA")


def store(folder, scene, buffer, number, image, dtype=np.float32):
    """One file, by OpenEXR itself: three channels as "RGB", one as "Y"."""
    image = np.ascontiguousarray(image, dtype)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {"RGB": image} if image.ndim == 3 else {"Y": image}
    OpenEXR.File(header, channels).write(str(folder / f"{scene}{buffer}.{number:04d}.exr"))


def example(size, seed=0):
    rng = np.random.default_rng(seed)

    def half(*shape):
        return rng.random(shape).astype(np.float16).astype(np.float32)

    fields = {name: half(*size, channels) for name, channels in CHANNELS.items()}
    fields["sky"] = (rng.random((*size, 1)) < 0.3).astype(np.float32)
    fields["normal"] = np.where(fields["sky"] == 1, 0, fields["normal"]).astype(np.float32)
    fields["stencil"] = rng.integers(0, 4, (*size, 1)).astype(np.float32)
    fields["depth"] = np.where(fields["sky"] == 1, np.inf, rng.random((*size, 1)) * 5000 + 1).astype(np.float32)
    fields["position"] = (rng.normal(size=(*size, 3)) * 5000).astype(np.float32)
    motion = rng.normal(size=(*size, 2)).astype(np.float32)
    flow = rng.normal(size=(2, *size, 3)).astype(np.float32)
    frame = Frame(half(*size, 3) * 9, GBuffer(**fields), motion, time=3.0)
    return frame, Keyframe(forward_flow=flow[0], backward_flow=flow[1])


def same(a, b, **tolerance):
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), **({"rtol": 0, "atol": 0} | tolerance))


@pytest.mark.parametrize("size", [(5, 7), (1, 1), (2, 9)])
def test_round_trip(tmp_path, size):
    frame, keyframe = example(size)
    paths = write_unreal_frame(tmp_path / "new" / "dump", "Town", 3, frame, keyframe=keyframe)
    assert sorted(path.name for path in paths) == sorted(os.listdir(tmp_path / "new" / "dump"))
    sequence = UnrealSequence(tmp_path / "new" / "dump")
    assert (sequence.name, sequence.numbers, sequence.size) == ("new/dump (Town)", (3,), size)
    assert (sequence.hdr, sequence.depth, sequence.forward_motion) == (True, "metric", True)
    back = sequence.frame(3)
    assert back.time == 3
    same(back.color, np.asarray(frame.color).astype(np.float16).astype(np.float32))
    same(back.motion, frame.motion)
    for name in CHANNELS:
        same(getattr(back.gbuffer, name), getattr(frame.gbuffer, name), rtol=1e-6 if name == "depth" else 0)
        assert getattr(back.gbuffer, name).dtype == np.float32
    again = sequence.keyframe(3)
    assert again.time == 3
    for flow in ("forward_flow", "backward_flow"):
        same(getattr(again, flow), getattr(keyframe, flow), rtol=1e-6)
    same(again.depth, back.gbuffer.depth)
    assert sequence.nonfinite(3) == 0
    assert sequence.invalid(3) is None


def test_full_precision(tmp_path):
    color = np.random.default_rng(0).random((3, 2, 3)).astype(np.float32)
    write_unreal_frame(tmp_path, "A", 0, Frame(color), half=False)
    same(UnrealSequence(tmp_path).frame(0).color, color)


def test_unit_of_position(tmp_path):
    frame, keyframe = example((3, 4))
    write_unreal_frame(tmp_path, "A", 1, frame, keyframe=keyframe, unit=100.0)
    sequence = UnrealSequence(tmp_path)
    same(sequence.frame(1).gbuffer.position, frame.gbuffer.position * 100, rtol=1e-6)
    same(sequence.frame(1).gbuffer.depth, frame.gbuffer.depth * 100, rtol=1e-6)
    same(sequence.keyframe(1).forward_flow[..., 2], keyframe.forward_flow[..., 2] * 100, rtol=1e-6)
    same(sequence.keyframe(1).forward_flow[..., :2], keyframe.forward_flow[..., :2])


def test_soft_sky_without_normal(tmp_path):
    sky = np.array([[[0.25], [1.0]]], np.float32)
    write_unreal_frame(tmp_path, "A", 1, Frame(gbuffer=GBuffer(sky=sky)))
    same(UnrealSequence(tmp_path).frame(1).gbuffer.sky, sky)


def test_files_of_an_engine(tmp_path):
    """Units, signs and channels against values worked out by hand."""
    ones = np.ones((2, 3), np.float32)
    store(tmp_path, "Bunker", "PreTonemapHDRColor", 7, ones[..., None] * [1, 2, 3], np.float16)
    store(tmp_path, "Bunker", "MotionVector", 7, ones[..., None] * [3, 5, 0], np.float16)
    store(tmp_path, "Bunker", "SceneDepth", 7, ones * 0.05)
    store(tmp_path, "Bunker", "Roughness", 7, ones[..., None] * [0.5, 0.5, 0.5], np.float16)
    normal = ones[..., None] * [0, 0, 1]
    normal[0, 0] = -1
    store(tmp_path, "Bunker", "WorldNormal", 7, normal, np.float16)
    store(tmp_path, "Bunker", "BackwardFlow", 7, ones[..., None] * [1, 2, 0.5])
    store(tmp_path, "Bunker", "SkyboxColor", 7, ones[..., None] * [4, 5, 6])
    sequence = open_sequence(tmp_path)
    frame = sequence.frame(7)
    same(frame.color[1, 1], [1, 2, 3])
    same(frame.motion[0, 0], [-3, 5])  # The previous frame's pixel: x - mv.x, y + mv.y with rows downwards.
    same(sequence.stored_motion(7)[0, 0], [3, 5])
    same(frame.gbuffer.depth[..., 0], [[np.inf, 500, 500], [500, 500, 500]], rtol=1e-6)
    same(frame.gbuffer.roughness, 0.5 * np.ones((2, 3, 1)))
    same(frame.gbuffer.sky[..., 0], [[1, 0, 0], [0, 0, 0]])
    same(frame.gbuffer.normal[0, :2], [[0, 0, 0], [0, 0, 1]])
    same(frame.gbuffer.sky_color[0, 0], [4, 5, 6])
    keyframe = sequence.keyframe(7)
    assert keyframe.forward_flow is None
    assert not sequence.forward_motion
    same(keyframe.backward_flow[0, 0], [1, 2, 50])  # Metres to centimetres.
    assert frame.gbuffer.albedo is None


def test_other_conventions(tmp_path):
    store(tmp_path, "A", "MotionVector", 1, np.ones((2, 4, 3)) * [0.5, 0.25, 0])
    assert UnrealSequence(tmp_path).convention == MotionConvention("current_minus_previous", "pixels", "up")
    same(open_sequence(tmp_path, motion="uv").frame(1).motion[0, 0], [-2, 0.5])
    (tmp_path / "jaxtrapolate.toml").write_text('[motion]\ny_axis = "down"\n')
    same(open_sequence(tmp_path).frame(1).motion[0, 0], [-0.5, -0.25])
    same(open_sequence(tmp_path, motion="uv").frame(1).motion[0, 0], [-2, -0.5])
    own = MotionConvention()
    same(open_sequence(tmp_path, motion=own).frame(1).motion[0, 0], [0.5, 0.25])


def test_frames_without_color_and_gaps_between_frames(tmp_path):
    for number in (1, 2, 4):
        frame, _ = example((2, 3), number)
        write_unreal_frame(tmp_path, "A", number, frame if number != 2 else Frame(None, frame.gbuffer, frame.motion))
    sequence = UnrealSequence(tmp_path)
    assert sequence.numbers == (1, 2, 4)
    assert sequence.frame(2).color is None
    assert sequence.frame(4).color is not None
    assert sequence.keyframe(1) is None
    with pytest.raises(InputError, match="no frame 3; there are 1 to 4"):
        sequence.frame(3)


def test_first_frame_without_motion_is_left_out(tmp_path):
    for number in range(3):
        frame, _ = example((2, 3), number)
        write_unreal_frame(tmp_path, "A", number, frame if number else Frame(frame.color, frame.gbuffer))
    sequence = UnrealSequence(tmp_path)
    assert sequence.numbers == (1, 2)
    assert sequence.notes == ("frame 0 left out: it has no motion vectors",)
    (tmp_path / "AMotionVector.0001.exr").unlink()
    (tmp_path / "AMotionVector.0002.exr").unlink()
    assert UnrealSequence(tmp_path).numbers == (0, 1, 2)


def test_nonfinite_pixels(tmp_path):
    frame, keyframe = example((4, 5))
    color, flow = frame.color.copy(), keyframe.forward_flow.copy()
    color[1, 2, 0], flow[0, 0] = np.nan, np.inf
    broken = Frame(color, frame.gbuffer, frame.motion)
    write_unreal_frame(tmp_path, "A", 1, broken, keyframe=Keyframe(forward_flow=flow))
    write_unreal_frame(tmp_path, "A", 2, frame)
    sequence = UnrealSequence(tmp_path)
    assert [sequence.nonfinite(n) for n in (1, 2)] == [1, 0]
    np.testing.assert_array_equal(np.argwhere(sequence.invalid(1)), [[1, 2]])
    assert sequence.invalid(2) is None
    read = sequence.frame(1)
    assert np.isfinite(read.color).all()
    assert np.isnan(read.motion[1, 2]).all()
    assert (read.gbuffer.position[1, 2] == LOST).all()
    assert np.isfinite(sequence.stored_motion(1)).all()
    assert np.isfinite(sequence.keyframe(1).forward_flow).all()
    sequence._masks.clear()  # The oldest masks are forgotten; they are found again.
    assert sequence.invalid(1).sum() == 1
    strict = open_sequence(tmp_path, strict=True)
    strict.frame(2)
    with pytest.raises(InputError, match="frame 1 has 1 non-finite pixels") as error:
        strict.frame(1)
    assert str(tmp_path) in str(error.value)


@pytest.mark.filterwarnings("error")
def test_largest_float_as_depth_of_the_sky(tmp_path):
    store(tmp_path, "A", "SceneDepth", 1, np.array([[1e-2, np.finfo(np.float32).max, np.inf]]))
    gbuffer = UnrealSequence(tmp_path).frame(1).gbuffer
    same(gbuffer.sky[..., 0], [[0, 1, 1]])
    same(gbuffer.depth[..., 0], [[100, np.inf, np.inf]], rtol=1e-6)


def test_frames_are_read_only(tmp_path):
    write_unreal_frame(tmp_path, "A", 1, example((2, 3))[0])
    with pytest.raises(ValueError, match="read-only"):
        UnrealSequence(tmp_path).frame(1).color[0, 0] = 0


def test_write_errors(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        write_unreal_frame(tmp_path / "file", "A", 1, Frame())
    with pytest.raises(ValueError, match=r"frame\.motion"):
        write_unreal_frame(tmp_path, "A", 1, Frame(motion=np.zeros((2, 2, 3), np.float32)))
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.skipif(DATA is None, reason="JAXTRAPOLATE_DATA is not set")
def test_real_dump():
    sequence = open_sequence(Path(DATA or "") / "czest1dm")
    assert (sequence.numbers, sequence.size) == (tuple(range(1, 13)), (180, 320))
    assert (sequence.hdr, sequence.depth, sequence.forward_motion, sequence.notes) == (True, "metric", True, ())
    frame, following = sequence.frame(6), sequence.frame(7)
    assert all(getattr(frame.gbuffer, name) is not None for name in CHANNELS if name != "sky_color")
    assert sequence.nonfinite(6) == 0
    keyframe = sequence.keyframe(6)
    np.testing.assert_array_equal(keyframe.backward_flow[..., :2], frame.motion)
    # Depth, its change and motion agree in units and direction: most pixels find their own depth in the next frame.
    rows, columns = np.mgrid[:180, :320]
    y = np.rint(rows + keyframe.forward_flow[..., 1]).astype(int).clip(0, 179)
    x = np.rint(columns + keyframe.forward_flow[..., 0]).astype(int).clip(0, 319)
    expected = frame.gbuffer.depth + keyframe.forward_flow[..., 2:]
    error = np.abs(following.gbuffer.depth[y, x] - expected) / expected
    assert np.median(error) < 2e-3
    # And positions too: a static surface stays where it is.
    moved = np.linalg.norm(following.gbuffer.position[y, x] - frame.gbuffer.position, axis=-1)
    assert np.median(moved[frame.gbuffer.stencil[..., 0] == 0]) < 5
