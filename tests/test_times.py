"""Times of methods: measured on request, kept with the machine and size, and shown with both."""

import json
import time

import pytest
from synthetic import SyntheticSequence

import jaxtrapolate as jx
from jaxtrapolate.commands.main import main
from jaxtrapolate.evaluation.times import MethodTimes, keep_times, kept_times, measure_methods
from jaxtrapolate.methods import Method, Stage
from jaxtrapolate.results import RunTime


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "jaxtrapolate" / "method_times.json"


def asleep(seconds):
    """A method that takes a known time."""

    def function(state, values):
        time.sleep(seconds)
        return {"image": values["history"][-1].color}

    return Method("asleep", (Stage("sleep", function, ("history",), ("image",), host=True),))


def test_what_is_measured():
    take = lambda state, values: {"image": values["history"][0].color}  # noqa: E731
    lacking = Method("lacking", (Stage("take", take, ("history",), ("image",), reads=("target.sky",)),))
    methods = {"asleep": asleep(0.03), "guided": jx.load("warp"), "lacking": lacking}
    times = measure_methods(SyntheticSequence(range(8)), methods)
    assert set(times.ms) == {"asleep", "guided"}
    assert 30 <= times.ms["asleep"].median < 300
    assert times.size == SyntheticSequence(range(8)).size


def test_what_is_kept(cache):
    assert kept_times() is None
    first = MethodTimes((720, 1280), "a machine", "1", {"warp": RunTime(2.5), "blend": RunTime(3.0)})
    keep_times(first)
    assert kept_times() == first
    keep_times(MethodTimes((720, 1280), "a machine", "1", {"warp": RunTime(2.0)}))
    assert {name: t.median for name, t in kept_times().ms.items()} == {"warp": 2.0, "blend": 3.0}
    keep_times(MethodTimes((720, 1280), "another machine", "1", {"warp": RunTime(9.0)}))
    assert list(kept_times().ms) == ["warp"]
    for damaged in ("{", "[]", '{"size": [1], "ms": {}}', '{"size": [1, "x"]}'):
        cache.write_text(damaged)
        assert kept_times() is None


@pytest.mark.slow
def test_the_command_says_where_its_times_come_from(capsys, cache):
    assert main(["methods"]) == 0
    assert "ms: not measured here yet; --measure does" in capsys.readouterr().out
    assert main(["methods", "warp", "--measure", "--size", "64x36"]) == 0
    kept = json.loads(cache.read_text())
    assert kept["size"] == [36, 64]
    said = f"at 64x36, on {kept['machine']}, by jaxtrapolate {jx.__version__}"
    assert f"{kept['ms']['warp']['median']:.1f} ms: median of 5 calls {said}" in capsys.readouterr().out
    assert main(["methods"]) == 0
    out = capsys.readouterr().out
    assert f"ms: median of 5 calls {said}" in out
    assert main(["methods", "--size", "64x36"]) == 2
    assert "--size: is of the frames that --measure times" in capsys.readouterr().err
