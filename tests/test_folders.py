"""Bare folders of the kinds that people have, from `check` to the table of `evaluate`, against the exact frames."""

import json

import cv2
import numpy as np
import OpenEXR
import pytest
from synthetic import make_frame

import jaxtrapolate as jx
from jaxtrapolate.commands.main import main
from jaxtrapolate.files import write_unreal_frame

SIZE = (32, 48)
METHODS = "repeat,warp,occlusion_warp,guided_warp"
SKY = (slice(0, 8), slice(None))  # rows in which nothing was hit, in the tests of depth


def run(capsys, *arguments):
    code = main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    assert code == 0, err
    return " ".join(out.split()), err


def table(capsys, folder, output, methods=METHODS):
    """dB and notes of `evaluate`."""
    run(capsys, "evaluate", folder, "--methods", methods, "--pictures", 0, "--output", output)
    results = json.loads((output / "results.json").read_text())
    scores = {n: [f["psnr"] for f in m["frames"]] for n, m in results["methods"].items()}
    return scores, results


def exr(path, window=None, **channels):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if window is not None:
        header |= {"displayWindow": ((0, 0), (SIZE[1] - 1, SIZE[0] - 1)), "dataWindow": window}
    OpenEXR.File(header, {k: np.ascontiguousarray(v) for k, v in channels.items()}).write(str(path))


def rgb(image):
    return dict(zip("RGB", np.moveaxis(np.asarray(image, np.float32), -1, 0), strict=True))


def folder_of(tmp_path, text, times, write):
    """A folder with a description and, for each time, what `write(folder, frame, time)` makes."""
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "jaxtrapolate.toml").write_text(text)
    for time in times:
        write(folder, make_frame(time, SIZE), time)
    return folder


@pytest.fixture(scope="module")
def exact(tmp_path_factory):
    """The same frames as a dump in 32-bit floats, numbered 0 to 5: what the table should say."""
    folder = tmp_path_factory.mktemp("exact") / "dump"
    for time in range(6):
        frame = make_frame(time, SIZE)
        buffers = jx.GBuffer(stencil=frame.gbuffer.stencil, normal=frame.gbuffer.normal, albedo=frame.gbuffer.albedo)
        frame = jx.replace(frame, gbuffer=buffers)
        write_unreal_frame(folder, "A", time, frame, half=False)
    return folder


LAYERS = """
[buffers]
color = "{frame}.exr"
motion = { file = "{frame}.exr", layer = "motion" }
normal = { file = "{frame}.exr", layer = "normal" }
albedo = { file = "{frame}.exr", layer = "albedo" }
stencil = { file = "{frame}.exr", layer = "id" }
"""


def layers(frame, ids):
    g = frame.gbuffer
    named = {f"motion.{c}": frame.motion[..., k] for k, c in enumerate("XY")}
    named |= {f"normal.{c}": g.normal[..., k] for k, c in enumerate("XYZ")}
    named |= {f"albedo.{c}": g.albedo[..., k] for k, c in enumerate("RGB")}
    return rgb(frame.color) | named | {"id.Y": ids}


@pytest.mark.slow
def test_hashes_of_32_bits_as_ids(capsys, exact, tmp_path):
    """float32 takes both ids for one; as they are the box would have no holes around it."""

    def write(folder, frame, time):
        ids = np.where(frame.gbuffer.stencil[..., 0] > 0, np.uint32(0x9E3779B1), np.uint32(0x9E3779B9))
        exr(folder / f"{time}.exr", **layers(frame, ids))

    folder = folder_of(tmp_path, "static_ids = [0x9E3779B9]\n" + LAYERS, range(6), write)
    out, _ = run(capsys, "check", folder)
    assert "1 ids are hashes" in out
    scores, _ = table(capsys, folder, tmp_path / "out")
    expected, _ = table(capsys, exact, tmp_path / "exact")
    for name, values in expected.items():
        np.testing.assert_allclose(scores[name], values, atol=2e-3, err_msg=name)


@pytest.mark.slow
def test_negative_numbers(capsys, exact, tmp_path):
    def write(folder, frame, time):
        exr(folder / f"{time - 3}.exr", **layers(frame, frame.gbuffer.stencil[..., 0]))

    folder = folder_of(tmp_path, LAYERS, range(6), write)
    assert "6 frames (-3" in run(capsys, "check", folder)[0]
    scores, results = table(capsys, folder, tmp_path / "out")
    assert results["frames"] == [0, 2]
    expected, _ = table(capsys, exact, tmp_path / "exact")
    for name, values in expected.items():
        np.testing.assert_allclose(scores[name], values, atol=2e-3, err_msg=name)


@pytest.mark.slow
def test_a_step_of_two(capsys, exact, tmp_path):
    def write(folder, frame, time):
        exr(folder / f"{2 * time}.exr", **layers(frame, frame.gbuffer.stencil[..., 0]))

    folder = folder_of(tmp_path, LAYERS, range(6), write)
    out, _ = run(capsys, "check", folder)
    assert "step 2 found" in out
    assert "gap" not in out
    scores, results = table(capsys, folder, tmp_path / "out")
    assert results["frames"] == [6, 10]
    expected, _ = table(capsys, exact, tmp_path / "exact")
    for name, values in expected.items():
        np.testing.assert_allclose(scores[name], values, atol=2e-3, err_msg=name)


DEPTH = """
[buffers]
color = "{frame}.exr"
motion = { file = "{frame}.exr", layer = "motion" }
depth = { file = "{frame}.exr", layer = "depth" }
stencil = { file = "{frame}.exr", layer = "id" }
"""


