"""Networks: against a float64 network written from the paper, SciPy, the authors' weights and answers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from numpy.lib.stride_tricks import sliding_window_view
from oracles import assert_gradients, random
from scipy.ndimage import zoom
from scipy.signal import correlate2d

from jaxtrapolate.networks import GATED_CONVOLUTION, ExtraNet, ExtraNetConfig, extranet_from_torch, fold, inference
from jaxtrapolate.networks.blocks import HE, Layer, pad_to_multiple, upsample_2x
from jaxtrapolate.weights import read_torch

PAPER = ExtraNetConfig()
SMALL = ExtraNetConfig(widths=(3, 4), features=2, histories=2)


# The network in float64 NumPy, `[H, W, C]`, from the names and the layout of the authors' checkpoint.


def convolve(x, kernel, bias, stride=1):
    """Cross-correlation with kernel `[out, in, k, k]`, k // 2 zeros around the frame."""
    pad = kernel.shape[2] // 2
    windows = sliding_window_view(np.pad(x, ((pad, pad), (pad, pad), (0, 0))), kernel.shape[2:], (0, 1))
    return np.einsum("hwcij,ocij->hwo", windows[::stride, ::stride], kernel) + bias


def bilinear(x, axis):
    """Twice as long, aligned corners, one output after the other."""
    x = np.moveaxis(x, axis, 0)
    n, out = len(x), []
    for k in range(2 * n):
        place = k * (n - 1) / (2 * n - 1)
        lower = min(int(place), max(n - 2, 0))
        out.append(x[lower] * (lower + 1 - place) + x[min(lower + 1, n - 1)] * (place - lower))
    return np.moveaxis(np.stack(out), 0, axis)


def reference(weights, x, mask, features, history):
    w = {name: np.asarray(value, np.float64) for name, value in weights.items()}
    arrays = [a if a is None else np.asarray(a, np.float64) for a in (x, mask, features, history)]
    height, width, _ = x.shape
    downs = sum(1 for name in w if name.endswith("downsample.conv_feature.bias"))
    histories = sum(1 for name in w if name.startswith("convHis") and name.endswith("0.bias"))

    def conv(x, name, stride=1):
        if f"{name}.weight" in w:
            return convolve(x, w[f"{name}.weight"], w[f"{name}.bias"], stride)
        gate = convolve(x, w[f"{name}.conv_mask.0.weight"], w[f"{name}.conv_mask.0.bias"], stride)
        feature = convolve(x, w[f"{name}.conv_feature.weight"], w[f"{name}.conv_feature.bias"], stride)
        return feature / (1 + np.exp(-gate))

    def norm(x, name):
        normal = (x - w[f"{name}.running_mean"]) / np.sqrt(w[f"{name}.running_var"] + 1e-5)
        return np.maximum(normal * w[f"{name}.weight"] + w[f"{name}.bias"], 0)

    def padded(a):
        return np.pad(a, ((0, -height % 2**downs), (0, -width % 2**downs), (0, 0)), "symmetric")

    x, mask, features, history = arrays
    value = padded(np.concatenate([x, x * mask] + ([] if features is None else [features]), -1))
    skips = []
    for k in range(downs + 1):
        prefix = f"down{k}." if k else ""
        if k:
            skips.append(value)
            value = conv(value, f"{prefix}downsample", 2)
        for j in (1, 2):
            value = norm(conv(value, f"{prefix}conv{j}"), f"{prefix}bn{j}")
    if histories:
        codes = []
        for frame in history:
            code = padded(frame)
            for k in range(histories):
                for j in (0, 3, 6):
                    code = norm(conv(code, f"convHis{k + 1}.{j}", 1 if j else 2), f"convHis{k + 1}.{j + 1}")
            codes.append(code)
        value = np.concatenate([value, conv(np.concatenate(codes, -1), "lowlevelGated")], -1)
    for k in range(downs):
        value = np.concatenate([skips.pop(), bilinear(bilinear(value, 0), 1)], -1)
        for j in (0, 3):
            name = f"up{k + 1}.conv.double_conv"
            value = norm(conv(value, f"{name}.{j}"), f"{name}.{j + 1}")
    return x[..., :3] + conv(value, "outc")[:height, :width]


