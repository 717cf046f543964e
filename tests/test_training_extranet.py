"""Training of ExtraNet: what an example holds, what counts in the loss, that the trained network is the method's."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from scipy import ndimage
from synthetic import make_frame

import jaxtrapolate as jx
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.windows import Window, hide
from jaxtrapolate.files import write_unreal_frame
from jaxtrapolate.methods.extranet import Preparation, extranet, extranet_config
from jaxtrapolate.methods.guided_net import NETWORK, PREPARATION
from jaxtrapolate.networks.extranet import ExtraNet, ExtraNetConfig
from jaxtrapolate.records import replace
from jaxtrapolate.training import (
    Config,
    ExtraNetOptions,
    ExtraNetTask,
    InterpolatorOptions,
    InterpolatorTask,
    Optimizer,
    load_config,
    train_and_evaluate,
)
from jaxtrapolate.training.config import parse_config
from jaxtrapolate.training.windows import WindowOptions
from jaxtrapolate.weights import default_weights, read_weights

SMALL = ExtraNetConfig(widths=(4, 6))
OPTIONS = ExtraNetOptions(network=SMALL, windows=WindowOptions(size=(32, 40)), crop=(16, 24), validation=2)


def make_window(seed=0):
    frames = [jax.tree.map(jnp.asarray, make_frame(seed + k)) for k in range(6)]
    history = tuple(hide(frame) if k % 2 else frame for k, frame in enumerate(frames[:5]))
    return Window(number=5, truth=frames[5], history=history, target=hide(frames[5]), future=())


@functools.cache
def example(**changes):
    """An example, prepared by a task whose options are changed."""
    task = ExtraNetTask(dataclasses.replace(OPTIONS, **changes))
    return task, jax.jit(task._prepare)(make_window(), jax.random.key(0))


def test_the_right_answer_gives_the_true_frame():
    """The target, decoded and modulated, is the truth; the sky is left out."""
    _, made = example()
    truth, target = make_window().truth, np.asarray(made["target"])
    sky = (
        np.asarray(truth.gbuffer.sky)[..., 0] > 0.5
        if truth.gbuffer.sky is not None
        else np.zeros(target.shape[:2], bool)
    )
    assert np.isnan(target[sky]).all()
    image = np.expm1(target) * np.asarray(made["divisor"])
    np.testing.assert_allclose(image[~sky], np.asarray(truth.color)[~sky], rtol=1e-5, atol=1e-6)


def test_an_example_is_what_the_method_shows_its_network():
    task, made = example()
    window = make_window()
    model = task.init(nnx.Rngs(3))
    model.eval()
    method = extranet(model, preparation=OPTIONS.preparation)
    values = method.values_before("network", method.state, (), window.history, window.target)
    for name, value in values["inputs"].items():
        found = np.moveaxis(np.asarray(made[name]), 2, 0) if name == "history" else made[name]
        np.testing.assert_allclose(found, value, rtol=1e-5, atol=1e-6, err_msg=name)


def curve(light):
    """sqrt(x / (1 + x)) begun at 0.001, straight below 0."""
    lit = np.maximum(light, 0) + 1e-3
    return np.sqrt(lit / (1 + lit)) + np.minimum(light, 0) * 0.5 / np.sqrt(1e-3)


def answer_of(model, made):
    """The network's answer to an example, in float64."""
    given = (made["x"], made["mask"], made["features"], jnp.moveaxis(made["history"], 2, 0))
    return np.float64(nnx.jit(ExtraNet.__call__)(model, *(array[None] for array in given))[0])


@pytest.mark.parametrize("space", ["log", pytest.param("display", marks=pytest.mark.slow)])
def test_the_loss_is_that_of_the_paper(space):
    """In float64: l1 + hole + the largest tenth, of what is no sky; display: after a tone curve of the image."""
    task, made = example(space=space)
    batch = jax.tree.map(lambda leaf: leaf[None], made)
    model = task.init(nnx.Rngs(0))
    model.eval()
    total, parts = nnx.jit(task.loss)(model, batch)
    answer = answer_of(model, made)
    truth, divisor, mask = (np.float64(made[name]) for name in ("target", "divisor", "mask"))
    known = np.isfinite(truth)
    if space == "display":
        answer, truth = (curve(np.expm1(light) * divisor) for light in (answer, truth))
    error = np.where(known, np.abs(answer - truth), 0)
    hole = np.broadcast_to(1 - mask, error.shape) * known
    count = known[..., 0].sum()
    top = [np.sort(error[..., c][known[..., c]])[::-1][: int(0.1 * count)].mean() for c in range(3)]
    expected = {
        "l1": error.sum() / known.sum(),
        "hole": (error * hole).sum() / max(hole.sum(), 1),
        "shade": np.mean(top),
    }
    for name, value in expected.items():
        np.testing.assert_allclose(parts[name], value, rtol=2e-4, err_msg=name)
    np.testing.assert_allclose(total, sum(expected.values()), rtol=2e-4)


