"""Jitter from files: whatever convention states it, and what is lost where it is not stated."""

import numpy as np
import pytest

import jaxtrapolate as jx
from jaxtrapolate.commands.inputs import named_inputs
from jaxtrapolate.commands.main import main
from jaxtrapolate.errors import InputError
from jaxtrapolate.files import open_sequence, write_unreal_frame
from jaxtrapolate.scenes.sequence import jitter_of

SIZE = (32, 48)
COUNT = 8


def sampled(number):
    """A pattern that moves by (1.5, -0.5) pixels a frame, sampled at p + jitter."""
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]].astype(np.float64)
    j = jitter_of(number)
    u, v = x + j[0] - 1.5 * number, y + j[1] + 0.5 * number
    color = 1 + 0.4 * np.stack([np.sin(0.9 * u + 0.4 * v), np.cos(0.8 * u), np.sin(0.7 * v + 1)], -1)
    return jx.Frame(color.astype(np.float32), motion=np.broadcast_to(np.float32([-1.5, 0.5]), (*SIZE, 2)))


@pytest.fixture
def dump(tmp_path):
    folder = tmp_path / "dump"
    for number in range(COUNT):
        write_unreal_frame(folder, "A", number, sampled(number), half=False)
    return folder


def described(folder, toml, lines):
    (folder / "jitter.csv").write_text("\n".join(lines))
    (folder / "jaxtrapolate.toml").write_text(toml)


@pytest.mark.parametrize(
    "stated, factor, separator",
    [
        ("", (1, 1), ", "),
        ('units = "uv"\ny_axis = "up"', (1 / SIZE[1], -1 / SIZE[0]), " "),
        ('units = "ndc"\nshifts = "image"', (-2 / SIZE[1], -2 / SIZE[0]), ";"),
    ],
)
def test_the_same_jitter_in_any_convention(dump, stated, factor, separator):
    lines = [separator.join(map(repr, [n, *map(float, jitter_of(n) * factor)])) for n in range(COUNT + 2)]
    described(dump, f'[jitter]\nfile = "jitter.csv"\n{stated}\n', ["frame,x,y", "# the camera's", "", *lines])
    sequence = open_sequence(dump)
    for number in sequence.numbers:
        found = sequence.frame(number).jitter
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, jitter_of(number), atol=1e-6)


@pytest.mark.slow
def test_what_jitter_is_worth(dump, capsys):
    """The pattern is the same but for where it is sampled, which a warp only knows by the file."""
    unaware, plain = jx.evaluate(dump, ["warp"]).methods["warp"].psnr, open_sequence(dump)
    lines = [f"{n} {x} {y}" for n, (x, y) in enumerate(map(jitter_of, range(COUNT)))]
    described(dump, '[jitter]\nfile = "jitter.csv"\n', lines)
    assert jx.evaluate(dump, ["warp"]).methods["warp"].psnr > unaware + 3
    assert plain.frame(1).jitter is None
    known = open_sequence(dump).identity()
    assert known != plain.identity()
    (dump / "jitter.csv").write_text("\n".join(f"{n} 0.25 0" for n in range(COUNT)))
    assert open_sequence(dump).identity() != known
    assert main(["check", str(dump)]) == 0
    assert "jitter: 0 to 0.25 pixels, in 8 of 8 frames read" in capsys.readouterr().out


@pytest.mark.parametrize(
    "toml, lines, message",
    [
        ('file = "j"', None, "j: "),
        ('units = "pixels"', (), "jitter: no file; add one"),
        ('file = "jitter.csv"\nunits = "metres"', (), "jitter.units: expected one of pixels, uv, ndc"),
        ('file = "jitter.csv"', ("0 0 0", "1 0"), "line 2: expected a frame's number, x and y, got '1 0'"),
        ('file = "jitter.csv"', ("0 0 0", "1 nan 0"), "line 2: expected"),
        ('file = "jitter.csv"', ("0 0 0", "0.5 0 0"), "line 2: expected"),
        ('file = "jitter.csv"', ("0 0 0", "0 0 0"), "line 2: frame 0 again"),
        ('file = "jitter.csv"', ("0 0 0",), "has no line for frame 1; add it"),
    ],
)
def test_files_that_cannot_be_used(dump, toml, lines, message):
    described(dump, f"[jitter]\n{toml}\n", lines or ())
    with pytest.raises(InputError, match=message):
        open_sequence(dump)


@pytest.mark.slow
def test_embedded_scenes_on_the_command_line(tmp_path, capsys):
    (given,) = named_inputs(["scenes:walkers"], size="32x18", length=3, scale=2, jitter=True)
    sequence = given.open()
    assert sequence.scale == 2
    np.testing.assert_array_equal(sequence.frame(2).jitter, jitter_of(2))
    assert named_inputs(["scenes:walkers"], size="32x18")[0].open().frame(2).jitter is None
    output = ["--output", str(tmp_path / "o")]
    assert main(["evaluate", "scenes:walkers", "--scale", "0", *output]) == 2
    assert "--scale: expected a number from 1 to 8, got 0" in capsys.readouterr().err
    assert main(["evaluate", str(tmp_path), "--jitter", *output]) == 2
    assert "--jitter: are for embedded scenes" in capsys.readouterr().err