def release_weights(widths=(24, 24, 32, 32), inputs=18, histories=3, full=False, seed=0):
    """Random arrays with the names and shapes of the authors' checkpoint, or of the same with other widths."""
    rng = np.random.default_rng(seed)
    out = {}

    def conv(name, before, after, size=3):
        out[f"{name}.weight"] = rng.normal(0, 1 / np.sqrt(before * size * size), (after, before, size, size))
        out[f"{name}.bias"] = rng.normal(0, 0.1, after)

    def gated(name, before, after):
        conv(f"{name}.conv_feature", before, after)
        conv(f"{name}.conv_mask.0", before, after if full else 1)

    def norm(name, channels):
        out[f"{name}.weight"], out[f"{name}.bias"] = rng.uniform(0.5, 1.5, channels), rng.normal(0, 0.2, channels)
        out[f"{name}.running_mean"] = rng.normal(0, 0.2, channels)
        out[f"{name}.running_var"] = rng.uniform(0.1, 0.5, channels)
        out[f"{name}.num_batches_tracked"] = np.asarray(7)

    for k, after in enumerate(widths):
        prefix, before = f"down{k}." if k else "", widths[k - 1] if k else inputs
        if k:
            gated(f"{prefix}downsample", before, before)
        for j, channels in ((1, before), (2, after)):
            gated(f"{prefix}conv{j}", channels, after)
            norm(f"{prefix}bn{j}", after)
    if histories:
        for k, after in enumerate(widths[1:]):
            for j, channels in ((0, widths[k] if k else 4), (3, after), (6, after)):
                conv(f"convHis{k + 1}.{j}", channels, after)
                norm(f"convHis{k + 1}.{j + 1}", after)
        gated("lowlevelGated", histories * widths[-1], widths[-1])
    below = widths[-1] * (2 if histories else 1)
    for k, skip in enumerate(widths[-2::-1]):
        inputs = skip + below
        for j, before, after in ((0, inputs, inputs // 2), (3, inputs // 2, skip)):
            conv(f"up{k + 1}.conv.double_conv.{j}", before, after)
            norm(f"up{k + 1}.conv.double_conv.{j + 1}", after)
        below = skip
    conv("outc", widths[0], 3, 1)
    return {name: np.asarray(value, np.float32) for name, value in out.items()}


def small_weights(seed=0):
    return release_weights(SMALL.widths, 14, SMALL.histories, seed=seed)


def inputs(height, width, config=PAPER, seed=0):
    """x, mask, features and history, those that the configuration has."""
    mask = (random(height, width, 1, seed=seed + 1) > 0.3).astype(np.float32)
    features = random(height, width, config.features, seed=seed + 2) if config.features else None
    history = random(config.histories, height, width, 4, seed=seed + 3) if config.histories else None
    return random(height, width, 3 * config.warps, seed=seed), mask, features, history


def device(arrays):
    return jax.tree.map(jnp.asarray, arrays)


def parameters(model):
    return sum(p.size for p in jax.tree.leaves(nnx.state(model, nnx.Param)))


# Blocks


@pytest.mark.parametrize("gate", ["none", "light", "full"])
@pytest.mark.parametrize("stride", [1, 2])
def test_layer_against_scipy(gate, stride):
    """Feature and gate by correlate2d with zeros around, the gate's sigmoid, batch norm by its definition, ReLU."""
    layer = Layer(3, 4, gate=gate, stride=stride, rngs=nnx.Rngs(5))
    layer.norm.mean[...], layer.norm.var[...] = jnp.asarray(random(4, seed=1)), jnp.asarray(random(4, seed=2, low=0.1))
    layer.norm.scale[...], layer.norm.bias[...] = jnp.asarray(random(4, seed=3, low=-1)), jnp.asarray(random(4, seed=4))
    layer.eval()
    x = random(7, 10, 3, low=-1)

    def correlate(convolution):
        kernel, bias = (np.asarray(a[...], np.float64) for a in (convolution.kernel, convolution.bias))
        planes = [
            sum(correlate2d(np.float64(x[..., i]), kernel[..., i, o], "same") for i in range(3)) + bias[o]
            for o in range(kernel.shape[3])
        ]
        return np.stack(planes, -1)[::stride, ::stride]

    expected = correlate(layer.feature)
    if gate != "none":
        expected = expected / (1 + np.exp(-correlate(layer.gate)))
    mean, var, scale, bias = (
        np.float64(a[...]) for a in (layer.norm.mean, layer.norm.var, layer.norm.scale, layer.norm.bias)
    )
    expected = np.maximum((expected - mean) / np.sqrt(var + 1e-5) * scale + bias, 0)
    np.testing.assert_allclose(layer(jnp.asarray(x)[None])[0], expected, atol=2e-6)
    folded = fold(layer)
    assert folded.norm is None
    assert layer.norm is not None, "the original was changed"
    np.testing.assert_allclose(folded(jnp.asarray(x)[None])[0], expected, atol=2e-6)


def test_training_moves_the_statistics_as_pytorch_does():
    """A tenth of the batch's mean and variance; the batch is normalised to mean 0 and variance 1."""
    layer = Layer(2, 3, activation="none", rngs=nnx.Rngs(0))
    x = jnp.asarray(random(2, 6, 5, 2) + 100)  # far from 0: the variance must not drown in its mean
    values = np.asarray(layer.feature(x), np.float64)
    layer.train()
    result = np.asarray(layer(x), np.float64)
    np.testing.assert_allclose(layer.norm.mean[...], 0.1 * values.mean((0, 1, 2)), rtol=1e-5)
    np.testing.assert_allclose(layer.norm.var[...], 0.9 + 0.1 * values.var((0, 1, 2)), rtol=1e-4)
    np.testing.assert_allclose(result.mean((0, 1, 2)), 0, atol=1e-3)
    np.testing.assert_allclose(result.var((0, 1, 2)), 1, rtol=1e-2)


def test_initialisation_is_pytorchs():
    """Uniform within 1 / sqrt(fan in), kernel and bias."""
    layer = Layer(16, 400, gate="light", rngs=nnx.Rngs(0))
    for array in (layer.feature.kernel[...], layer.feature.bias[...], layer.gate.kernel[...]):
        limit = 1 / 12  # fan in 16 * 9
        assert np.abs(array).max() <= limit
        assert np.abs(array).max() > 0.95 * limit
        np.testing.assert_allclose(np.std(array), limit / np.sqrt(3), rtol=0.1)


def test_initialisation_with_a_gain_keeps_the_size_of_signals():
    """He et al. 2015: through a ReLU the mean square stays what it was; biases are 0."""
    layer = Layer(64, 64, norm=False, gain=HE, rngs=nnx.Rngs(0))
    assert not np.any(layer.feature.bias[...])
    x = jax.nn.relu(jax.random.normal(jax.random.key(1), (1, 32, 32, 64)))
    inner = layer(x)[:, 1:-1, 1:-1]
    np.testing.assert_allclose(np.mean(np.square(inner)), np.mean(np.square(x)), rtol=0.15)


def test_prelu():
    layer = Layer(1, 2, size=1, norm=False, activation="prelu", rngs=nnx.Rngs(0))
    layer.feature.kernel[...], layer.feature.bias[...] = jnp.asarray([[[[1.0, -1.0]]]]), jnp.zeros(2)
    layer.slope[...] = jnp.asarray([0.5, 0.125])
    x = jnp.asarray([2.0, -2.0]).reshape(1, 1, 2, 1)
    np.testing.assert_array_equal(layer(x)[0, 0], [[2.0, -0.25], [-1.0, 2.0]])


@pytest.mark.parametrize("size", [(5, 7), (2, 3)])
def test_double_against_scipy(size):
    x = random(2, *size, 3)
    np.testing.assert_allclose(upsample_2x(jnp.asarray(x)), zoom(np.float64(x), (1, 2, 2, 1), order=1), atol=1e-6)


def test_double_of_single_rows_and_columns_repeats_them():
    x = random(1, 1, 4, 2)
    wide = upsample_2x(jnp.asarray(x))
    np.testing.assert_array_equal(wide[:, 0], wide[:, 1])
    np.testing.assert_allclose(wide[0, 0], zoom(np.float64(x[0, 0]), (2, 1), order=1), atol=1e-6)
    tall = upsample_2x(jnp.asarray(x.swapaxes(1, 2)))
    np.testing.assert_array_equal(tall, wide.swapaxes(1, 2))
    np.testing.assert_array_equal(upsample_2x(jnp.asarray(x[:, :, :1])), np.broadcast_to(x[:, :, :1], (1, 2, 2, 2)))


@pytest.mark.parametrize("size", [(5, 7), (1, 1), (8, 16), (9, 3)])
def test_padding(size):
    x = random(1, *size, 2)
    expected = np.pad(x, ((0, 0), (0, -size[0] % 8), (0, -size[1] % 8), (0, 0)), "symmetric")
    np.testing.assert_array_equal(pad_to_multiple(jnp.asarray(x), 8), expected)


# ExtraNet


def learned(weights):
    return sum(v.size for name, v in weights.items() if "running" not in name and "num_batches" not in name)


def test_number_of_parameters():
    """The paper's network has 262,141; the shapes are those of the release."""
    model = nnx.eval_shape(lambda: ExtraNet(rngs=nnx.Rngs(0)))
    assert parameters(model) == 262141 == learned(release_weights())
    model = nnx.eval_shape(lambda: ExtraNet(GATED_CONVOLUTION, rngs=nnx.Rngs(0)))
    assert parameters(model) == learned(release_weights(histories=0, full=True))


CONFIGURATIONS = {
    "two levels": (ExtraNetConfig(widths=(3, 4, 5), features=2, histories=2), {"inputs": 14}),
    "without histories": (ExtraNetConfig(widths=(3, 4), features=2, histories=0), {"inputs": 14}),
    "full gates": (ExtraNetConfig(widths=(3, 4), gate="full", features=0, histories=1), {"inputs": 12, "full": True}),
    "one warp": (ExtraNetConfig(widths=(4, 5), warps=1, features=1, histories=0), {"inputs": 7}),
}


@pytest.mark.parametrize("name", sorted(CONFIGURATIONS))
def test_against_a_network_in_float64(name):
    """By the release's names; 13 and 10 are no multiples of 4. Folded, as a pure function."""
    config, shapes = CONFIGURATIONS[name]
    weights = release_weights(config.widths, histories=config.histories, **shapes)
    arrays = inputs(13, 10, config)
    expected = reference(weights, *arrays)
    function, state = inference(extranet_from_torch(weights, config=config))
    found = function(state, *device(arrays))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, atol=2e-5)
    assert np.abs(expected - arrays[0][..., :3]).max() > 0.1, "the network does nothing"


@pytest.mark.slow
@pytest.mark.parametrize("size", [(8, 16), (9, 3), (1, 1), (1, 17), (30, 1)])
def test_any_size_against_a_network_in_float64(size):
    """The whole network of the paper, folded and not."""
    weights, arrays = release_weights(), inputs(*size)
    expected = reference(weights, *arrays)
    model = extranet_from_torch(weights)
    function, state = inference(model)
    np.testing.assert_allclose(function(state, *device(arrays)), expected, atol=2e-5)
    found = nnx.jit(lambda model, arrays: model(*arrays))(model, device([a[None] for a in arrays]))
    np.testing.assert_allclose(found[0], expected, atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("direct", [False, True])
def test_what_tells_of_the_guess_comes_last(direct):
    """With zeros for these inputs' weights it is the network without them; else they are features like others."""
    size = {"widths": (3, 4), "features": 2, "histories": 2, "direct": direct}
    more, plain = (ExtraNet(ExtraNetConfig(**size, guess=n), rngs=nnx.Rngs(0)) for n in (4, 0))
    kernel = more.encoder[0].layers[0].feature.kernel
    assert kernel.shape[2] == plain.encoder[0].layers[0].feature.kernel.shape[2] + 4
    state = nnx.to_pure_dict(nnx.state(plain))
    for part in ("feature", "gate"):
        first = state["encoder"][0]["layers"][0][part]
        first["kernel"] = jnp.pad(first["kernel"], ((0, 0), (0, 0), (0, 4 * (first["kernel"].shape[2] > 4)), (0, 0)))
    nnx.update(more, state)
    x, mask, features, history = (jnp.asarray(random(1, *s, seed=k)) for k, s in enumerate(shapes_of(9, 14)))
    told = jnp.concatenate([features, jnp.asarray(random(1, 9, 14, 4, seed=9))], -1)
    with jax.enable_x64(True):  # sums of other lengths are rounded in another order
        wide = [jnp.asarray(a, jnp.float64) for a in (x, told, features, history)]
        found = []
        for model, shown in ((more, wide[1]), (plain, wide[2])):
            graph, held = nnx.split(model)
            model = nnx.merge(graph, jax.tree.map(lambda a: a.astype(jnp.float64), held))
            found.append(model(wide[0], jnp.asarray(mask, jnp.float64), shown, wide[3]))
    assert found[0].dtype == jnp.float64
    np.testing.assert_allclose(*found, atol=1e-6)
    with pytest.raises(ValueError, match="features: expected shape"):
        more(x, mask, features, history)


@pytest.mark.slow
def test_direct_is_a_network_with_the_histories_among_its_features():
    """The same weights, the histories appended to the target's buffers, oldest first."""
    direct = ExtraNet(ExtraNetConfig(widths=(3, 4), features=2, histories=2, direct=True), rngs=nnx.Rngs(0))
    plain = ExtraNet(ExtraNetConfig(widths=(3, 4), features=10, histories=2), rngs=nnx.Rngs(1))
    nnx.update(plain, nnx.state(direct))
    x, mask, features, history = (jnp.asarray(random(1, *s, seed=k)) for k, s in enumerate(shapes_of(9, 14)))
    more = jnp.concatenate([features, history[:, 0], history[:, 1]], -1)
    np.testing.assert_allclose(direct(x, mask, features, history), plain(x, mask, more, history), atol=1e-5)


@pytest.mark.parametrize("direct", [pytest.param(False, marks=pytest.mark.slow), True])
def test_contrast_is_a_network_that_is_shown_differences(direct):
    """The same weights; images but the first replaced by 3 (image - first), masks as they are."""
    size = {"widths": (3, 4), "features": 2, "histories": 2, "direct": direct}
    with_contrast = ExtraNet(ExtraNetConfig(**size, contrast=3.0), rngs=nnx.Rngs(0))
    plain = ExtraNet(ExtraNetConfig(**size), rngs=nnx.Rngs(1))
    nnx.update(plain, nnx.state(with_contrast))
    x, mask, features, history = (jnp.asarray(random(1, *s, seed=k)) for k, s in enumerate(shapes_of(9, 14)))
    first = x[..., :3]
    other_x = jnp.concatenate([first, 3 * (x[..., 3:] - first)], -1)
    other = jnp.concatenate([3 * (history[..., :3] - first[:, None]), history[..., 3:]], -1)
    answers = with_contrast(x, mask, features, history), plain(other_x, mask, features, other)
    np.testing.assert_allclose(*answers, atol=1e-5)


def test_contrast_of_a_single_warped_image_changes_histories_alone():
    size = {"widths": (3, 4), "features": 2, "histories": 2, "warps": 1}
    with_contrast = ExtraNet(ExtraNetConfig(**size, contrast=3.0), rngs=nnx.Rngs(0))
    plain = ExtraNet(ExtraNetConfig(**size), rngs=nnx.Rngs(1))
    nnx.update(plain, nnx.state(with_contrast))
    x, mask, features, history = (jnp.asarray(random(1, *s, seed=k)) for k, s in enumerate(shapes_of(9, 14)))
    x = x[..., :3]
    other = jnp.concatenate([3 * (history[..., :3] - x[:, None]), history[..., 3:]], -1)
    np.testing.assert_allclose(with_contrast(x, mask, features, history), plain(x, mask, features, other), atol=1e-5)


def shapes_of(height, width):
    return (height, width, 6), (height, width, 1), (height, width, 2), (2, height, width, 4)


@pytest.mark.slow
def test_without_batch_norm_signals_keep_their_size():
    """And the first answer is about the first guess."""
    model = ExtraNet(ExtraNetConfig(norm=False), rngs=nnx.Rngs(0))
    assert not any(isinstance(module, nnx.BatchNorm) for _, module in nnx.iter_modules(model))
    x, mask, features, history = (
        jnp.asarray(np.random.default_rng(k).normal(size=(1, *s)).astype(np.float32))
        for k, s in enumerate(((48, 64, 6), (48, 64, 1), (48, 64, 6), (3, 48, 64, 4)))
    )
    value = jnp.concatenate([x, x * mask, features], -1)
    for level in model.encoder:
        value = level(value)
        assert 0.3 < float(jnp.sqrt(jnp.mean(value**2))) < 3
    residual = model(x, mask, features, history) - x[..., :3]
    assert 0.005 < float(jnp.std(residual)) < 0.3


@pytest.mark.slow
def test_batches_and_mapping():
    """One frame = that frame in a batch = mapped; here of one pixel each."""
    model = extranet_from_torch(small_weights(), config=SMALL)
    frames = [inputs(1, 1, SMALL, seed) for seed in (0, 10)]
    batch = [jnp.stack([jnp.asarray(frame[k]) for frame in frames]) for k in range(4)]
    function, state = inference(model)
    whole = nnx.jit(lambda model, batch: model(*batch))(model, batch)
    mapped = jax.vmap(function, (None, 0, 0, 0, 0))(state, *batch)
    expected = [reference(small_weights(), *frame) for frame in frames]
    np.testing.assert_allclose(whole, expected, atol=2e-5)
    np.testing.assert_allclose(mapped, expected, atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("dtype, limit", [(jnp.float16, 1e-2), (jnp.bfloat16, 6e-2)])
def test_half_precision_keeps_the_warp_whole(dtype, limit):
    arrays = inputs(6, 5, SMALL)
    function, state = inference(extranet_from_torch(small_weights(), config=SMALL), dtype=dtype)
    assert all(leaf.dtype == dtype for leaf in jax.tree.leaves(state))
    found = function(state, *device(arrays))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, reference(small_weights(), *arrays), atol=limit)
    still = jax.tree.map(jnp.zeros_like, state)
    np.testing.assert_array_equal(function(still, *device(arrays)), arrays[0][..., :3])


@pytest.mark.slow
def test_gradients(x64):
    """With respect to the inputs, against differences of the NumPy network; and finite for all parameters."""
    weights = small_weights()
    model = extranet_from_torch(weights, config=SMALL)
    function, state = inference(model, dtype=jnp.float64)
    arrays = [np.asarray(a, np.float64) for a in inputs(5, 6, SMALL)]
    direction = random(5, 6, 3, seed=9, low=-1, dtype=np.float64)

    def loss(state, *arrays):
        return jnp.sum(function(state, *arrays) * direction)

    gradients = jax.jit(jax.grad(loss, argnums=range(5)))(state, *device(arrays))
    assert_gradients(lambda *a: np.sum(reference(weights, *a) * direction), arrays, gradients[1:], rtol=1e-4)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradients[0]))
    assert any(np.any(g) for g in jax.tree.leaves(gradients[0]))