@pytest.mark.parametrize("space, margin", [("log", 0), pytest.param("display", 2, marks=pytest.mark.slow)])
def test_the_relative_loss_is_what_is_left_of_the_first_guess(space, margin):
    """Of all, and of holes once more."""
    task, made = example(space=space, loss="relative", hole_weight=0.5, hole_margin=margin)
    batch = jax.tree.map(lambda leaf: leaf[None], made)
    model = task.init(nnx.Rngs(0))
    model.eval()
    images = [answer_of(model, made), *(np.float64(a) for a in (made["x"][..., :3], made["target"]))]
    if space == "display":
        images = [curve(np.expm1(light) * np.float64(made["divisor"])) for light in images]
    errors = [(image - images[2]) ** 2 for image in images[:2]]
    masked = np.asarray(made["mask"])[..., 0] < 0.5
    wider = ndimage.maximum_filter(masked, 2 * margin + 1, mode="constant")
    assert margin == 0 or wider.sum() > masked.sum()
    hole = np.broadcast_to(wider[..., None], errors[0].shape)
    assert 0 < hole.sum() < hole.size
    whole, holes = ([np.nanmean(error[where]) for error in errors] for where in (np.ones_like(hole), hole))
    (left, before), (left_holes, before_holes) = whole, holes
    expected = {"whole": left / (before + 1e-6), "hole": left_holes / (before_holes + 1e-5)}
    total, parts = nnx.jit(task.loss)(model, batch)
    for name, value in expected.items():
        np.testing.assert_allclose(parts[name], value, rtol=1e-3)
    np.testing.assert_allclose(total, expected["whole"] + 0.5 * expected["hole"], rtol=1e-3)


@pytest.mark.slow
def test_crops_by_error():
    """As likely around a pixel as its squared error is large, in holes more so; the weight is no part of the batch."""
    task, made = example(crops="error", space="display", crop=(4, 4), hole_weight=0.0)
    light = (np.float64(made[name]) for name in ("x", "target"))
    guess, truth = (curve(np.expm1(a[..., :3]) * np.float64(made["divisor"])) for a in light)
    error = np.nan_to_num(((guess - truth) ** 2).mean(-1))
    np.testing.assert_allclose(made["weight"][..., 0], error, rtol=1e-2, atol=1e-7)
    keys = jax.random.split(jax.random.key(0), 400)
    assert "weight" not in task.sample(made, keys[0])
    marked = {"place": jnp.stack(jnp.meshgrid(jnp.arange(48.0), jnp.arange(32.0)), -1)}
    marked |= {"weight": made["weight"], "mask": made["mask"]}

    def held(by, of):
        corners = np.asarray(jax.vmap(lambda key: by.sample(marked, key)["place"][0, 0])(keys))
        return np.mean([of[int(y) : int(y) + 4, int(x) : int(x) + 4].sum() for x, y in corners])

    anywhere = np.mean([error[r : r + 4, c : c + 4].sum() for r in range(29) for c in range(45)])
    assert held(task, error) > 1.2 * anywhere
    holes = np.where(np.asarray(made["mask"])[..., 0] < 0.5, error, 0)
    more = ExtraNetTask(dataclasses.replace(task.options, hole_weight=50.0))
    assert held(more, holes) > 1.2 * held(task, holes)


@pytest.mark.slow
def test_the_sky_has_no_gradient():
    task, made = example()
    made = made | {"target": made["target"].at[:16].set(jnp.nan)}
    graph, weights, rest = nnx.split(task.init(nnx.Rngs(0)), nnx.Param, ...)

    def loss(x):
        return task.loss(
            nnx.merge(graph, weights, rest, copy=True), jax.tree.map(lambda leaf: leaf[None], made | {"x": x})
        )[0]

    gradient = np.asarray(jax.grad(loss)(made["x"]))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient[16:]).max() > 0


