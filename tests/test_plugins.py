"""Methods of other packages, found by their entry points; and what the command line does where none is named."""

import json
import sys

import numpy as np
import pytest
from synthetic import make_frame

import jaxtrapolate as jx
from jaxtrapolate.commands.main import main
from jaxtrapolate.files import write_unreal_frame
from jaxtrapolate.methods import BEST_FIRST, method_description

SIZE = (32, 48)
CODE = '''
import jax.numpy as jnp
from jaxtrapolate import Method, Stage


def brighter():
    """The newest rendered frame, twice as bright."""

    def function(state, values):
        return {"image": 2 * jnp.asarray(values["history"][-1].color)}

    return Method("brighter", (Stage("brighten", function, ("history",), ("image",), reads=("history.color",)),))


def nothing():
    """No method at all."""
    return 5
'''


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package beside this one with three entry points, one of which leads nowhere."""
    folder = tmp_path / "site"
    about = folder / "brightening-1.0.dist-info"
    about.mkdir(parents=True)
    (folder / "brightening.py").write_text(CODE)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: brightening\nVersion: 1.0\n")
    points = "brighter = brightening:brighter\nnothing = brightening:nothing\nbroken = brightening:gone\n"
    (about / "entry_points.txt").write_text(f"[jaxtrapolate.methods]\n{points}warp = brightening:brighter\n")
    monkeypatch.syspath_prepend(folder)
    yield
    sys.modules.pop("brightening", None)


@pytest.fixture(scope="module")
def dump(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plugins") / "wall"
    for time in range(4):
        write_unreal_frame(folder, "Wall", time, make_frame(time, SIZE))
    return folder


def test_a_method_of_another_package(package, capsys, dump, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert jx.method_names()[-3:] == ("brighter", "broken", "nothing")
    assert method_description("brighter") == "The newest rendered frame, twice as bright."
    assert [s.name for s in jx.load("warp").stages] != ["brighten"]  # no package replaces one of this library
    frame = make_frame(0, SIZE)
    image = jx.load("brighter")((frame,), jx.replace(frame, color=None))
    np.testing.assert_array_equal(image, 2 * frame.color)
    arguments = [
        "evaluate",
        str(dump),
        "--methods",
        "repeat,brighter",
        "--pictures",
        "0",
        "--output",
        str(tmp_path / "o"),
    ]
    assert main(arguments) == 0
    results = json.loads((tmp_path / "o" / "results.json").read_text())
    assert results["methods"]["brighter"]["psnr"] < results["methods"]["repeat"]["psnr"]
    assert "brighter" in (tmp_path / "o" / "report.html").read_text()
    capsys.readouterr()
    assert main(["methods"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "brighter" in out
    assert "twice as bright" in out


def test_methods_that_other_packages_do_not_have(package, capsys, dump, tmp_path):
    with pytest.raises(ValueError, match="'broken' of the package brightening cannot be imported"):
        jx.load("broken")
    with pytest.raises(ValueError, match="to return a Method, got int"):
        jx.load("nothing")
    with pytest.raises(ValueError, match=r"expected one of repeat, .*, got 'dim'"):
        jx.load("dim")
    assert main(["evaluate", str(dump), "--methods", "broken", "--output", str(tmp_path / "o")]) == 2
    assert "cannot be imported" in capsys.readouterr().err


def test_a_methods_stages_are_listed(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["methods", "guided_warp"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    for text in (
        "guided_warp: The demodulated frame fetched",
        "hindsight",
        "left out without",
        "modulate",
        "target.motion",
        "plain_share?",
    ):
        assert text in out
    assert main(["methods", "guided"]) == 2
    assert "no method 'guided'; there are repeat" in capsys.readouterr().err


def test_every_method_is_described():
    for name in jx.method_names():
        assert method_description(name).endswith((".", ":"))
    assert set(BEST_FIRST) <= set(jx.method_names())


def test_the_best_method_that_can_is_taken(capsys, tmp_path, monkeypatch):
    """Nothing is rendered after the last frame, and there is nothing to guide a warp by."""
    from jaxtrapolate.commands import generate

    monkeypatch.setattr(generate, "BEST_FIRST", ("bidirectional", "guided_warp", "warp", "repeat"))
    folder = tmp_path / "half"
    for time in range(4):
        frame = make_frame(time, SIZE)
        frame = jx.Frame(frame.color if time % 2 == 0 else None, motion=frame.motion)
        write_unreal_frame(folder, "A", time, frame)
    assert main(["generate", str(folder), "--output", str(tmp_path / "o")]) == 0
    assert "2 frames generated with warp" in capsys.readouterr().err
    monkeypatch.setattr(generate, "BEST_FIRST", ("bidirectional", "guided_warp"))
    assert main(["generate", str(folder), "--output", str(tmp_path / "p")]) == 2
    assert "no method can run: bidirectional: no rendered frame follows" in capsys.readouterr().err