@pytest.mark.slow
def test_a_training_step_reaches_every_parameter():
    model = ExtraNet(SMALL, rngs=nnx.Rngs(1))
    model.train()
    before = jax.tree.map(jnp.copy, nnx.state(model, nnx.BatchStat))
    batch = [jnp.asarray(np.stack(pair)) for pair in zip(inputs(9, 6, SMALL), inputs(9, 6, SMALL, 10), strict=True)]

    @nnx.jit
    def step(model, batch):
        return nnx.grad(lambda model: jnp.mean(jnp.square(model(*batch))))(model)

    gradients = step(model, batch)
    for path, gradient in nnx.to_flat_state(gradients):
        assert np.isfinite(gradient[...]).all(), path
        # a bias before a batch norm is subtracted again with the mean
        assert np.any(gradient[...]) or path[-2:] == ("feature", "bias"), path
    moved = jax.tree.map(lambda a, b: bool(np.any(a != b)), before, nnx.state(model, nnx.BatchStat))
    assert all(jax.tree.leaves(moved))


@pytest.mark.slow
def test_no_implicit_promotion(strict):
    arrays = device([a[None] for a in inputs(5, 7, SMALL)])

    def train():
        model = ExtraNet(SMALL, rngs=nnx.Rngs(0))
        return nnx.grad(lambda model: jnp.mean(model(*arrays)))(model)

    def infer():
        function, state = inference(ExtraNet(SMALL, rngs=nnx.Rngs(0)))
        return function(state, *[a[0] for a in arrays])

    nnx.eval_shape(train)
    nnx.eval_shape(infer)