def cropped(time):
    """Frames whose first rows show nothing: no surface, black, still."""
    frame = make_frame(time, SIZE)
    color, motion = frame.color.copy(), frame.motion.copy()
    depth, ids = frame.gbuffer.depth.copy(), frame.gbuffer.stencil.copy()
    color[SKY], motion[SKY], depth[SKY], ids[SKY] = 0, 0, np.inf, 0
    sky = np.isinf(depth).astype(np.float32)
    return jx.Frame(color, jx.GBuffer(depth=depth, stencil=ids, sky=sky), motion, time=float(time))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["a data window", "depth 0", "depth -1"])
def test_cropped_and_empty_depth(capsys, tmp_path, kind):
    """What lies outside of an EXR's data window, and depth of 0 or -1, is far: as where a dump says so itself."""

    def write(folder, _, time):
        frame = cropped(time)
        depth = np.where(np.isinf(frame.gbuffer.depth), -1 if kind == "depth -1" else 0, frame.gbuffer.depth)[..., 0]
        named = {f"motion.{c}": frame.motion[..., k] for k, c in enumerate("XY")}
        planes = rgb(frame.color) | named | {"depth.Z": depth.astype(np.float32), "id.Y": frame.gbuffer.stencil[..., 0]}
        if kind == "a data window":
            window = ((0, 8), (SIZE[1] - 1, SIZE[0] - 1))
            exr(folder / f"{time}.exr", window, **{name: plane[8:] for name, plane in planes.items()})
        else:
            exr(folder / f"{time}.exr", **planes)

    folder = folder_of(tmp_path, DEPTH, range(6), write)
    out, _ = run(capsys, "check", folder)
    assert f"no depth: {6 * 8 * SIZE[1]} pixels (25.0%) in 6 of 6 frames read" in out
    methods = "warp,occlusion_warp,bidirectional,bidirectional_image,softmax_splat,warp_3d"
    scores, _ = table(capsys, folder, tmp_path / "out", methods)
    dump = tmp_path / "dump"
    for time in range(6):
        write_unreal_frame(dump, "A", time, cropped(time), unit=100.0, half=False)
    expected, _ = table(capsys, dump, tmp_path / "exact", methods)
    for name, values in expected.items():
        np.testing.assert_allclose(scores[name], values, atol=0.02, err_msg=name)


def srgb_codes(color, dtype):
    """By the definition, IEC 61966-2-1."""
    linear = np.clip(color, 0, 1).astype(np.float64)
    code = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(code * np.iinfo(dtype).max).astype(dtype)


def warped_by_opencv(color, motion):
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    at = np.stack([x, y], -1) + motion
    return cv2.remap(color, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def decibels(image, truth, valid=None):
    """PSNR in sRGB, by the definition."""
    apart = srgb_codes(image, np.uint16) / 65535 - srgb_codes(truth, np.uint16) / 65535
    apart = apart if valid is None else apart[valid]
    return -10 * np.log10(np.mean(apart**2))


def test_pictures_of_16_bits_with_kitti_flow(capsys, tmp_path):
    def write(folder, frame, time):
        cv2.imwrite(str(folder / f"c{time:06d}_10.png"), srgb_codes(frame.color, np.uint16)[..., ::-1])
        flow = np.round(frame.motion * 64 + 2**15).astype(np.uint16)
        valid = np.ones((*SIZE, 1), np.uint16)
        cv2.imwrite(str(folder / f"f{time:06d}_10.png"), np.concatenate([flow, valid], -1)[..., ::-1])

    text = """
[buffers]
color = "c{frame:06d}_10.png"
motion = { file = "f{frame:06d}_10.png", codes = true, scale = 0.015625, offset = -512, valid = "B" }
"""
    folder = folder_of(tmp_path, text, range(6), write)
    out, _ = run(capsys, "check", folder)
    assert "previous_minus_current,pixels,down, as in use" in out
    assert "-2 .. 1.5" in out  # not -2.016
    scores, _ = table(capsys, folder, tmp_path / "out", "repeat,warp")
    frames = [make_frame(time, SIZE) for time in range(6)]
    for k, time in enumerate((1, 3, 5)):
        before, frame = frames[time - 1].color, frames[time]
        assert scores["repeat"][k] == pytest.approx(decibels(before, frame.color), abs=0.01)
        assert scores["warp"][k] == pytest.approx(
            decibels(warped_by_opencv(before, frame.motion), frame.color), abs=0.02
        )


def test_pictures_with_alpha(capsys, tmp_path):
    """What stands under alpha 0 is neither shown nor scored, and is said."""
    corner = np.zeros(SIZE, bool)
    corner[-6:, -10:] = True

    def write(folder, frame, time):
        codes = srgb_codes(frame.color, np.uint8)
        codes[corner] = 255 if time % 2 else 0  # what no one should see
        alpha = np.where(corner, 0, 255).astype(np.uint8)[..., None]
        cv2.imwrite(str(folder / f"{time}.png"), np.concatenate([codes[..., ::-1], alpha], -1))

    folder = folder_of(tmp_path, '[buffers]\ncolor = "{frame}.png"\n', range(4), write)
    out, _ = run(capsys, "check", folder)
    assert "alpha" in out
    scores, results = table(capsys, folder, tmp_path / "out", "repeat")
    for k, time in enumerate((1, 3)):
        before, truth = make_frame(time - 1, SIZE).color, make_frame(time, SIZE).color
        assert scores["repeat"][k] == pytest.approx(decibels(before, truth, ~corner), abs=0.05)
    assert any("alpha" in note for note in results["notes"])
