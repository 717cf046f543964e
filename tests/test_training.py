"""The training loop: a step by hand, resumption, kills, devices, configurations, the command line."""

import dataclasses
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx
from toy_task import MAP, SHIFT, ToyOptions, ToyTask

from jaxtrapolate.errors import InputError
from jaxtrapolate.files import read_png
from jaxtrapolate.training import (
    Config,
    Optimizer,
    TrainingError,
    parse_config,
    train_and_evaluate,
)
from jaxtrapolate.training.checkpoints import Checkpoints, model_arrays
from jaxtrapolate.training.journal import read_metrics
from jaxtrapolate.training.step import make_step, schedule, transformation
from jaxtrapolate.training.tasks import round_key
from jaxtrapolate.weights import load_orbax, save_weights
from jaxtrapolate.weights.tree import named

TESTS = pathlib.Path(__file__).parent


def config(options=None, **fields):
    """A short run of the toy task."""
    defaults = {
        "steps": 24,
        "batch": 8,
        "pool": 16,
        "steps_per_round": 5,
        "log_every": 2,
        "checkpoint_every": 6,
        "validate_every": 12,
        "optimizer": Optimizer(peak_learning_rate=0.03),
    }
    return Config(task="toy", options=options or ToyOptions(), **{**defaults, **fields})


def numbers(workdir, kind="train", fields=("loss", "gradient", "largest")):
    """A field's values in the metrics of a run, by step."""
    return [[entry["step"], *(entry[f] for f in fields)] for entry in read_metrics(workdir) if entry["kind"] == kind]


def read_model(folder):
    """The arrays of a trained network by name."""
    return named(load_orbax(folder).tree)


def same_models(first, second):
    a, b = read_model(first / "model"), read_model(second / "model")
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run without interruption, with every kind of state: batch norm, a count, averages."""
    workdir = tmp_path_factory.mktemp("whole")
    settings = config(ToyOptions(wobble=0.1), ema_decay=0.9)
    return settings, workdir, train_and_evaluate(settings, workdir)


def test_what_a_run_writes(whole):
    _, workdir, scores = whole
    assert json.loads((workdir / "run.json").read_text())["settings"]["options"]["wobble"] == 0.1
    assert [row[0] for row in numbers(workdir)] == list(range(2, 25, 2))
    ((_, first), (_, last)) = numbers(workdir, "validation", ("negative",))
    assert last > first
    assert scores == {"negative": last}
    assert read_png(workdir / "images" / "00000024-error.png").shape == (8, 7, 3)
    train = [entry for entry in read_metrics(workdir) if entry["kind"] == "train"]
    assert all(entry["step_ms"] > 0 and entry["examples_per_s"] > 0 for entry in train)
    assert sum("pool_ms" in entry for entry in train) == 4  # the first of five came with the compilation
    assert not list(workdir.glob("**/*.tmp"))
    about = json.loads((workdir / "model" / "metadata" / "metadata").read_text())
    assert about == {"method": "toy", "config": {}, "note": "for tests"}
    model = read_model(workdir / "model")
    assert {n: v.shape for n, v in model.items()} == {
        **{f"norm/{n}": (3,) for n in ("scale", "bias", "mean", "var")},
        "map/kernel": (3, 2),
        "map/bias": (2,),
    }


def test_the_first_step_is_adams(tmp_path):
    """Against a float64 loop: least squares on the pixels that the batch holds, then Kingma and Ba's algorithm 1."""
    settings, task = config(ToyOptions(norm=False), optimizer=Optimizer(peak_learning_rate=0.1, constant=9)), ToyTask()
    task.options = settings.options
    step, pool = make_step(task, settings), task.pool(round_key(0, 0), range(16))
    state = step.create()
    batch = jax.device_get(step.batch(pool, 0))
    assert batch["x"].shape == (8, 5, 3, 3)
    x, y = (batch[n].reshape(-1, batch[n].shape[-1]).astype(np.float64) for n in "xy")
    np.testing.assert_allclose(y, x @ MAP + SHIFT, atol=1e-6)
    kernel, bias = (np.asarray(state.weights["map"][n][...], np.float64) for n in ("kernel", "bias"))
    error = x @ kernel + bias - y
    gradients = {"kernel": 2 * x.T @ error / error.size, "bias": 2 * error.sum(0) / error.size}
    after, metrics = step.take(state, pool)
    np.testing.assert_allclose(metrics["loss"], np.mean(error**2), rtol=1e-5)
    np.testing.assert_allclose(metrics["largest"], np.abs(error).max(), rtol=1e-5)
    norm = np.sqrt(sum((g**2).sum() for g in gradients.values()))
    np.testing.assert_allclose(metrics["gradient"], norm, rtol=1e-5)
    for name, before in (("kernel", kernel), ("bias", bias)):
        g = gradients[name]
        m, v = 0.1 * g / (1 - 0.9), 0.001 * g**2 / (1 - 0.999)
        np.testing.assert_allclose(
            after.weights["map"][name][...], before - 0.1 * m / (np.sqrt(v) + 1e-8), rtol=1e-5, atol=1e-6
        )