def test_errors(unchecked):
    weights = small_weights()
    model = extranet_from_torch(weights, config=SMALL)
    x, mask, features, history = device([a[None] for a in inputs(5, 7, SMALL)])
    with pytest.raises(ValueError, match=r"x: expected shape \[B, H, W, 6\], got \[1, 5, 7, 1\]"):
        model(mask, mask, features, history)
    with pytest.raises(ValueError, match=r"mask: expected shape \[1, 5, 7, 1\], got \[1, 5, 7, 6\]"):
        model(x, x, features, history)
    with pytest.raises(ValueError, match=r"features: absent \(None\)"):
        model(x, mask, None, history)
    with pytest.raises(ValueError, match=r"history: expected shape \[1, 2, 5, 7, 4\], got \[1, 1, 5, 7, 4\]"):
        model(x, mask, features, history[:, :1])
    with pytest.raises(ValueError, match="gate: expected one of 'none', 'light', 'full', got 'heavy'"):
        Layer(1, 1, gate="heavy", rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match="activation: expected one of"):
        Layer(1, 1, activation="tanh", rngs=nnx.Rngs(0))
    with pytest.raises(ValueError, match=r"unknown names extra\.bias"):
        extranet_from_torch(weights | {"extra.bias": np.zeros(2)}, config=SMALL)
    with pytest.raises(ValueError, match=r"bn1\.running_var is missing"):
        extranet_from_torch({k: v for k, v in weights.items() if k != "bn1.running_var"}, config=SMALL)
    with pytest.raises(ValueError, match=r"conv1\.conv_feature\.weight: expected shape \[3, 3, 14, 3\], got"):
        extranet_from_torch(weights | {"conv1.conv_feature.weight": np.zeros((3, 13, 3, 3))}, config=SMALL)


