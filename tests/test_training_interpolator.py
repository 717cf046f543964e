"""The learned interpolator as a method, and its training."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from synthetic import make_frame

import jaxtrapolate as jx
from jaxtrapolate.commands.main import main
from jaxtrapolate.evaluation.windows import Window, hide
from jaxtrapolate.methods.interpolator import interpolator
from jaxtrapolate.networks import Interpolator, InterpolatorConfig
from jaxtrapolate.records import replace
from jaxtrapolate.training import (
    Config,
    InterpolatorOptions,
    InterpolatorTask,
    Optimizer,
    load_config,
    train_and_evaluate,
)
from jaxtrapolate.training.config import parse_config
from jaxtrapolate.training.windows import WindowOptions

SMALL = InterpolatorConfig(widths=(4, 6))
OPTIONS = InterpolatorOptions(
    network=SMALL, windows=WindowOptions(size=(32, 40), motion="direct"), crop=(16, 24), validation=2
)


@pytest.fixture(scope="module")
def model():
    return Interpolator(SMALL, rngs=nnx.Rngs(0))


def make_window():
    first, truth, last = (jax.tree.map(jnp.asarray, make_frame(k)) for k in range(3))
    first, truth, last = (replace(f, time=jnp.float32(k)) for k, f in enumerate((first, truth, last)))
    return Window(number=1, truth=truth, history=(first,), target=hide(truth), future=(last,))


def test_the_method_is_the_network_on_display_values(model):
    """In NumPy: both frames and the result through sqrt(x / (1 + x))."""
    window = make_window()
    method = interpolator(model)
    image = method(window.history, window.target, window.future)
    colors = [np.maximum(frame.color, 0) for frame in (*window.history, *window.future)]
    shown = [np.sqrt(color / (1 + color)) for color in colors]
    answer = np.asarray(method.network(*map(jnp.asarray, shown), jnp.float32(0.5)))
    answer = np.maximum(answer, 0)
    np.testing.assert_allclose(image, answer**2 / (1 - answer**2), rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize(("time", "which"), [(0.0, 0), (2.0, 1)])
def test_at_a_rendered_frame_it_is_that_frame(model, time, which):
    window = make_window()
    target = replace(window.target, time=jnp.float32(time))
    image = interpolator(model)(window.history, target, window.future)
    frame = (window.history[0], window.future[0])[which]
    np.testing.assert_allclose(image, np.maximum(frame.color, 0), rtol=1e-4, atol=1e-6)


def test_what_is_not_finite_counts_as_black_or_white(model):
    window = make_window()
    color = window.history[0].color.at[3, 4].set(jnp.nan).at[5, 6].set(jnp.inf)
    image = interpolator(model)((replace(window.history[0], color=color),), window.target, window.future)
    assert np.isfinite(image).all()


def test_an_example_is_what_the_method_shows_its_network():
    task = InterpolatorTask(OPTIONS)
    window = make_window()
    made = jax.jit(task._prepare)(window, jax.random.key(0))
    for name, frame in (("first", window.history[0]), ("second", window.future[0]), ("target", window.truth)):
        color = np.maximum(frame.color, 0)
        np.testing.assert_allclose(made[name], np.sqrt(color / (1 + color)), rtol=1e-5, atol=1e-6)
    items = [task.sample(made, key) for key in jax.random.split(jax.random.key(1), 12)]
    whole = {name: np.asarray(value) for name, value in made.items()}
    turned = 0
    for item in items:
        places = [
            (r, c) for r in range(17) for c in range(25)
            if np.array_equal(whole["target"][r : r + 16, c : c + 24], item["target"])
        ]  # fmt: skip
        ((r, c),) = places
        cut = {name: value[r : r + 16, c : c + 24] for name, value in whole.items()}
        backward = np.array_equal(item["first"], cut["second"])
        first, second = ("second", "first") if backward else ("first", "second")
        assert np.array_equal(item["first"], cut[first])
        assert np.array_equal(item["second"], cut[second])
        turned += backward
    assert 0 < turned < 12


def test_the_loss_is_charbonnier(model):
    task = InterpolatorTask(OPTIONS)
    made = jax.jit(task._prepare)(make_window(), jax.random.key(0))
    batch = jax.tree.map(lambda leaf: leaf[None], made)
    loss, _ = nnx.jit(task.loss)(model, batch)
    answer = np.float64(nnx.jit(Interpolator.__call__)(model, batch["first"], batch["second"], jnp.full(1, 0.5)))
    np.testing.assert_allclose(loss, np.sqrt((answer - batch["target"]) ** 2 + 1e-6).mean(), rtol=1e-5)


def test_shipped_configuration_and_errors():
    config = load_config("interpolator_cpu")
    assert isinstance(config.options, InterpolatorOptions)
    assert config.options.windows.motion == "direct"
    with pytest.raises(ValueError, match=r"options\.crop: expected at most windows\.size"):
        parse_config({"task": "interpolator", "steps": 1, "options": {"crop": [500, 500]}})
    with pytest.raises(ValueError, match=r"options\.epsilon: expected above 0"):
        parse_config({"task": "interpolator", "steps": 1, "options": {"epsilon": 0.0}})


@pytest.mark.slow
def test_a_short_run_learns_and_becomes_a_file(capsys, tmp_path):
    windows = WindowOptions(size=(48, 64), scenes=("walkers",), motion="direct", step=(0.2, 0.4))
    options = dataclasses.replace(OPTIONS, windows=windows, crop=(32, 48))
    config = Config("interpolator", options, steps=120, batch=4, pool=8, steps_per_round=60, log_every=20,
                    checkpoint_every=120, validate_every=120, optimizer=Optimizer(peak_learning_rate=2e-3))  # fmt: skip
    scores = train_and_evaluate(config, tmp_path / "run")
    assert set(scores) >= {"psnr", "blend"}
    assert np.isfinite(list(scores.values())).all()
    source, output = str(tmp_path / "run/model"), str(tmp_path / "a.npz")
    assert main(["import-weights", source, "--output", output, "--note", "short"]) == 0
    assert "--weights interpolator=" in capsys.readouterr().out
    (path,) = tmp_path.glob("a-*.npz")
    window = make_window()
    images = [
        jx.load("interpolator", weights=w)(window.history, window.target, window.future)
        for w in (path, tmp_path / "run/model")
    ]
    assert np.array_equal(*images)
    assert main(["import-weights", source, "--output", str(tmp_path / "b.npz"), "--half"]) == 0
    (half,) = tmp_path.glob("b-*.npz")
    assert half.stat().st_size < 0.6 * path.stat().st_size + 20_000
    rounded = jx.load("interpolator", weights=half)(window.history, window.target, window.future)
    np.testing.assert_allclose(rounded, images[0], atol=0.02)
    with pytest.raises(ValueError, match="weights of method 'interpolator', expected 'guided_net'"):
        jx.load("guided_net", weights=path)
