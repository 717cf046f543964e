"""Training of FRNet: what its examples hold, its loss written out, its configuration, and a few steps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from small_extranet import make_window, random_model

import jaxtrapolate as jx
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.windows import Window
from jaxtrapolate.methods.extrass import Refinement
from jaxtrapolate.networks import FRNet, FRNetConfig
from jaxtrapolate.networks.inference import inference
from jaxtrapolate.records import replace
from jaxtrapolate.training import Config, Optimizer, load_config, train_and_evaluate
from jaxtrapolate.training.config import make_task, parse_config
from jaxtrapolate.training.extrass_losses import census_loss, feature_census_loss
from jaxtrapolate.training.frnet import FRNetOptions, FRNetTask
from jaxtrapolate.training.windows import WindowOptions

SMALL = FRNetConfig(widths=(4, 6))
OPTIONS = FRNetOptions(network=SMALL, windows=WindowOptions(size=(36, 44)), crop=(12, 16), validation=2)


@pytest.fixture(scope="module")
def example():
    """A task, a random window of an odd size, and what the task makes of it."""
    history, target = make_window((25, 33), rendered=3)
    color = jnp.asarray(np.random.default_rng(9).uniform(0, 3, (25, 33, 3)), jnp.float32)
    window = Window(0, replace(target, color=color), history, target, ())
    task = FRNetTask(OPTIONS)
    return task, window, jax.jit(task._prepare)(window, jax.random.key(0))


@pytest.mark.slow
def test_an_example_is_what_the_method_shows_and_the_truth(example):
    task, window, made = example
    method = task._stages
    values = method.values_before("network", method.state, (), window.history, window.target)
    for name, value in zip(("newer", "older", "roughness"), values["inputs"], strict=True):
        np.testing.assert_allclose(made[name], value, rtol=1e-4, atol=1e-5)
    light = np.float64(window.truth.color)[::2, ::2]
    sky = np.asarray(window.target.gbuffer.sky)[::2, ::2, 0] > 0.5
    assert np.isnan(made["target"][sky]).all()
    np.testing.assert_allclose(made["target"][~sky], np.sqrt(light / (1 + light))[~sky], rtol=1e-5)


@pytest.mark.slow
def test_the_loss_written_out(example):
    task, _, made = example
    model = random_model(SMALL, FRNet)
    batch = jax.tree.map(lambda a: jnp.stack([a, a[::-1]]), made)
    total, parts = nnx.jit(task.loss)(model, batch)
    found = nnx.jit(FRNet.__call__)(model, batch["newer"], batch["older"], batch["roughness"])
    target = np.asarray(batch["target"])
    errors = np.float64(found.image) - target
    charbonnier = np.mean([np.sqrt(e[np.isfinite(e)] ** 2 + 1e-6).mean() for e in errors])
    np.testing.assert_allclose(parts["charbonnier"], charbonnier, rtol=1e-5)
    census = np.mean([census_loss(a, b) for a, b in zip(found.image, batch["target"], strict=True)])
    np.testing.assert_allclose(parts["census"], census, rtol=1e-5)
    truth = jnp.where(jnp.isfinite(batch["target"]), batch["target"], batch["newer"])
    pyramid = nnx.jit(FRNet.features)(model, truth, batch["roughness"], found.mean)
    feature = np.mean([feature_census_loss([found.features[0][k]], [pyramid[0][k]]) for k in (0, 1)])
    np.testing.assert_allclose(parts["feature"], feature, rtol=1e-4)
    np.testing.assert_allclose(total, charbonnier + census + 0.001 * feature, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("taken", ["change", "flow"])
def test_the_blend_that_is_trained_is_the_frame_that_the_method_makes(example, taken):
    _, window, _ = example
    preparation = Refinement(modulated=False, taken=taken, changed=0.0)
    options = dataclasses.replace(OPTIONS, preparation=preparation, loss="blend", crops="error", crop=(8, 8))
    task, model = FRNetTask(options), random_model(SMALL, FRNet)
    made = jax.jit(task._prepare)(window, jax.random.key(0))
    batch = jax.tree.map(lambda a: a[None], made)
    found = nnx.jit(FRNet.__call__)(model, batch["newer"], batch["older"], batch["roughness"])
    blended, truth, guess = (np.float64(a)[0, :25, :33] for a in task._blended(found, batch))
    method = task._stages.with_weights(inference(model)[1])
    image = np.maximum(np.float64(jax.jit(method.__call__)(window.history, window.target)), 0)
    known = np.isfinite(truth)
    assert np.mean(np.abs(blended - guess)) > 1e-3
    np.testing.assert_allclose(blended[known], np.sqrt(image / (1 + image))[known], atol=1e-5)
    light = np.float64(window.truth.color)
    np.testing.assert_allclose(truth[known], np.sqrt(light / (1 + light))[known], rtol=1e-5)
    np.testing.assert_array_equal(~known.any(-1), np.asarray(window.target.gbuffer.sky)[..., 0] > 0.5)
    share = np.square(blended - truth)[known].sum() / (np.square(guess - truth)[known].sum() + 1e-6 * known.sum())
    np.testing.assert_allclose(task.loss(model, batch)[0], share, rtol=1e-4)
    cut = task.sample(made, jax.random.key(1))
    assert cut["own"].shape == (8, 8, 12)


def test_configuration_and_errors():
    config = load_config("extrass_refine")
    assert isinstance(config.options, FRNetOptions)
    assert config.options.feature_weight == 0.001
    with pytest.raises(
        ValueError, match=r"options\.crop: expected at most windows\.size = \[96, 128\], got \[97, 20\]"
    ):
        parse_config({"task": "extrass_refine", "steps": 1, "options": {"crop": [97, 20]}})
    with pytest.raises(ValueError, match=r"options\.feature_weight: expected at least 0"):
        parse_config({"task": "extrass_refine", "steps": 1, "options": {"feature_weight": -1.0}})
    with pytest.raises(InputError, match='options: taken: "flow" is of a network that moves the newer frame alone'):
        make_task(parse_config({"task": "extrass_refine", "steps": 1, "options": {
            "network": {"merge": True}, "preparation": {"taken": "flow"}}}))  # fmt: skip
    with pytest.raises(ValueError, match='crops: "error" is of the loss "blend"'):
        parse_config({"task": "extrass_refine", "steps": 1, "options": {"crops": "error"}})
    assert load_config("extrass_refine_blend").options.preparation.changed == 0


@pytest.mark.slow
def test_two_steps_become_weights(tmp_path):
    windows = WindowOptions(size=(36, 44), scenes=("walkers",), step=(0.2, 0.4))
    options = dataclasses.replace(OPTIONS, windows=windows, validation=1)
    config = Config("extrass_refine", options, steps=2, batch=2, pool=2, steps_per_round=2, log_every=1,
                    checkpoint_every=2, validate_every=2, optimizer=Optimizer(peak_learning_rate=1e-4))  # fmt: skip
    scores = train_and_evaluate(config, tmp_path / "run")
    assert set(scores) >= {"psnr", "warp", "gain"}
    assert np.isfinite(list(scores.values())).all()
    history, target = make_window((9, 13), rendered=2)
    method = jx.load("extrass_refine", weights=tmp_path / "run/model")
    assert np.isfinite(method(history, target)).all()
