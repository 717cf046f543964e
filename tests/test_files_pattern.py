"""Files by pattern: the example of the documentation, every key, and every mistake in the TOML file."""

import re

import numpy as np
import pytest
from PIL import Image

from jaxtrapolate.files import (
    InputError,
    MotionConvention,
    PatternSequence,
    description,
    open_sequence,
    pattern,
    write_exr,
)
from jaxtrapolate.files.image import decode_srgb

SIZE = (4, 6)


def planes(seed, *names):
    rng = np.random.default_rng(seed)
    return {name: rng.random(SIZE).astype(np.float16).astype(np.float32) for name in names}


def png(path, codes):
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(codes).save(path)


def courtyard(folder, numbers=(1, 2)):
    """The files of the example in the documentation."""
    names = ("Depth.Z", "Normal.X", "Normal.Y", "Normal.Z", "Vector.X", "Vector.Y", "Vector.Z", "Vector.W")
    for number in numbers:
        multi = planes(number, *(f"ViewLayer.{name}" for name in names))
        multi["ViewLayer.Depth.Z"][0, 0] = 1e10
        write_exr(folder / f"beauty.{number:04d}.exr", np.stack(list(planes(number, "R", "G", "B").values()), -1))
        write_exr(folder / f"multi.{number:04d}.exr", multi, half=False)
        codes = np.random.default_rng(number).integers(0, 256, (*SIZE, 3), np.uint8)
        png(folder / "albedo" / f"{number}.png", codes)
        png(folder / "mask" / f"{number:04d}.png", codes[..., 0] % 3)
        png(folder / "light" / f"{number:04d}.png", codes[..., 1])
    (folder / "jitter.csv").write_text("1, 0.25, -0.125\n2, -0.5, 0.375\n")
    return multi, codes


def documented_example():
    lines = (description.__doc__ or "").split("\n\n    name = ")[1].split("\n\nA buffer is")[0]
    return re.sub(r"^    ", "", "    name = " + lines, flags=re.MULTILINE)


def test_the_documented_example(tmp_path):
    multi, codes = courtyard(tmp_path)
    (tmp_path / "jaxtrapolate.toml").write_text(documented_example())
    sequence = open_sequence(tmp_path)
    assert isinstance(sequence, PatternSequence)
    assert (sequence.name, sequence.numbers, sequence.size) == ("courtyard", (1, 2), SIZE)
    assert (sequence.hdr, sequence.depth) == (True, "metric")
    assert sequence.convention == MotionConvention("current_minus_previous", "pixels", "up")
    frame = sequence.frame(2)
    gbuffer = frame.gbuffer
    np.testing.assert_array_equal(frame.color, np.stack(list(planes(2, "R", "G", "B").values()), -1))
    expected = np.where(multi["ViewLayer.Depth.Z"] > 1e9, np.inf, multi["ViewLayer.Depth.Z"] * 0.01)
    np.testing.assert_allclose(gbuffer.depth[..., 0], expected, rtol=1e-6)
    np.testing.assert_array_equal(gbuffer.sky[..., 0], multi["ViewLayer.Depth.Z"] > 1e9)
    np.testing.assert_array_equal(gbuffer.normal[..., 2], multi["ViewLayer.Normal.Z"])
    np.testing.assert_array_equal(frame.motion[..., 0], -multi["ViewLayer.Vector.X"])
    np.testing.assert_array_equal(frame.motion[..., 1], multi["ViewLayer.Vector.Y"])
    np.testing.assert_array_equal(gbuffer.albedo, decode_srgb(codes))
    np.testing.assert_array_equal(gbuffer.stencil[..., 0], codes[..., 0] % 3)
    assert sequence.static_ids == (7, "9e3779b1")
    np.testing.assert_array_equal(frame.jitter, np.float32([-0.5, 0.375]))
    np.testing.assert_allclose(gbuffer.shadow[..., 0], 1 - codes[..., 1] / 255, atol=1e-6)
    assert open_sequence(tmp_path / "jaxtrapolate.toml").numbers == (1, 2)
    assert str(open_sequence(tmp_path, motion="ndc").convention) == "current_minus_previous,ndc,up"


def test_a_file_with_many_layers_is_read_once(tmp_path, monkeypatch):
    courtyard(tmp_path)
    (tmp_path / "jaxtrapolate.toml").write_text(documented_example())
    sequence, read = open_sequence(tmp_path), []
    real = pattern.read_exr
    monkeypatch.setattr(pattern, "read_exr", lambda path: read.append(path.name) or real(path))
    sequence.frame(1)
    sequence.stored_motion(1)
    assert sorted(read) == ["beauty.0001.exr", "multi.0001.exr"]


