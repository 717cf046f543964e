"""FRNet and ExtraSSNet: flows set by hand against an oracle's warp, any size, what holds for any weights."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from flax import nnx
from marks import slow
from oracles import random
from small_extranet import random_model

from jaxtrapolate.networks import ExtraSSNet, ExtraSSNetConfig, FRNet, FRNetConfig, inference
from jaxtrapolate.networks.blocks import pixel_shuffle, pixel_unshuffle
from jaxtrapolate.ops.upsample import upsample

FLOW, MERGED = FRNetConfig(widths=(4, 6)), FRNetConfig(widths=(4, 6), merge=True, roughness=False)
LED = FRNetConfig(widths=(4, 6), led=True)
SAMPLER = ExtraSSNetConfig(widths=(4, 6), bottleneck=8)


@pytest.mark.parametrize("factor", [2, 3])
def test_unshuffle_against_a_loop_and_back(factor):
    x = random(1, 2 * factor, 3 * factor, 5)
    found = pixel_unshuffle(jnp.asarray(x), factor)
    for r, c in np.ndindex(2, 3):
        part = x[0, r * factor : (r + 1) * factor, c * factor : (c + 1) * factor]
        np.testing.assert_array_equal(found[0, r, c], part.reshape(-1))
    np.testing.assert_array_equal(pixel_shuffle(found, factor), x)


def silent(model):
    """A copy whose decoders predict nothing."""
    model = nnx.clone(model)
    for decoder in model.decoders:
        decoder.head.feature.kernel[...] = jnp.zeros_like(decoder.head.feature.kernel[...])
        decoder.head.feature.bias[...] = jnp.zeros_like(decoder.head.feature.bias[...])
    return model


def predict(decoder, values):
    """Let a decoder predict these values in its first channels, at all pixels."""
    bias = np.zeros((4, decoder.head.feature.bias.shape[0] // 4), np.float32)
    bias[:, : len(values)] = values
    decoder.head.feature.bias[...] = jnp.asarray(bias.reshape(-1))


def frames(height, width):
    return [jnp.asarray(random(height, width, n, seed=k)) for k, n in enumerate((3, 3, 1))]


@pytest.fixture(scope="module")
def models():
    return {config: random_model(config, FRNet) for config in (FLOW, MERGED, LED)}


@pytest.mark.parametrize("level", [0, 1])
def test_the_flow_warps_the_newer_frame_alone(models, level):
    """A flow predicted at a level is in that level's pixels, and doubled with it."""
    model, flow = silent(models[FLOW]), np.array([1.5, -0.75])
    predict(model.decoders[level], flow / 2 if level == 0 else flow)
    newer, older, roughness = frames(8, 12)
    function, state = inference(model)
    found = function(state, newer, older, roughness)
    np.testing.assert_allclose(found.flow, np.broadcast_to(flow, (8, 12, 2)), atol=1e-6)
    expected = oracles.backward_warp(np.asarray(newer), np.broadcast_to(flow, (8, 12, 2)))
    np.testing.assert_allclose(found.image, expected, atol=1e-5)


def test_led_by_a_flow(models):
    """What it begins with is the flow as far as it is trusted; what it says by itself is added."""
    model, flow = silent(models[LED]), np.array([1.25, -0.5])
    function, state = inference(model)
    newer, older, roughness = frames(7, 11)
    rng = np.random.default_rng(3)
    lead = np.concatenate([rng.uniform(-3, 3, (7, 11, 2)), rng.uniform(size=(7, 11, 1))], -1).astype(np.float32)
    trusted = lead[..., :2] * lead[..., 2:]
    found = function(state, newer, older, roughness, lead)
    np.testing.assert_allclose(found.flow, trusted, atol=1e-6)
    np.testing.assert_allclose(found.image, oracles.backward_warp(np.asarray(newer), trusted), atol=1e-5)
    predict(model.decoders[1], flow)
    function, state = inference(model)
    np.testing.assert_allclose(function(state, newer, older, roughness, lead).flow, trusted + flow, atol=1e-6)
    with pytest.raises(ValueError, match="lead"):
        function(state, newer, older, roughness)
    function, state = inference(models[FLOW])
    with pytest.raises(ValueError, match="lead: expected None, as this network's configuration is not led"):
        function(state, newer, older, roughness, lead)


def test_merged_by_hand(models):
    model, flows, logit = silent(models[MERGED]), np.array([1.0, -0.5, -2.0, 0.25]), 0.7
    predict(model.decoders[1], [*flows, logit])
    newer, older, _ = frames(5, 7)
    function, state = inference(model)
    found = function(state, newer, older, None)
    a, b = (
        oracles.backward_warp(np.asarray(frame), np.broadcast_to(flow, (5, 7, 2)))
        for frame, flow in ((newer, flows[:2]), (older, flows[2:]))
    )
    share = 1 / (1 + np.exp(-logit))
    np.testing.assert_allclose(found.image, share * a + (1 - share) * b, atol=1e-5)


def test_predicted_features_are_of_the_pyramids_shapes():
    """Three levels of four, to be compared with those of the truth."""

    def run(newer, older, roughness):
        model = FRNet(rngs=nnx.Rngs(0))
        found = model(newer, older, roughness)
        return found.features, model.features(newer, roughness, found.mean)

    shapes = [jax.ShapeDtypeStruct((2, 33, 18, n), jnp.float32) for n in (3, 3, 1)]
    predicted, pyramid = nnx.eval_shape(run, *shapes)
    assert len(predicted) == 3
    assert [a.shape for a in predicted] == [a.shape for a in pyramid[:3]]


