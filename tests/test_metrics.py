"""PSNR and SSIM against skimage, with masks, and finite gradients where images are equal."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skimage.metrics
from oracles import random

from jaxtrapolate import metrics

SIZE = (17, 23)


def pair(*size, noise=0.1):
    first = random(*size, 3)
    return first, np.clip(first + random(*size, 3, seed=1, low=-noise, high=noise), 0, 1)


@pytest.mark.parametrize("size", [SIZE, (1, 1), (1, 9)], ids=str)
@pytest.mark.parametrize("peak", [1.0, 4.0])
def test_psnr_against_skimage(size, peak):
    first, second = pair(*size)
    expected = skimage.metrics.peak_signal_noise_ratio(np.float64(first), np.float64(second), data_range=peak)
    found = metrics.psnr(jnp.asarray(first), jnp.asarray(second), peak=peak)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    error = metrics.mse(jnp.asarray(first), jnp.asarray(second))
    np.testing.assert_allclose(error, np.mean((np.float64(first) - second) ** 2), rtol=1e-5)


@pytest.mark.parametrize("size, peak", [(SIZE, 1.0), (SIZE, 3.0), ((11, 12), 1.0)], ids=str)
def test_ssim_against_skimage(size, peak):
    first, second = pair(*size, noise=0.4)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": peak}
    expected, full = skimage.metrics.structural_similarity(
        np.float64(first), np.float64(second), channel_axis=-1, full=True, **options
    )
    first, second = jnp.asarray(first), jnp.asarray(second)
    np.testing.assert_allclose(metrics.ssim(first, second, peak=peak), expected, atol=1e-5)
    inner = full.mean(-1, keepdims=True)[5:-5, 5:-5]
    np.testing.assert_allclose(metrics.ssim_map(first, second, peak=peak), inner, atol=3e-5)


def skimage_ssim(first, second):
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    return skimage.metrics.structural_similarity(np.float64(first), np.float64(second), channel_axis=-1, **options)


def test_ssim_of_flat_images_is_no_rounding():
    """The variance of a flat image is 0: means of squares less squares of means gave 1.000367."""
    first, second = (np.full((32, 40, 3), v, np.float32) for v in (0.75, 0.74))
    expected = (2 * 0.75 * 0.74 + 1e-4) / (0.75**2 + 0.74**2 + 1e-4)
    assert skimage_ssim(first, second) == pytest.approx(expected, abs=1e-7)
    np.testing.assert_allclose(metrics.ssim(jnp.asarray(first), jnp.asarray(second)), expected, atol=3e-7)
    first, second = pair(48, 64)
    first[:, :48], second[:, :48] = 0.75, 0.74
    found = metrics.ssim(jnp.asarray(first), jnp.asarray(second))
    np.testing.assert_allclose(found, skimage_ssim(first, second), atol=1e-6)


def test_ssim_of_equal_images_is_one():
    image = jnp.asarray(random(*SIZE, 3, low=0, high=100))
    assert metrics.ssim(image, image) == 1


@pytest.mark.parametrize("scale", [1e-25, 1e-3, 1e19, 1e30])
def test_images_of_any_size(scale):
    """Against float64; SSIM for a peak of that size."""
    first, second = (np.float32(scale) * image for image in pair(*SIZE))
    error = np.mean((np.float64(first) - second) ** 2)
    arrays = jnp.asarray(first), jnp.asarray(second)
    np.testing.assert_allclose(metrics.psnr(*arrays), -10 * np.log10(error), rtol=1e-6)
    gradient = jax.grad(metrics.psnr)(*arrays)
    expected = -20 / np.log(10) * (np.float64(first) - second) / (error * first.size)
    np.testing.assert_allclose(gradient, expected, rtol=2e-3, atol=1e-6 * np.abs(expected).max())
    expected = skimage_ssim(*(np.float64(a) / np.float64(np.float32(scale)) for a in (first, second)))
    if scale > 1e-20:
        np.testing.assert_allclose(metrics.ssim(*arrays, peak=scale), expected, atol=1e-5)
    assert np.isfinite(jax.grad(metrics.ssim)(*arrays)).all()


def test_masks_choose_the_pixels():
    first, second = pair(*SIZE)
    mask = random(*SIZE, 1, seed=4) > 0.4
    chosen = np.broadcast_to(mask, first.shape)
    error = np.mean((np.float64(first) - second)[chosen] ** 2)
    arrays = jnp.asarray(first), jnp.asarray(second)
    np.testing.assert_allclose(metrics.mse(*arrays, mask=jnp.asarray(mask)), error, rtol=1e-5)
    np.testing.assert_allclose(metrics.psnr(*arrays, mask=jnp.asarray(mask)), -10 * np.log10(error), rtol=1e-5)
    values = np.asarray(metrics.ssim_map(*arrays))
    found = metrics.ssim(*arrays, mask=jnp.asarray(mask))
    np.testing.assert_allclose(found, values[mask[5:-5, 5:-5]].mean(), rtol=1e-5)
    weights = random(*SIZE, 1, seed=5)
    weighted = np.sum((np.float64(first) - second) ** 2 * weights) / (3 * weights.sum())
    np.testing.assert_allclose(metrics.mse(*arrays, mask=jnp.asarray(weights)), weighted, rtol=1e-5)


def test_bad_pixels_outside_the_mask_do_not_count():
    first, second = pair(*SIZE)
    mask = np.ones((*SIZE, 1), bool)
    mask[0, 0] = False
    arrays = jnp.asarray(first), jnp.asarray(second)
    expected = metrics.psnr(*arrays, mask=jnp.asarray(mask))
    bad = arrays[0].at[0, 0].set(jnp.nan)
    np.testing.assert_array_equal(metrics.psnr(bad, arrays[1], mask=jnp.asarray(mask)), expected)
    assert np.isnan(metrics.psnr(bad, arrays[1]))
    gradient = jax.grad(lambda a: metrics.psnr(a, arrays[1], mask=jnp.asarray(mask)))(bad)
    assert np.isfinite(np.asarray(gradient)[mask[..., 0]]).all()


def test_degenerate_images():
    image = jnp.asarray(random(*SIZE, 3))
    assert metrics.psnr(image, image) == np.inf
    np.testing.assert_allclose(metrics.ssim(image, image), 1, atol=1e-6)
    empty = jnp.zeros((*SIZE, 1), bool)
    for function in (metrics.mse, metrics.psnr, metrics.ssim):
        assert np.isnan(function(image, image + 0.1, mask=empty))
    for function in (metrics.mse, metrics.psnr):
        gradient = jax.grad(lambda a, f=function: f(a, image))(image)
        np.testing.assert_allclose(gradient, 0, atol=1e-6)
    gradient = jax.jit(jax.grad(metrics.ssim))
    np.testing.assert_allclose(gradient(image, image), 0, atol=1e-6)
    flat = jnp.full((*SIZE, 3), 0.5)
    assert np.isfinite(gradient(flat * 0, flat)).all()


@pytest.mark.slow
def test_gradients(x64):
    first, second = (np.float64(a) for a in pair(11, 12))
    along = random(11, 12, 3, seed=6, low=-1, dtype=np.float64)
    for function in (metrics.psnr, metrics.ssim):
        found = np.sum(np.asarray(jax.grad(function)(jnp.asarray(first), jnp.asarray(second))) * along)
        up, down = (float(function(jnp.asarray(first + s * along), jnp.asarray(second))) for s in (1e-6, -1e-6))
        np.testing.assert_allclose(found, (up - down) / 2e-6, rtol=1e-6)


@pytest.mark.parametrize("kind", ["float16", "bfloat16"])
def test_half_precision(kind):
    first, second = (jnp.asarray(a, kind) for a in pair(*SIZE))
    expected = skimage.metrics.peak_signal_noise_ratio(np.float64(first), np.float64(second), data_range=1)
    np.testing.assert_allclose(np.float64(metrics.psnr(first, second)), expected, rtol=2e-2)
    assert np.isfinite(np.float64(metrics.ssim(first, second)))


def test_a_large_image_keeps_its_precision():
    """A mean over many pixels of a small difference."""
    first = jnp.full((512, 1024, 3), 0.5)
    np.testing.assert_allclose(metrics.mse(first, first + 2.0**-10), 2.0**-20, rtol=1e-5)


def test_by_name():
    assert metrics.METRICS["psnr"] is metrics.psnr
    assert metrics.METRICS["ssim"] is metrics.ssim


@pytest.mark.parametrize("name", ["mse", "psnr", "ssim_map", "ssim"])
def test_errors(unchecked, name):
    function, image = getattr(metrics, name), jnp.ones((*SIZE, 3))
    with pytest.raises(ValueError, match=r"first: expected shape \[H, W, C\], got \[17, 23\]"):
        function(image[..., 0], image)
    with pytest.raises(ValueError, match=r"second: expected shape \[17, 23, 3\], got \[17, 22, 3\]"):
        function(image, image[:, 1:])
    with pytest.raises(ValueError, match=r"second: expected shape \[17, 23, 3\], got \[17, 23, 1\]"):
        function(image, image[..., :1])
    with pytest.raises(TypeError, match=r"first: .* got dtype int32"):
        function(image.astype(int), image)
    if name.startswith("ssim"):
        with pytest.raises(ValueError, match=r"at least 11 x 11 pixels .* got 10 x 23"):
            function(image[:10], image[:10])
    if name in ("mse", "psnr"):
        with pytest.raises(ValueError, match=r"mask: expected shape \[17, 23, 1\], got \[17, 23\]"):
            function(image, image, mask=jnp.ones(SIZE, bool))


@pytest.mark.parametrize("shape", [SIZE, (11, 11, 1)], ids=str)
def test_ssim_mask_of_another_shape(unchecked, shape):
    image = jnp.ones((*SIZE, 3))
    with pytest.raises(ValueError, match=r"mask: expected shape \[17, 23, 1\]"):
        metrics.ssim(image, image, mask=jnp.ones(shape, bool))


def test_large_values_in_half_precision():
    image = jnp.full((8, 8, 1), 300.0, jnp.float16)
    assert np.isfinite(metrics.psnr(image, 0 * image, peak=300.0))


def test_gradient_at_a_bad_pixel_outside_the_mask():
    mask = jnp.ones((*SIZE, 1)).at[0, 0].set(0)
    first, second = (jnp.asarray(a) for a in pair(*SIZE))
    gradient = jax.grad(lambda a: metrics.psnr(a, second, mask=mask))(first.at[0, 0].set(jnp.nan))
    assert np.isfinite(gradient).all()
