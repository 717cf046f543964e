"""The benchmark's script in small, and the timing beneath it. Nothing here asserts a time."""

import importlib
import json
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrapolate.runtime import timing

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"
SIZE = "40x24"


@pytest.fixture
def operations(monkeypatch):
    """The script as a module, which never starts itself anew."""
    if not FOLDER.is_dir():
        pytest.skip("the benchmark is not beside the tests")
    monkeypatch.syspath_prepend(str(FOLDER))
    for name in ("inputs", "peers", "operations"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    module = importlib.import_module("operations")
    monkeypatch.setattr(module, "confine", lambda threads, allocator: None)
    monkeypatch.setattr(module, "copy_bandwidth", lambda device: 1.0)
    # the other sigmas compile the same programs again
    monkeypatch.setattr(module, "OPERATIONS", tuple(o for o in module.OPERATIONS if "sigma 0.005" not in o.name))
    yield module
    for name in ("inputs", "peers", "operations"):
        sys.modules.pop(name, None)


def run(operations, folder, *options, size=SIZE):
    output = folder / "results.json"
    status = operations.main(["--sizes", size, "--repeats", "2", "--output", str(output), *options])
    return status, json.loads(output.read_text())


@pytest.mark.slow
def test_all_operations_without_peers(operations, tmp_path, monkeypatch, capsys):
    for name in ("cv2", "numba", "scipy", "torch"):
        monkeypatch.setitem(sys.modules, name, None)
    status, results = run(operations, tmp_path)
    assert status == 0
    assert set(results) == {"machine", "settings", "peer_versions", "copy_gb_per_s", "operations"}
    assert set(results["peer_versions"].values()) == {None}
    assert [row["operation"] for row in results["operations"]] == [o.name for o in operations.OPERATIONS]
    for row in results["operations"]:
        assert (row["size"], row["height"], row["width"]) == (SIZE, 24, 40)
        assert set(row["ms"]) == {"median", "iqr", "compile", "runs"}
        assert row["ms"]["runs"] == 2
        assert row["bytes"] > 0
        assert {name for name in row["peers"] if not name.startswith("ours")} == set()
    printed = capsys.readouterr().out
    assert "not installed: cv2, numba, scipy, torch" in printed
    assert printed.count("\n| ") == len(operations.OPERATIONS)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["results.json"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "module, names",
    [
        ("cv2", "warp bilinear,warp nearest,bicubic,chain,farneback,dis"),
        ("scipy", "warp bilinear,warp nearest,chain"),
        ("torch", "warp bilinear,warp nearest,bicubic"),
        ("numba", "bicubic,softmax,occlusion,search,warp float32"),
    ],
)
def test_answers_of_a_peer_agree(operations, tmp_path, monkeypatch, module, names):
    pytest.importorskip(module)
    for other in {"cv2", "numba", "scipy", "torch"} - {module}:
        monkeypatch.setitem(sys.modules, other, None)
    status, results = run(operations, tmp_path, "--only", names)
    assert status == 0
    entries = [entry for row in results["operations"] for entry in row["peers"].values()]
    assert len(entries) >= len(results["operations"])
    for entry in entries:
        assert {"median", "iqr", "compile", "ratio", "note"} <= set(entry)
        if entry["compared"]:
            assert entry["agrees"]
            assert set(entry["difference"]) == {"max", "share", "tolerance"}


@pytest.mark.slow
def test_a_peer_that_answers_otherwise_is_not_timed(operations, tmp_path, capsys):
    wrong = operations.Peer("wrong", "scipy", lambda parallel, image, motion: lambda: image + 1)
    operation = operations.Operation("wrong", lambda image, motion: image, ("image", "motion"), (wrong,))
    operations.OPERATIONS = (operation,)
    pytest.importorskip("scipy")
    status, results = run(operations, tmp_path)
    entry = results["operations"][0]["peers"]["wrong"]
    assert status == 1
    assert not entry["agrees"]
    assert "ratio" not in entry
    assert "wrong answers otherwise" in capsys.readouterr().err


def test_bad_options_are_named(operations, capsys):
    for options, message in [
        (["--sizes", "big"], "size: expected one of 360p"),
        (["--only", "nothing"], "no operation of that name"),
        (["--repeats", "0"], "expected 1 or more, got 0"),
    ]:
        with pytest.raises(SystemExit) as caught:
            operations.main(options)
        assert caught.value.code == 2
        assert message in capsys.readouterr().err


def test_inputs_are_seeded_and_of_the_size(operations):
    inputs = importlib.import_module("inputs")
    first, second = inputs.make_inputs(12, 30, seed=3), inputs.make_inputs(12, 30, seed=3)
    for name in ("image", "motion", "older", "depth", "importance", "target_guide", "source_guide"):
        a = getattr(first, name)
        np.testing.assert_array_equal(a, getattr(second, name))
        assert a.shape[:2] == (12, 30)
        assert a.dtype == np.float32
    assert inputs.size_of("1080p") == (1080, 1920)


def test_measure_compiles_a_jitted_function_once():
    traced = []

    @jax.jit
    def double(x):
        traced.append(x)
        return 2 * x

    result = timing.measure(double, jnp.ones(3), repeats=4, warmup=1)
    assert len(result.runs) == 4
    assert len(traced) == 1
    assert result.summary() == {"median": result.median, "iqr": result.iqr, "compile": result.compile, "runs": 4}


def test_measure_pairs_takes_turns():
    order = []
    functions = {name: partial(order.append, name) for name in "abc"}
    result = timing.measure_pairs(functions, repeats=2, warmup=1, calls=2)
    assert list(result) == ["a", "b", "c"]
    assert "".join(order) == "abc" + "aabbcc" * 3


def test_ratio_is_taken_by_round():
    ours = timing.Timing(0, 0, 0, (1.0, 20.0, 3.0))
    peer = timing.Timing(0, 0, 0, (2.0, 10.0, 3.0))
    assert timing.ratio(ours, peer) == 1.0
    with pytest.raises(ValueError, match="expected 3 runs"):
        timing.ratio(ours, timing.Timing(0, 0, 0, (1.0,)))


def test_measure_rejects_senseless_counts():
    with pytest.raises(ValueError, match="got 0, 1, 2"):
        timing.measure(int, repeats=0)


def test_machine_tells_what_figures_depend_on(monkeypatch):
    monkeypatch.setenv("MALLOC_ARENA_MAX", "1")
    monkeypatch.setenv("LD_PRELOAD", "")
    monkeypatch.setenv("XLA_DUMP_TO", "/some/where/dump")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/some/where/cache")
    about = timing.machine()
    assert about["cores_used"] >= 1
    assert about["versions"]["jax"] == jax.__version__
    assert about["settings"]["MALLOC_ARENA_MAX"] == "1"
    assert about["settings"]["XLA_DUMP_TO"] == "dump"
    assert "JAX_COMPILATION_CACHE_DIR" not in about["settings"]  # it changes no time but that of compilation
    json.dumps(about)


@pytest.fixture
def networks(operations, monkeypatch):
    """The script of the networks, after that of the operations, which it takes some functions from."""
    monkeypatch.delitem(sys.modules, "networks", raising=False)
    module = importlib.import_module("networks")
    monkeypatch.setattr(module, "confine", lambda threads, allocator: None)
    yield module
    sys.modules.pop("networks", None)


def run_networks(networks, folder, *options):
    output = folder / "networks.json"
    status = networks.main(["--sizes", SIZE, "--repeats", "2", "--output", str(output), *options])
    return status, json.loads(output.read_text())


@pytest.mark.slow
def test_networks_without_peers(networks, tmp_path, monkeypatch, capsys):
    for name in ("torch", "openvino"):
        monkeypatch.setitem(sys.modules, name, None)
    status, results = run_networks(networks, tmp_path)
    assert status == 0
    assert [row["network"] for row in results["networks"]] == list(networks.NETWORKS)
    light, full, gated, _ = (row["gflop"] for row in results["networks"])
    assert gated < light < full
    for row in results["networks"]:
        assert (row["height"], row["width"], row["peers"]) == (24, 40, {})
        assert row["ms"]["median"] > 0
    assert "extranet, full gates" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["networks.json"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # those of the peers
def test_networks_of_pytorch_and_openvino_agree(networks, tmp_path):
    pytest.importorskip("torch")
    status, results = run_networks(networks, tmp_path, "--only", "extranet,gated convolution")
    assert status == 0
    for row in results["networks"]:
        assert {"torch", "torch, channels last"} <= set(row["peers"])
        for entry in row["peers"].values():
            assert entry["difference"]["share"] == 0
            assert entry["ratio"] > 0


def test_networks_that_are_not_there(networks, tmp_path, capsys):
    with pytest.raises(SystemExit) as caught:
        run_networks(networks, tmp_path, "--only", "unet")
    assert caught.value.code == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "no network of that name; there are extranet; extranet, full gates; gated convolution; interpolator" in error
