"""Training of ExtraSSNet: what its examples hold, its loss written out, parts that are frozen, and two steps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from flax import nnx
from oracles import random
from small_extranet import random_model

import jaxtrapolate as jx
from jaxtrapolate.errors import InputError
from jaxtrapolate.networks import ExtraSS, ExtraSSConfig, ExtraSSNetConfig, FRNetConfig
from jaxtrapolate.networks.blocks import pixel_shuffle
from jaxtrapolate.ops.upsample import upsample
from jaxtrapolate.scenes import render, scene
from jaxtrapolate.training import Config, Optimizer, load_config, train_and_evaluate
from jaxtrapolate.training.config import parse_config
from jaxtrapolate.training.extrass import ExtraSSOptions, ExtraSSTask, _answers
from jaxtrapolate.training.extrass_losses import slope_loss
from jaxtrapolate.training.step import make_step
from jaxtrapolate.training.tasks import round_key

SAMPLER = ExtraSSNetConfig(widths=(4, 6), bottleneck=8)
OPTIONS = ExtraSSOptions(sampler=SAMPLER, size=(12, 17), scenes=("walkers",), samples=2, crop=(8, 9),
                         perceptual="slopes", validation=1)  # fmt: skip


def batch(height=8, width=9):
    """What `pool` would hold of two examples, of random numbers."""
    channels = {"before": 3, "color": 3, "refined": 3, "guided": 3, "albedo": 3, "depths": 2, "truths": 24,
                "history": 12}  # fmt: skip
    arrays = {name: random(2, height, width, n, seed=k) for k, (name, n) in enumerate(channels.items())}
    shifts = np.float32([[0.1, -0.2, 0.3, 0.4], [-0.4, 0.0, 0.2, -0.1]])
    arrays["jitters"] = np.broadcast_to(shifts[:, None, None], (2, height, width, 4))
    arrays["motions"] = np.broadcast_to(np.float32([0.5, 1.0] * 4 + [1.5, -2.0] * 4), (2, height, width, 16))
    arrays["history"][1] = np.nan  # the second one has none
    arrays["holes"] = (random(2, height, width, 1, seed=20) > 0.8).astype(np.float32)
    return {name: jnp.asarray(value) for name, value in arrays.items()}


@pytest.fixture(scope="module")
def model():
    return random_model(ExtraSSConfig(FRNetConfig(widths=(4, 6)), SAMPLER), ExtraSS)


def test_the_answers_and_their_history(model):
    given = batch()
    shown = nnx.jit(_answers)(model, given)
    sampler = nnx.jit(lambda model, *a: model.sampler(*a))
    up = jax.vmap(lambda image, jitter: upsample(image, jitter=jitter))
    jitters = given["jitters"][:, 0, 0]
    older = np.broadcast_to(np.float32([0.5, 1.0]), (16, 18, 2))
    fetched = oracles.backward_warp(np.asarray(pixel_shuffle(given["history"])[0]), older)
    seen = oracles.in_frame(older)[..., None]
    larger = up(given["before"], jitters[:, :2])
    history = jnp.stack([jnp.where(seen, fetched, larger[0]), larger[1]]).astype(jnp.float32)
    first = sampler(model, given["before"], history, given["depths"][..., :1], jitters[:, :2])
    np.testing.assert_allclose(shown["before"].image, first.image, rtol=1e-4, atol=1e-5)
    motion = np.broadcast_to(np.float32([1.5, -2.0]), (16, 18, 2))
    warped = np.stack([oracles.backward_warp(np.asarray(image), motion) for image in first.image])
    np.testing.assert_allclose(shown["warped"], warped, atol=1e-4)
    inside = oracles.in_frame(motion)[None, ..., None]
    history = jnp.where(inside, shown["warped"], up(given["refined"], jitters[:, 2:]))
    more = (given["guided"], given["albedo"])
    second = sampler(model, given["refined"], history, given["depths"][..., 1:], jitters[:, 2:], *more)
    np.testing.assert_allclose(shown["refined"].image, second.image, rtol=1e-3, atol=1e-4)
    np.testing.assert_array_equal(shown["truth"], pixel_shuffle(given["truths"][..., 12:]))
    assert 0.2 < shown["valid"].mean() < 0.9
    assert not np.any(np.asarray(shown["valid"])[~np.broadcast_to(inside, shown["valid"].shape)])


@pytest.mark.slow
@pytest.mark.parametrize("disoccluded", [False, True])
def test_the_loss_written_out(model, disoccluded):
    options = dataclasses.replace(OPTIONS, disoccluded=disoccluded, temporal_weight=0.7, perceptual_weight=0.3,
                                  feature_weight=0.2)  # fmt: skip
    task, given = ExtraSSTask(options), batch()
    total, parts = nnx.jit(task.loss)(model, given)
    shown = jax.tree.map(np.float64, nnx.jit(_answers)(model, given))
    expected = dict.fromkeys(("l1", "occlusion", "perceptual", "temporal"), 0.0)
    for answer, truth in (("before", "truth before"), ("color", "truth"), ("refined", "truth")):
        image, wanted = shown[answer].image, shown[truth]
        expected["l1"] += np.abs(image - wanted).mean() / 3
        slopes = [np.abs(np.diff(image, axis=k) - np.diff(wanted, axis=k)).mean() for k in (1, 2)]
        expected["perceptual"] += sum(slopes) / 3
        if answer != "before":
            holes = shown["valid"][..., 0] == 0
            errors = [np.abs(a - b)[h].mean() for a, b, h in zip(image, wanted, holes, strict=True)]
            expected["occlusion"] += np.mean(errors) / 3
            seen = np.ones_like(holes) if disoccluded else ~holes
            steps = [np.abs(a - b)[s].mean() for a, b, s in zip(image, shown["warped"], seen, strict=True)]
            expected["temporal"] += np.mean(steps) / 2
    features = 0.0
    for a, b in zip(shown["color"].features, shown["refined"].features, strict=True):
        for one, other in zip(a, b, strict=True):
            features += np.abs(one - other).mean() / np.sqrt((np.mean(one**2) + np.mean(other**2)) / 2) / 2
    expected["features"] = features
    for name, value in expected.items():
        np.testing.assert_allclose(parts[name], value, rtol=1e-3, err_msg=name)
    whole = expected["l1"] + expected["occlusion"] + 0.3 * expected["perceptual"]
    np.testing.assert_allclose(total, whole + 0.7 * expected["temporal"] + 0.2 * features, rtol=1e-3)


@pytest.mark.slow
def test_an_example_of_a_scene():
    """Jittered low-resolution frames, the extrapolated one never shown the target, and the supersampled truth."""
    task = ExtraSSTask(OPTIONS)
    jitters = np.random.default_rng(0).uniform(-0.5, 0.5, (len(task._numbers), 2)).astype(np.float32)
    world, time, step = scene("walkers", 5), jnp.float32(7), jnp.float32(0.8)
    made = task._prepared(*task._draw(world, time, step, jnp.asarray(jitters)))
    curve = task._preparation.encode
    for name, number in (("before", -1), ("color", 0)):
        frame = render(world, time + number * step, size=(12, 17), jitter=jnp.asarray(jitters[number - 1]))
        np.testing.assert_allclose(made[name], curve(frame.color), atol=1e-3)
    for k, number in enumerate((-1, 0)):
        frame = render(world, time + number * step, size=(24, 34), samples=2)
        shown = pixel_shuffle(made["truths"][None, ..., 12 * k : 12 * k + 12])[0]
        assert np.mean(np.abs(shown - curve(frame.color)) > 1e-3) < 0.01
    frame = render(world, time, size=(24, 34), previous_time=time - step)
    motion = pixel_shuffle(made["motions"][None, ..., 8:])[0]
    assert np.median(np.abs(motion - frame.motion)) < 0.02
    method, history, carry, image = jx.load("taau"), (), None, None
    for number in range(task._numbers[0], -1):
        now = render(world, time + number * step, size=(12, 17), jitter=jnp.asarray(jitters[number - 1]),
                     previous_time=time + (number - 1) * step)  # fmt: skip
        carry = method.init((), now) if carry is None else carry
        carry, image = method.step(carry, history, now)
        history = (now,)
    shown = pixel_shuffle(made["history"][None])[0]
    assert np.mean(np.abs(shown - curve(image)) > 1e-3) < 0.01
    assert np.abs(made["refined"] - made["color"]).max() > 1e-3
    assert set(np.unique(made["holes"])) <= {0.0, 1.0}


def test_configuration_and_errors():
    config = load_config("extrass")
    assert isinstance(config.options, ExtraSSOptions)
    assert config.frozen == ("frnet",)
    with pytest.raises(ValueError, match=r"options\.samples: expected at least 1, got 0"):
        parse_config({"task": "extrass", "steps": 1, "options": {"samples": 0}})
    with pytest.raises(ValueError, match=r"options\.crop: expected at most windows\.size = \[90, 160\]"):
        parse_config({"task": "extrass", "steps": 1, "options": {"crop": [91, 20]}})
    with pytest.raises(ValueError, match="step: expected \\[least, largest\\] above 0"):
        ExtraSSOptions(step=(0.0, 1.0))


def test_what_is_frozen_has_to_be_a_part_of_the_network():
    config = Config("extrass", OPTIONS, steps=2, frozen=("decoder",))
    with pytest.raises(InputError, match="frozen: the network has no decoder; it has frnet, sampler"):
        make_step(ExtraSSTask(OPTIONS), config)


def test_without_the_package_slopes_stand_in(monkeypatch):
    monkeypatch.setattr("jaxtrapolate.training.extrass.missing_package", lambda extra: f"the package of {extra}")
    task = ExtraSSTask(dataclasses.replace(OPTIONS, perceptual="vgg"))
    assert task._perceptual is slope_loss
    assert "without features of VGG-16" in task.about["note"]


class _Drawn(ExtraSSTask):
    """With numbers for a pool."""

    def pool(self, key, numbers):
        return jax.tree.map(lambda leaf: leaf[: len(numbers)], batch())


@pytest.mark.slow
def test_what_is_frozen_stays():
    """Also with a decay of all weights; and the rest does not."""
    optimizer = Optimizer(peak_learning_rate=1e-2, weight_decay=0.1)
    config = Config("extrass", OPTIONS, steps=2, batch=2, pool=2, frozen=("frnet",), optimizer=optimizer)
    task = _Drawn(OPTIONS)
    step = make_step(task, config)
    state = step.create()
    before = jax.tree.map(np.asarray, nnx.to_pure_dict(state.weights))
    after, _ = step.take(state, task.pool(round_key(0, 0), range(2)))
    after = nnx.to_pure_dict(after.weights)
    same = jax.tree.map(np.array_equal, before, after)
    assert all(jax.tree.leaves(same["frnet"]))
    assert not any(jax.tree.leaves(same["sampler"]["output"]))


@pytest.mark.slow
def test_two_steps_become_weights(tmp_path):
    config = Config("extrass", OPTIONS, steps=2, batch=2, pool=2, steps_per_round=2, log_every=1, checkpoint_every=2,
                    validate_every=2, frozen=("frnet",), optimizer=Optimizer(peak_learning_rate=1e-4))  # fmt: skip
    scores = train_and_evaluate(config, tmp_path / "run")
    assert set(scores) >= {"gain", "psnr_rendered", "psnr_extrapolated", "bilinear_rendered", "bilinear_extrapolated"}
    assert np.isfinite(list(scores.values())).all()
    method = jx.load("extrass", weights=tmp_path / "run/model")
    frame = jx.Frame(color=jnp.asarray(random(5, 7, 3)))
    _, image = method.step(method.init((), frame), (), frame)
    assert image.shape == (10, 14, 3)
    assert np.isfinite(image).all()