def test_slots_draw_from_their_own_part_of_the_pool():
    """Slot b holds crops of examples 2 b and 2 b + 1, each of them and every place in some step."""
    settings, task = config(), ToyTask()
    step, pool = make_step(task, settings), task.pool(round_key(0, 0), range(16))
    images = np.asarray(pool["x"])
    windows = np.lib.stride_tricks.sliding_window_view(images, (5, 3), axis=(1, 2))  # [16, 4, 5, 3, 5, 3]
    seen = set()
    for number in range(40):
        batch = np.asarray(step.batch(pool, number)["x"])
        for slot in range(8):
            crop = np.moveaxis(batch[slot], -1, 0)
            match = np.argwhere((windows == crop).all(axis=(3, 4, 5)))
            ((example, top, left),) = match
            assert example // 2 == slot
            seen.add((example % 2, top, left))
    assert len(seen) == 2 * 4 * 5


def test_the_answer_is_found(tmp_path):
    every = {name: 500 for name in ("log_every", "checkpoint_every", "validate_every")}
    settings = config(ToyOptions(norm=False), steps=500, steps_per_round=50, optimizer=Optimizer(0.1), **every)
    scores = train_and_evaluate(settings, tmp_path)
    model = read_model(tmp_path / "model")
    np.testing.assert_allclose(model["map/kernel"], MAP, atol=0.02)
    np.testing.assert_allclose(model["map/bias"], SHIFT, atol=0.02)
    assert scores["negative"] > -1e-4


@pytest.mark.parametrize("clip", [pytest.param(None, marks=pytest.mark.slow), 0.5])
def test_clipping(clip):
    """With a huge epsilon Adam's first step is the learning rate times the gradient over epsilon."""
    optimizer = transformation(Optimizer(peak_learning_rate=1.0, constant=9, epsilon=1e4, clip=clip), 10)
    gradient = {"a": jnp.array([3.0, 0.0]), "b": jnp.array([4.0])}
    updates, _ = optimizer.update(gradient, optimizer.init(gradient), gradient)
    factor = 1.0 if clip is None else clip / 5
    for name, value in gradient.items():
        np.testing.assert_allclose(updates[name], -value * factor / 1e4, rtol=1e-3)


def test_learning_rate():
    """Against its formula in float64; the run may stop before the cosine ends."""
    optimizer = Optimizer(peak_learning_rate=2e-3, warmup=10, constant=20, decay=100, floor=0.1)
    rate = schedule(optimizer, 80)
    for step in (0, 3, 9, 10, 15, 29, 30, 31, 55, 79, 130, 200):
        fall = min(max(step - 30, 0), 100) / 100
        height = 2e-3 * (0.1 + 0.9 * (1 + np.cos(np.pi * fall)) / 2)
        np.testing.assert_allclose(rate(step), 2e-3 * step / 10 if step < 10 else height, rtol=1e-5)
    np.testing.assert_allclose(schedule(Optimizer(constant=20), 120)(70), 0.5e-3, rtol=1e-5)


