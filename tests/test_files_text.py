"""TOML and JSON files that no parser is fond of, for settings of frames and of training."""

import json
import os

import pytest

from jaxtrapolate.errors import InputError
from jaxtrapolate.files import open_sequence
from jaxtrapolate.files.description import read_settings
from jaxtrapolate.files.text import read_json, read_toml
from jaxtrapolate.training.config import load_config

BAD = {
    "arrays": ("a = " + "[" * 100_000, "nested too deeply"),
    "closed arrays": ("a = " + "[" * 200 + "]" * 200, "nested too deeply"),
    "tables": ("a = " + "{b=" * 20_000 + "1" + "}" * 20_000, "nested too deeply"),
    "keys": (".".join("a" * 100_000) + " = 1", "nested too deeply"),
    "quoted keys": (" . ".join(['"a"'] * 100) + " = 1", "nested too deeply"),
    "decimal": ("hdr = " + "9" * 5000, "not valid TOML"),
    "short decimal": ("hdr = " + "9" * 400, "1329 bits, more than 64"),
    "hexadecimal": ("hdr = 0x" + "f" * 9000, "36000 bits, more than 64"),
    "bytes": (b"name = '\xff'", "not valid TOML"),
    "large": ("#" * (1 << 20) + "#", "more than 1048576 bytes"),
}


@pytest.mark.parametrize("case", sorted(BAD))
@pytest.mark.parametrize("read", [read_toml, read_settings, load_config, open_sequence])
def test_toml(tmp_path, case, read):
    content, text = BAD[case]
    path = tmp_path / "a.toml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=text) as error:
        read(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 2200


def test_what_is_no_excess_is_read(tmp_path):
    path = tmp_path / "a.toml"
    words = "a-b.c_d" * 5000  # long, but one text
    path.write_text(f'\ufeffx = "{words}"\ny = [{"[" * 60}{"]" * 60}]\nz = {2**63 - 1}\n', encoding="utf-8")
    table = read_toml(path)
    assert table["x"] == words
    assert table["z"] == 2**63 - 1


@pytest.mark.parametrize(
    "line, text",
    [
        ('color = "{frame:099999999999d}.png"', "at most 15 digits"),
        ('color = "{frame:0' + "9" * 5000 + 'd}.png"', "at most 15 digits"),
        ('color = { file = "{frame}.png", scale = 1e300 }', "32 bits"),
        ('color = { file = "{frame}.png", offset = nan }', "32 bits"),
        ('color = { file = "{frame}.png", above = inf }', "32 bits"),
    ],
)
def test_numbers_of_a_buffer(tmp_path, line, text):
    path = tmp_path / "jaxtrapolate.toml"
    path.write_text(f"[buffers]\n{line}\n")
    with pytest.raises(InputError, match=text):
        read_settings(path)


def test_a_number_of_a_frame_that_no_frame_has(tmp_path):
    (tmp_path / "color").mkdir()
    name = "9" * 200
    for path in (tmp_path / "color" / f"{name}.png", tmp_path / f"{name}.png", tmp_path / f"AMotionVector.{name}.exr"):
        path.write_bytes(b"")
    with pytest.raises(InputError, match="a frame's number of 200 digits"):
        open_sequence(tmp_path)
    os.unlink(tmp_path / f"AMotionVector.{name}.exr")
    with pytest.raises(InputError, match="a frame's number of 200 digits"):
        open_sequence(tmp_path)
    (tmp_path / "jaxtrapolate.toml").write_text('[buffers]\ncolor = "{frame}.png"\n')
    with pytest.raises(InputError, match="a frame's number of 200 digits"):
        open_sequence(tmp_path)


@pytest.mark.parametrize(
    "content, text",
    [
        ("[" * 100_000, "nested too deeply"),
        ("[" * 99 + "]" * 99, "nested"),
        ("9" * 5000, "JSON"),
        ("{", "not valid JSON"),
    ],
)
def test_json(tmp_path, content, text):
    path = tmp_path / "a.json"
    path.write_text(content)
    with pytest.raises(InputError, match=text) as error:
        read_json(path)
    assert "\n" not in str(error.value)
    path.write_text(json.dumps({"a": [1, 2.5, None]}))
    assert read_json(path) == {"a": [1, 2.5, None]}