def test_png_only_with_flows_and_options(tmp_path):
    codes = np.random.default_rng(0).integers(0, 256, (*SIZE, 4), np.uint8)
    png(tmp_path / "c_7.png", codes[..., :3])
    png(tmp_path / "n_7.png", codes)
    write_exr(tmp_path / "f_7.exr", np.ones((*SIZE, 3)) * [1, 2, 3])
    toml = tmp_path / "other.toml"
    toml.write_text(
        'depth = "ordinal"\n[buffers]\ncolor = "c_{frame}.png"\n'
        'normal = { file = "n_{frame}.png", scale = 2, offset = -1 }\n'
        'depth = { file = "n_{frame}.png", channels = "A", invert = true }\n'
        'forward_flow = "f_{frame}.exr"\n'
    )
    sequence = open_sequence(tmp_path, settings=toml)
    assert (sequence.hdr, sequence.depth, sequence.numbers) == (False, "ordinal", (7,))
    frame = sequence.frame(7)
    np.testing.assert_array_equal(frame.color, decode_srgb(codes[..., :3]))
    np.testing.assert_allclose(frame.gbuffer.normal, codes[..., :3] / 127.5 - 1, atol=1e-6)
    np.testing.assert_allclose(frame.gbuffer.depth[..., 0], 1 - codes[..., 3] / 255 + 1 / 256, atol=1e-6)
    assert frame.gbuffer.depth.min() > 0
    np.testing.assert_array_equal(sequence.keyframe(7).forward_flow[0, 0], [1, 2, 3])


@pytest.mark.parametrize(
    "text, message",
    [
        ("[buffers", "not valid TOML"),
        ("colour = 1", "unknown key 'colour'"),
        ("hdr = 1", "hdr: expected true or false, got 1"),
        ('depth = "inverse"', "depth: expected one of metric, ordinal"),
        ('[motion]\nunits = "metres"', "motion.units: expected one of pixels, uv, ndc"),
        ("motion = 3", "motion: expected a table"),
        ('[buffers]\nbeauty = "a.{frame}.exr"', "unknown key 'buffers.beauty'"),
        ('[buffers]\ncolor = "a.exr"', "buffers.color.file: expected a path with one"),
        ('[buffers]\ncolor = "{frame}/a.exr"', "buffers.color.file: expected a path with one"),
        ("[buffers]\ncolor = 1", "buffers.color: expected a pattern or a table"),
        ('[buffers]\ncolor = { layer = "x" }', "buffers.color: no file"),
        ('[buffers]\ndepth = { file = "{frame}.exr", scale = "1" }', "buffers.depth.scale: expected a number"),
        ('[buffers]\ndepth = { file = "{frame}.exr", scale = true }', "buffers.depth.scale: expected a number"),
        ('[buffers]\ndepth = { file = "{frame}.exr", channels = [1] }', "buffers.depth.channels: expected a list"),
        ('[buffers]\nmotion = { file = "{frame}.exr", channels = "X" }', "buffers.motion.channels: expected 2, got 1"),
        ('[buffers]\ncolor = "none.{frame}.exr"', "no file for color, none.{frame}.exr"),
        (
            '[buffers]\ncolor = ".\\beauty.{frame}.exr"',
            "buffers.color.file: expected forward slashes, or single quotes",
        ),
        ('[buffers]\ncolor = ".\\depth.{frame}.exr"', "write paths with forward slashes, or single quotes around it"),
        ('[buffers]\ncolor = "C:\\Users\\{frame}.exr"', "write paths with forward slashes, or single quotes around it"),
        ("step = 0", "step: expected a whole number, 1 or more, got 0"),
        ("static_ids = 7", "static_ids: expected a list of ids"),
        ('static_ids = ["wall"]', "static_ids: expected eight hexadecimal digits in each text, not 'wall'"),
        (
            '[buffers]\ndepth = { file = "{frame}.exr", above = 9 }',
            "where depth above a number is nothing, write nothing_",
        ),
        (
            '[buffers]\nsky = { file = "{frame}.exr", nothing_below = 9 }',
            "for a mask of what is below a number, write below",
        ),
        ('[buffers]\ncolor = "no/{frame}.exr"', "does not exist"),
    ],
)
def test_mistakes(tmp_path, text, message):
    path = tmp_path / "jaxtrapolate.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(message)) as error:
        open_sequence(tmp_path)
    assert "\n" not in str(error.value)
    assert str(tmp_path) in str(error.value)