def test_averages(tmp_path):
    """The exported weights against the recursion in float64 over every step's checkpoint."""
    settings = config(steps=6, log_every=1, checkpoint_every=1, validate_every=6, keep=6, ema_decay=0.35)
    train_and_evaluate(settings, tmp_path)
    step = make_step(ToyTask(), settings)
    state = step.create()
    expected = model_arrays(step.model(state))
    with Checkpoints(tmp_path / "checkpoints", keep=6, score="negative") as checkpoints:
        assert checkpoints.steps() == tuple(range(1, 7))
        for number in checkpoints.steps():
            now = checkpoints.restore(number, state)
            keep = min(0.35, number / (9 + number))
            live = nnx.merge(nnx.graphdef(step.model(state)), now.weights, now.statistics, now.rest, copy=True)
            for name, value in model_arrays(live).items():
                expected[name] = keep * expected[name].astype(np.float64) + (1 - keep) * value
    for name, value in read_model(tmp_path / "model").items():
        np.testing.assert_allclose(value, expected[name], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("stop", [pytest.param(3, marks=pytest.mark.slow), 14])
def test_resumed_bit_for_bit(whole, tmp_path, stop):
    """Broken off before the first checkpoint, and in the middle of a round after the second."""
    settings, workdir, scores = whole

    def report(text, done, total):
        if done >= stop:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_and_evaluate(settings, tmp_path, report=report)
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"kind": "train", "step": 999')  # what a kill leaves of a line
    assert train_and_evaluate(settings, tmp_path) == scores
    assert numbers(tmp_path) == numbers(workdir)
    same_models(tmp_path, workdir)


def test_a_finished_run_only_exports(whole, tmp_path):
    settings, workdir, scores = whole
    before = (workdir / "metrics.jsonl").read_text()
    assert train_and_evaluate(settings, workdir) == scores
    assert (workdir / "metrics.jsonl").read_text() == before


@pytest.mark.slow
def test_a_run_begins_with_given_weights(whole, tmp_path):
    """From another run's model, as folder and as file; what is resumed does not look at them again."""
    _, workdir, _ = whole
    loaded = load_orbax(workdir / "model")
    given = {path: np.asarray(value) for path, value in named(loaded.tree).items()}
    about = {"config": {"norm": False}, "note": ""}
    file = save_weights(tmp_path, "toy", loaded.tree, config={}, note="")
    begun = []

    class Watched(ToyTask):
        def validate(self, model):
            begun.append(model_arrays(model))
            return super().validate(model)

    settings = config(steps=2, ema_decay=0.5, log_every=1, checkpoint_every=1, validate_every=1)
    settings = dataclasses.replace(settings, optimizer=Optimizer(peak_learning_rate=1e-12))
    for number, start in enumerate((workdir / "model", file)):
        run = dataclasses.replace(settings, start=str(start))
        train_and_evaluate(run, tmp_path / str(number), task=Watched())
        for arrays in begun:
            np.testing.assert_allclose(arrays["map/kernel"], given["map/kernel"], rtol=1e-6)
            assert np.abs(arrays["norm/scale"] - given["norm/scale"]).max() < 1e-6
        assert len(begun) == 2
        begun.clear()
    file.unlink()
    train_and_evaluate(run, tmp_path / "1", task=Watched())
    for start, message in [
        (tmp_path / "none-12345678.npz", "does not exist"),
        (save_weights(tmp_path, "toy", loaded.tree, **about), "of another kind: norm was false, is now not there"),
        (save_weights(tmp_path, "warp", loaded.tree, config={}, note=""), 'method was "warp", is now "toy"'),
        (save_weights(tmp_path, "toy", {"map": loaded.tree["map"]}, config={}, note="no norm"), "do not fit: missing"),
    ]:
        with pytest.raises(InputError, match=message):
            train_and_evaluate(dataclasses.replace(settings, start=str(start)), tmp_path / "wrong", task=ToyTask())
        shutil.rmtree(tmp_path / "wrong")

    class Adapting(Watched):
        adapts = ("norm",)

    other = save_weights(tmp_path, "toy", loaded.tree, **about)
    train_and_evaluate(dataclasses.replace(settings, start=str(other)), tmp_path / "adapts", task=Adapting())
    (line,) = [entry for entry in read_metrics(tmp_path / "adapts") if entry["kind"] == "start"]
    assert "norm was false" in line["other than the weights were trained on"]
    narrow = dict(
        loaded.tree, map=dict(loaded.tree["map"], kernel=np.asarray(loaded.tree["map"]["kernel"])[..., 1:, :])
    )
    other = save_weights(tmp_path, "toy", narrow, **about)
    begun.clear()
    run = dataclasses.replace(settings, start=str(other))
    with pytest.raises(InputError, match="of another kind"):
        train_and_evaluate(run, tmp_path / "wrong", task=ToyTask())
    train_and_evaluate(run, tmp_path / "wider", task=Adapting())
    np.testing.assert_allclose(begun[0]["map/kernel"][..., :-1, :], given["map/kernel"][..., 1:, :], rtol=1e-6)
    assert np.abs(begun[0]["map/kernel"][..., -1, :]).max() < 1e-6
    with pytest.raises(InputError, match="no default weights"):
        train_and_evaluate(dataclasses.replace(settings, start="default"), tmp_path / "wrong", task=ToyTask())


def test_pools_made_ahead_are_the_same(whole, tmp_path):
    settings, workdir, scores = whole
    assert train_and_evaluate(settings, tmp_path, ahead=True) == scores
    assert numbers(tmp_path) == numbers(workdir)
    same_models(tmp_path, workdir)


@pytest.mark.slow
def test_an_error_in_the_thread_is_raised(tmp_path):
    class Broken(ToyTask):
        def pool(self, key, numbers):
            if len(self.asked) == 1:
                raise OSError("the disk is gone")
            return super().pool(key, numbers)

    with pytest.raises(OSError, match="the disk is gone"):
        train_and_evaluate(config(), tmp_path, task=Broken(), ahead=True)


def test_the_last_and_the_best_are_kept(tmp_path):
    """Every second one is validated; the fourth is best."""
    scores = {2: 1.0, 4: 5.0, 6: float("nan"), 8: 3.0, 10: float("inf") * -1}
    with Checkpoints(tmp_path, keep=2, score="psnr") as checkpoints:
        assert checkpoints.latest() is None
        for step in range(1, 12):
            metrics = {"psnr": scores[step]} if step in scores else None
            checkpoints.save(step, {"a": jnp.full(3, step), "key": jax.random.key(step)}, metrics)
    with Checkpoints(tmp_path, keep=2, score="psnr") as checkpoints:
        assert checkpoints.steps() == (4, 10, 11)
        assert checkpoints.latest() == 11
        state = checkpoints.restore(4, {"a": jnp.zeros(3, jnp.int32), "key": jax.random.key(0)})
    np.testing.assert_array_equal(state["a"], [4, 4, 4])
    np.testing.assert_array_equal(jax.random.key_data(state["key"]), [0, 4])


@pytest.mark.slow
def test_half_precision(tmp_path):
    """The network computes in bfloat16; weights, statistics and the optimiser's moments stay float32."""
    seen = []

    class Watched(ToyTask):
        def loss(self, model, batch):
            seen.append((model.map.kernel.dtype.name, model.norm.mean.dtype.name, model(batch["x"]).dtype.name))
            return super().loss(model, batch)

    settings = config(steps=100, precision="bfloat16", log_every=10, checkpoint_every=100, validate_every=100)
    train_and_evaluate(settings, tmp_path, task=Watched())
    assert set(seen) == {("bfloat16", "float32", "bfloat16")}
    losses = [row[1] for row in numbers(tmp_path)]
    assert losses[-1] < 0.2 * losses[0]
    step = make_step(ToyTask(), settings)
    with Checkpoints(tmp_path / "checkpoints", keep=1, score="negative") as checkpoints:
        state = checkpoints.restore(100, step.create())
    leaves = jax.tree.leaves((state.weights, state.statistics, state.moments))
    assert {leaf.dtype for leaf in leaves} == {np.dtype(np.float32), np.dtype(np.int32)}
    weights = np.asarray(state.weights["map"]["kernel"][...])
    assert (weights != weights.astype(jnp.bfloat16).astype(np.float32)).any()


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_loss_that_is_not_finite(tmp_path, ahead):
    """The first step that draws the bad example is named; its batch is saved; the checkpoints are of before it."""
    task = ToyTask(ToyOptions(poison=5))
    settings = config(task.options, steps=60, seed=3)
    with pytest.raises(TrainingError) as error:
        train_and_evaluate(settings, tmp_path, task=task, ahead=ahead)
    (saved,) = tmp_path.glob("batch-*.npz")
    step = int(saved.stem.split("-")[1])
    assert f"step {step}: the loss is nan" in str(error.value)
    assert saved.name in str(error.value)
    functions = make_step(task, settings)
    for number in range(step):
        pool = task.pool(round_key(3, number // 5), range(16))
        batch = jax.device_get(functions.batch(pool, number))
        assert np.isfinite(batch["y"]).all() == (number < step - 1)
    with np.load(saved) as arrays:
        np.testing.assert_array_equal(arrays["x"], batch["x"])
        np.testing.assert_array_equal(arrays["y"], batch["y"])
    with Checkpoints(tmp_path / "checkpoints", keep=1, score="negative") as checkpoints:
        assert all(n < step for n in checkpoints.steps())


@pytest.mark.slow
def test_a_gradient_that_is_not_finite(tmp_path):
    class Kinked(ToyTask):
        def loss(self, model, batch):
            loss, metrics = super().loss(model, batch)
            return loss + 0 * jnp.sqrt(0 * model.map.bias[...].sum()), metrics

    with pytest.raises(TrainingError, match="step 1: the gradient is nan"):
        train_and_evaluate(config(), tmp_path, task=Kinked())


def test_pool_of_the_wrong_length(tmp_path):
    class Short(ToyTask):
        def pool(self, key, numbers):
            return super().pool(key, numbers[1:])

    with pytest.raises(ValueError, match=r"leading axis of 16 examples, got \[15\]"):
        train_and_evaluate(config(), tmp_path, task=Short())


@pytest.mark.slow
def test_score_that_validation_does_not_give(tmp_path):
    task = ToyTask()
    task.score = "psnr"
    with pytest.raises(ValueError, match="expected a metric 'psnr', got negative"):
        train_and_evaluate(config(), tmp_path, task=task)


def test_another_configuration_is_refused(whole):
    _, workdir, _ = whole
    changed = config(ToyOptions(wobble=0.2), ema_decay=0.9, optimizer=Optimizer(peak_learning_rate=0.03, clip=1.0))
    with pytest.raises(InputError) as error:
        train_and_evaluate(changed, workdir)
    assert "options.wobble was 0.1, is now 0.2; optimizer.clip was null, is now 1.0; choose" in str(error.value)


def test_models_that_cannot_be_read(whole, tmp_path):
    with pytest.raises(ValueError, match="no Orbax checkpoint"):
        read_model(tmp_path)
    shutil.copytree(whole[1] / "model", tmp_path / "model")
    (tmp_path / "model" / "weights" / "_METADATA").write_text("{")
    with pytest.raises(ValueError, match="damaged Orbax checkpoint"):
        read_model(tmp_path / "model")


SCRIPT = """
import sys
sys.path.insert(0, {tests!r})
import jax
from jaxtrapolate.training import *
import toy_task
{before}
settings = parse_config({table!r})
train_and_evaluate(settings, sys.argv[1])
"""


def python(workdir, table, *, before="", **environment):
    """A process that trains the toy task."""
    return run_python(SCRIPT.format(tests=str(TESTS), table=table, before=before), workdir, **environment)


def run_python(script, argument, **environment):
    """A process with a script, on CPUs."""
    path = os.pathsep.join([str(TESTS.parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": path, **environment}
    return subprocess.Popen(
        [sys.executable, "-c", script, str(argument)], env=environment, stderr=subprocess.PIPE, text=True
    )


def ends(process):
    _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err


TABLE = {
    "task": "toy",
    "steps": 24,
    "batch": 8,
    "pool": 16,
    "steps_per_round": 5,
    "log_every": 2,
    "checkpoint_every": 6,
    "validate_every": 12,
    "ema_decay": 0.9,
    "optimizer": {"peak_learning_rate": 0.03},
    "options": {"wobble": 0.1},
}


@pytest.mark.slow
def test_killed_in_the_middle_of_saving(whole, tmp_path):
    """SIGKILL when the second checkpoint has its files but not yet its name; the run goes on to the same numbers."""
    settings, workdir, _ = whole
    assert parse_config(TABLE) == settings
    before = """
import os, signal, pathlib
folder = pathlib.Path(sys.argv[1]) / "checkpoints"
def dying(name):
    real = getattr(os, name)
    def function(source, *rest, **named):
        if (folder / "6").exists() and str(source).startswith(str(folder)):
            os.kill(os.getpid(), signal.SIGKILL)
        return real(source, *rest, **named)
    setattr(os, name, function)
dying("rename"), dying("replace")
"""
    process = python(tmp_path, TABLE, before=before)
    process.communicate(timeout=300)
    assert process.returncode == -signal.SIGKILL
    left = {path.name for path in (tmp_path / "checkpoints").iterdir()}
    assert left == {"6", "12.orbax-checkpoint-tmp"}
    train_and_evaluate(settings, tmp_path)
    assert numbers(tmp_path) == numbers(workdir)
    same_models(tmp_path, workdir)
    assert all(path.name.isdigit() for path in (tmp_path / "checkpoints").iterdir())


def close(first, second):
    """The numbers of two runs, to float32's rounding over a few steps; the first ones nearly exactly."""
    a, b = np.array(numbers(first)), np.array(numbers(second))
    assert a.shape == b.shape
    np.testing.assert_allclose(a[0], b[0], rtol=1e-5)
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_eight_devices_give_what_one_gives(tmp_path):
    """Batch norm over the global batch, the same examples and crops: simulated devices in another process."""
    table = {**TABLE, "options": {}}
    process = python(tmp_path / "eight", table, XLA_FLAGS="--xla_force_host_platform_device_count=8")
    train_and_evaluate(parse_config(table), tmp_path / "one")
    ends(process)
    close(tmp_path / "eight", tmp_path / "one")


def test_batch_that_cannot_be_divided(tmp_path, monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 3)
    with pytest.raises(InputError, match="batch: 8 items cannot be divided evenly among 3 devices"):
        train_and_evaluate(config(), tmp_path)


COMMAND = """
import sys
sys.path.insert(0, {tests!r})
import toy_task
from jaxtrapolate.commands.main import main
real = toy_task.ToyTask.pool
def pool(self, key, numbers):
    print(len(numbers), numbers.start, file=open(sys.argv[1] + "-{number}", "a"))
    return real(self, key, numbers)
toy_task.ToyTask.pool = pool
arguments = ["--coordinator", "localhost:{port}", "--processes", "2", "--process", "{number}"]
sys.exit(main(["train", {file!r}, "--workdir", sys.argv[1], *arguments]))
"""


@pytest.mark.slow
def test_two_processes_give_what_one_gives(tmp_path):
    """On the loopback, two devices each; each makes its own half of every pool."""
    import socket

    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        port = probe.getsockname()[1]
    table = {**TABLE, "options": {}}
    lines = [f"{k} = {json.dumps(v)}" for k, v in table.items() if not isinstance(v, dict)]
    file = tmp_path / "run.toml"
    file.write_text("\n".join([*lines, "[optimizer]", "peak_learning_rate = 0.03", ""]))
    processes = [
        run_python(
            COMMAND.format(tests=str(TESTS), file=str(file), port=port, number=i),
            tmp_path / "two",
            XLA_FLAGS="--xla_force_host_platform_device_count=2",
        )
        for i in range(2)
    ]
    train_and_evaluate(parse_config(table), tmp_path / "one")
    for process in processes:
        ends(process)
    close(tmp_path / "two", tmp_path / "one")
    for i in range(2):
        lines = (tmp_path / f"two-{i}").read_text().split("\n")
        assert lines.count(f"8 {8 * i}") == 5  # five rounds; what else was asked for is validation


@pytest.mark.slow
def test_killed_again_and_again(whole, tmp_path):
    """SIGKILL at random moments of training and saving, ever later, until the run gets to its end."""
    _, workdir, _ = whole
    rng, started = np.random.default_rng(0), tmp_path / "started"
    slow = f"""
import pathlib, time
real = toy_task.ToyTask.pool
def pool(self, key, numbers):
    pathlib.Path({str(started)!r}).touch()
    time.sleep(0.3)  # five rounds: the first run is killed before its end
    return real(self, key, numbers)
toy_task.ToyTask.pool = pool
"""
    kills = 0
    for _ in range(30):
        started.unlink(missing_ok=True)
        process = python(tmp_path / "run", TABLE, before=slow)
        while process.poll() is None and not started.exists():
            time.sleep(0.01)
        deadline = time.monotonic() + rng.uniform(0, 1.4 + 0.4 * kills)
        while process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        if process.poll() is None:
            process.kill()
            kills += 1
        _, err = process.communicate(timeout=60)
        assert process.returncode in (0, -signal.SIGKILL), err
        if process.returncode == 0:
            break
    assert process.returncode == 0
    assert kills >= 1
    assert numbers(tmp_path / "run") == numbers(workdir)
    same_models(tmp_path / "run", workdir)


def test_weight_decay_is_decoupled():
    """Against Loshchilov and Hutter's algorithm 2 in float64: two steps on fixed gradients."""
    optimizer = transformation(Optimizer(peak_learning_rate=0.1, constant=9, weight_decay=0.2), 10)
    weight, state = jnp.array([1.0, -2.0]), optimizer.init(jnp.zeros(2))
    expected, m, v = np.array([1.0, -2.0]), 0.0, 0.0
    for t, gradient in enumerate(([0.5, -0.1], [-0.2, 0.4]), 1):
        updates, state = optimizer.update(jnp.array(gradient), state, weight)
        weight = optax.apply_updates(weight, updates)
        g = np.array(gradient)
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2
        step = (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
        expected = expected - 0.1 * (step + 0.2 * expected)
        np.testing.assert_allclose(weight, expected, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("when", ["before", "while it is written"])
def test_a_full_disk_is_one_line(tmp_path, monkeypatch, when):
    """Told before Orbax begins, or as the one error of all that its threads report."""
    from types import SimpleNamespace

    from jaxtrapolate.training import checkpoints

    state = {"a": np.zeros((300, 100), np.float32)}
    with checkpoints.Checkpoints(tmp_path / "c", keep=1, score="x") as kept:
        kept.save(1, state)
        if when == "before":
            usage = SimpleNamespace(free=100_000)
            monkeypatch.setattr(checkpoints.shutil, "disk_usage", lambda path: usage)
        else:

            def fail(*_, **__):
                raise ValueError("RESOURCE_EXHAUSTED: Failed to write: No space left on device [os_error_code='28']")

            monkeypatch.setattr(kept._manager, "save", fail)
        with pytest.raises(InputError) as error:
            kept.save(2, state)
        assert kept.latest() == 1
    assert "the disk is full" in str(error.value)
    assert str(tmp_path / "c") in str(error.value)
    assert "\n" not in str(error.value)