# The authors' weights


@pytest.fixture(scope="module")
def released(data):
    """The authors' network, and their inputs and answers for two sizes."""
    vectors = np.load(data / "extranet_vectors.npz")
    names = ("x", "mask", "features", "history", "output")
    return read_torch(data / "extranet_medieval.pth.tar")["state_dict"], [
        [vectors[f"{k}_{n}"] for n in names] for k in (0, 1)
    ]


@pytest.mark.slow
def test_released_answers(released):
    weights, frames = released
    function, state = inference(extranet_from_torch(weights))
    *arrays, expected = frames[1]
    np.testing.assert_allclose(function(state, *device(arrays)), expected, rtol=0, atol=2e-5)


@pytest.mark.slow
def test_released_answers_in_all_precisions(released):
    """Both sizes, folded and not; the errors are those that the docstring of `inference` states."""
    weights, frames = released
    model = extranet_from_torch(weights)
    for dtype, largest, mean in ((jnp.float32, 2e-5, 2e-6), (jnp.float16, 6e-3, 8e-4), (jnp.bfloat16, 5.25e-2, 7e-3)):
        function, state = inference(model, dtype=dtype)
        for *arrays, expected in frames:
            error = np.asarray(function(state, *device(arrays))) - expected
            assert np.abs(error).max() < largest
            assert np.sqrt(np.mean(error**2)) < mean
    for *arrays, expected in frames:
        found = nnx.jit(lambda model, arrays: model(*arrays))(model, device([a[None] for a in arrays]))
        np.testing.assert_allclose(found[0], expected, rtol=0, atol=2e-5)