def test_settings_without_buffers_or_missing(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        PatternSequence(tmp_path)
    (tmp_path / "jaxtrapolate.toml").write_text('name = "a"')
    with pytest.raises(InputError, match="names no buffers"):
        PatternSequence(tmp_path)
    (tmp_path / "jaxtrapolate.toml").write_text("hdr = true")
    with pytest.raises(InputError, match=r"hdr is for files that \[buffers\] describes"):
        PatternSequence(tmp_path)


@pytest.mark.parametrize(
    "buffer, toml, message",
    [
        ("normal", '"a.{frame}.png"', 'normal needs 3 channels, has Y; in .*toml, name 3 of them, .* channels = "YYY"'),
        (
            "color",
            '{ file = "a.{frame}.png", channels = ["Depth", "G", "B"] }',
            r"color needs 3 channels \(Depth, G, B\), has Y; in",
        ),
    ],
)
def test_channels_that_are_not_there(tmp_path, buffer, toml, message):
    png(tmp_path / "a.1.png", np.zeros(SIZE, np.uint8))
    (tmp_path / "jaxtrapolate.toml").write_text(f"[buffers]\n{buffer} = {toml}\n")
    with pytest.raises(InputError, match=message) as error:
        open_sequence(tmp_path).frame(1)
    assert str(tmp_path / "a.1.png") in str(error.value)


@pytest.mark.parametrize("channels", ["", ', channels = "YYY"'])
@pytest.mark.parametrize("suffix", ["png", "exr"])
def test_grey_is_a_colour(tmp_path, channels, suffix):
    codes = np.random.default_rng(0).integers(0, 256, SIZE, np.uint8)
    path = tmp_path / f"a.1.{suffix}"
    png(path, codes) if suffix == "png" else write_exr(path, codes.astype(np.float32))
    (tmp_path / "jaxtrapolate.toml").write_text(
        f'[buffers]\ncolor = {{ file = "a.{{frame}}.{suffix}"{channels} }}\nalbedo = "a.{{frame}}.{suffix}"\n'
    )
    sequence = open_sequence(tmp_path)
    frame = sequence.frame(1)
    for k in range(3):
        expected = decode_srgb(codes) if suffix == "png" else codes
        np.testing.assert_array_equal(frame.color[..., k], expected)
        np.testing.assert_allclose(frame.gbuffer.albedo[..., k], codes / (255 if suffix == "png" else 1), rtol=1e-6)
    notes = ["color has one channel and is taken for grey"] * (not channels)
    assert list(sequence.notes) == [*notes, "albedo has one channel and is taken for grey"]


def test_layer_that_is_not_there(tmp_path):
    courtyard(tmp_path)
    (tmp_path / "jaxtrapolate.toml").write_text('[buffers]\ndepth = { file = "multi.{frame}.exr", layer = "Mist" }\n')
    with pytest.raises(InputError, match=r"multi\.0001\.exr: needs 1 channel in layer 'Mist', has .*ViewLayer"):
        open_sequence(tmp_path).frame(1)


def test_a_byte_order_mark(tmp_path):
    write_exr(tmp_path / "1.exr", np.ones((*SIZE, 3)))
    path = tmp_path / "jaxtrapolate.toml"
    path.write_bytes(b'\xef\xbb\xbf[buffers]\ncolor = "{frame}.exr"\n')
    assert open_sequence(tmp_path).numbers == (1,)
    path.write_bytes('[buffers]\ncolor = "{frame}.exr"\n'.encode("utf-16"))
    with pytest.raises(InputError, match="it is no UTF-8 text; save it as UTF-8"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("path", [r"'sub\b.{frame}.exr'", r"'.\sub\b.{frame}.exr'", r'"sub\\b.{frame}.exr"'])
def test_what_is_to_be_written_for_a_backslash(tmp_path, path):
    """Single quotes, and two of them in double quotes, are read as forward slashes."""
    (tmp_path / "sub").mkdir()
    write_exr(tmp_path / "sub" / "b.1.exr", np.ones((*SIZE, 3)))
    (tmp_path / "jaxtrapolate.toml").write_text(f"[buffers]\ncolor = {path}\n")
    assert (open_sequence(tmp_path).frame(1).color == 1).all()