@pytest.mark.slow
def test_a_scene_without_albedo_or_sky():
    window = make_window()

    def strip(frame):
        return replace(frame, gbuffer=replace(frame.gbuffer, albedo=None, sky=None, sky_color=None))

    bare = Window(5, strip(window.truth), tuple(map(strip, window.history)), strip(window.target), ())
    made = jax.jit(ExtraNetTask(OPTIONS)._prepare)(bare, jax.random.key(0))
    np.testing.assert_allclose(made["target"], np.log1p(np.maximum(window.truth.color, 0)), rtol=1e-6)
    np.testing.assert_array_equal(made["divisor"], 1)


def test_shipped_configurations():
    for name in ("extranet", "guided_net", "guided_net_cpu", "guided_net_more"):
        config = load_config(name)
        assert isinstance(config.options, ExtraNetOptions)
        multiple = config.options.network.multiple
        assert all(side % multiple == 0 for side in config.options.crop)


def test_fine_tuning_fits_the_default_weights():
    stated = read_weights(default_weights("guided_net")).config
    options = load_config("guided_net_more").options
    for network, preparation in ((options.network, options.preparation), (NETWORK, PREPARATION)):
        assert stated == json.loads(json.dumps(extranet_config(network, preparation)))  # tuples are lists there


@pytest.mark.parametrize(
    ("task", "options"), [(ExtraNetTask, ExtraNetOptions), (InterpolatorTask, InterpolatorOptions)]
)
@pytest.mark.slow
def test_dumps_of_another_size_are_refused(tmp_path, task, options):
    """Before anything is rendered, with what is to be set."""
    for time in range(8):
        write_unreal_frame(tmp_path, "Wall", time, make_frame(time, (32, 40)))
    windows = WindowOptions(size=(64, 64), dumps=(str(tmp_path),))
    with pytest.raises(InputError, match=r"its frames are \[32, 40\], options.windows.size is \[64, 64\]"):
        task(options(windows=windows, crop=(32, 32)))
    assert task(options(windows=dataclasses.replace(windows, size=(32, 40)), crop=(32, 32))).about["method"]


def test_errors():
    with pytest.raises(ValueError, match=r"options\.crop: expected at most windows\.size"):
        parse_config({"task": "extranet", "steps": 1, "options": {"crop": [500, 500]}})
    with pytest.raises(ValueError, match=r"options\.space: expected one of 'log', 'display', got 'srgb'"):
        parse_config({"task": "extranet", "steps": 1, "options": {"space": "srgb"}})
    with pytest.raises(ValueError, match=r"options\.preparation.first_guess"):
        parse_config({"task": "extranet", "steps": 1, "options": {"preparation": {"first_guess": "best"}}})


@pytest.mark.slow
def test_a_short_run_learns_and_its_weights_load(tmp_path):
    """On one embedded scene the loss falls, and `load` takes what the run leaves."""
    windows = WindowOptions(size=(48, 64), scenes=("still", "walkers"))
    options = ExtraNetOptions(
        network=SMALL, windows=windows, crop=(32, 48), validation=2, preparation=Preparation(first_guess="guided")
    )
    config = Config("guided_net", options, steps=120, batch=4, pool=8, steps_per_round=60, log_every=20,
                    checkpoint_every=120, validate_every=120, optimizer=Optimizer(peak_learning_rate=3e-3))  # fmt: skip
    scores = train_and_evaluate(config, tmp_path)
    assert set(scores) == {"gain", "psnr", "psnr_hole", "guess", "guess_hole"}
    lines = [line for line in (tmp_path / "metrics.jsonl").read_text().splitlines() if '"train"' in line]
    losses = [float(line.split('"loss": ')[1].split(",")[0]) for line in lines]
    assert np.mean(losses[-2:]) < 0.7 * losses[0]
    method = jx.load("guided_net", weights=tmp_path / "model")
    window = make_window()
    image = method(window.history, window.target)
    assert np.isfinite(image).all()
    assert "guided warp" in [stage.name for stage in method.stages]
