"""Compiled programs that outlive a process: where commands keep them, and what is said of those read from there."""

import json
import os
import subprocess
import sys

import pytest
from synthetic import make_frame

from jaxtrapolate.files import write_unreal_frame

VARIABLES = (
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "JAX_COMPILATION_CACHE_MAX_SIZE",
)


@pytest.fixture
def environment(tmp_path):
    """As a user has it, with a cache folder of his own."""
    kept = {k: v for k, v in os.environ.items() if k not in VARIABLES}
    return kept | {"XDG_CACHE_HOME": str(tmp_path / "cache"), "HOME": str(tmp_path)}


@pytest.fixture(scope="module")
def dump(tmp_path_factory):
    """Frames that need not be rendered."""
    folder = tmp_path_factory.mktemp("dump")
    for time in range(5):
        write_unreal_frame(folder, "Wall", time, make_frame(time, (18, 32)))
    return folder


def evaluate(environment, dump, folder, *options):
    """The results of an evaluation in a process of its own."""
    command = [sys.executable, "-m", "jaxtrapolate", *options, "evaluate", str(dump), "--methods", "guided_warp"]
    command += ["--pictures", "0", "--output", str(folder)]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return json.loads((folder / "results.json").read_text()), ended.stdout


@pytest.mark.slow
def test_a_second_run_reads_what_the_first_compiled(environment, dump, tmp_path):
    first, _ = evaluate(environment, dump, tmp_path / "a")
    kept = list((tmp_path / "cache" / "jaxtrapolate" / "compiled").iterdir())
    assert any("jit" in path.name for path in kept)
    second, out = evaluate(environment, dump, tmp_path / "b")
    times = [results["methods"]["guided_warp"]["ms"] for results in (first, second)]
    assert "cached" not in times[0]
    assert times[1]["cached"] is True
    assert times[1]["compile"] < times[0]["compile"]
    assert "(cached)" in out
    assert "(cached)" in (tmp_path / "b" / "report.html").read_text()
    frames = [[f["psnr"] for f in results["methods"]["guided_warp"]["frames"]] for results in (first, second)]
    assert frames[0] == frames[1]


@pytest.mark.slow
def test_it_can_be_turned_off_or_moved(environment, dump, tmp_path):
    off, _ = evaluate(environment, dump, tmp_path / "a", "--no-compile-cache")
    assert "cached" not in off["methods"]["guided_warp"]["ms"]
    folder = tmp_path / "cache" / "jaxtrapolate" / "compiled"
    assert not any("jit" in path.name for path in folder.iterdir())
    moved = environment | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "mine")}
    evaluate(moved, dump, tmp_path / "b")
    assert any("jit" in path.name for path in (tmp_path / "mine").iterdir())
    assert not any("jit" in path.name for path in folder.iterdir())


@pytest.mark.slow
def test_a_cache_that_cannot_be_is_none(environment, dump, tmp_path):
    """A file stands where the folder should be."""
    (tmp_path / "cache").write_text("in the way")
    results, _ = evaluate(environment, dump, tmp_path / "a")
    assert "cached" not in results["methods"]["guided_warp"]["ms"]


def test_importing_the_library_keeps_nothing(environment, tmp_path):
    code = "import jaxtrapolate, jax, os; jaxtrapolate.load('warp'); print(jax.config.jax_compilation_cache_dir)"
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "None"
    assert not (tmp_path / "cache").exists()


def test_programs_are_forgotten_before_the_memory_maps_run_out():
    """In a process of its own, which then answers as before; far from the limit nothing is forgotten."""
    code = """if True:
        import jax, jax.numpy as jnp
        from jaxtrapolate.runtime.compiled import spare_memory_maps
        double = jax.jit(lambda a: 2 * a)
        first = double(jnp.ones(3))
        print(spare_memory_maps(), double._cache_size(), spare_memory_maps(0.0), double._cache_size())
        print((double(jnp.ones(3)) == first).all())
    """
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    expected = "False 1 True 0" if sys.platform == "linux" else "False 1 False 1"
    assert ended.stdout.split("\n")[:2] == [expected, "True"]