def parameters(build):
    return sum(p.size for p in jax.tree.leaves(nnx.state(nnx.eval_shape(build), nnx.Param)))


def test_numbers_of_parameters():
    assert parameters(lambda: FRNet(rngs=nnx.Rngs(0))) == 811808
    assert parameters(lambda: ExtraSSNet(rngs=nnx.Rngs(0))) == 2083492


@pytest.mark.parametrize("size", [(5, 3), *slow((1, 1), (13, 27))])
@pytest.mark.parametrize("config", [FLOW, MERGED], ids=["flow", "merged"])
def test_frnet_of_any_size(models, config, size):
    function, state = inference(models[config])
    newer, older, roughness = frames(*size)
    found = function(state, newer, older, roughness if config.roughness else None)
    assert found.image.shape == (*size, 3)
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(found))


def inputs(height, width, scale=2, *, generated):
    shapes = [(height, width, 3), (scale * height, scale * width, 3), (height, width, 1), (2,)]
    shapes += [(height, width, 3)] * 2 if generated else []
    return [jnp.asarray(random(*shape, seed=k)) for k, shape in enumerate(shapes)]


@pytest.mark.parametrize(
    "size, config",
    [
        ((5, 3), SAMPLER),
        pytest.param((1, 1), SAMPLER, marks=pytest.mark.slow),
        pytest.param((13, 27), ExtraSSNetConfig(widths=(4, 6), bottleneck=8, skips="concatenate", scale=3),
                     marks=pytest.mark.slow),
        pytest.param((7, 5), ExtraSSNetConfig(widths=(4,), bottleneck=8, scale=1), marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_extrassnet_of_any_size_and_scale(size, config):
    function, state = inference(random_model(config, ExtraSSNet))
    answers = [function(state, *inputs(*size, config.scale, generated=g)) for g in (False, True)]
    for found in answers:
        assert found.image.shape == (config.scale * size[0], config.scale * size[1], 3)
        assert np.isfinite(found.image).all()
    rendered, generated = ([f.shape for f in found.features] for found in answers)
    assert rendered == generated  # so that they can be compared


@pytest.mark.parametrize("generated", [False, True])
def test_without_a_residual_it_is_the_upsampled_input(generated):
    model = random_model(SAMPLER, ExtraSSNet)
    model.output.feature.kernel[...] = jnp.zeros_like(model.output.feature.kernel[...])
    model.output.feature.bias[...] = jnp.zeros_like(model.output.feature.bias[...])
    function, state = inference(model)
    given = inputs(6, 5, generated=generated)
    found = function(state, *given)
    np.testing.assert_allclose(found.image, upsample(given[0], jitter=given[3]), atol=1e-6)


@pytest.mark.slow
def test_each_kind_of_frame_has_an_encoder_and_both_one_decoder():
    model = random_model(SAMPLER, ExtraSSNet)

    @nnx.jit
    def used(model, given):
        def total(model):
            return jnp.sum(jnp.square(model(*(a[None] for a in given)).image))

        return jax.tree.map(lambda g: jnp.any(g != 0), nnx.to_pure_dict(nnx.state(nnx.grad(total)(model))))

    for generated in (False, True):
        found = {
            k: any(map(bool, jax.tree.leaves(v))) for k, v in used(model, inputs(5, 6, generated=generated)).items()
        }
        assert found == {
            "rendered": not generated,
            "generated": generated,
            "bottom": True,
            "decoder": True,
            "output": True,
        }


def test_no_implicit_promotion(strict):
    def train(build, config, given):
        model = build(config, rngs=nnx.Rngs(0))
        return nnx.grad(lambda model: jnp.mean(model(*given).image))(model)

    images = [jnp.zeros((2, 5, 6, n)) for n in (3, 3, 1)]
    nnx.eval_shape(lambda: train(FRNet, FLOW, images))
    nnx.eval_shape(lambda: train(FRNet, MERGED, images[:2]))
    for generated in (False, True):
        given = [a[None] for a in inputs(5, 6, generated=generated)]
        nnx.eval_shape(lambda given=given: train(ExtraSSNet, SAMPLER, given))


def test_errors(unchecked, models):
    image = jnp.zeros((1, 4, 5, 3))
    with pytest.raises(ValueError, match=r"older: expected shape \[1, 4, 5, 3\], got \[1, 4, 4, 3\]"):
        models[FLOW](image, image[:, :, :4], image[..., :1])
    with pytest.raises(ValueError, match="roughness: absent"):
        models[FLOW](image, image)
    with pytest.raises(ValueError, match="skips: expected one of 'concatenate', 'add', got 'multiply'"):
        ExtraSSNetConfig(skips="multiply")
    with pytest.raises(ValueError, match="scale: expected a whole number from 1 on, got 0"):
        ExtraSSNetConfig(scale=0)
    model = random_model(SAMPLER, ExtraSSNet)
    with pytest.raises(ValueError, match=r"history: expected shape \[1, 8, 10, 3\], got \[1, 4, 5, 3\]"):
        model(image, image, image[..., :1], jnp.zeros((1, 2)))
