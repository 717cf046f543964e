"""guided_warp against a float64 loop over its taps, its order of ties, its gradients, and guides that are packed."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from oracles import random, random_motion

import jaxtrapolate as jx
from jaxtrapolate.ops import guided
from jaxtrapolate.ops.guided import guided_taps

SIZE = (9, 11)
SMALL = {"strides": (1,), "keep": 3}  # compiles fastest


def inputs(*size, seed=0, dtype=np.float32, guides=3, amount=2):
    """Image, motion, target guide, source guide."""
    image = random(*size, 2, seed=seed, dtype=dtype)
    motion = random_motion(*size, seed=seed + 1, amount=amount, dtype=dtype)
    return image, motion, *(random(*size, guides, seed=seed + k, dtype=dtype) for k in (2, 3))


def warp(*arrays, **options):
    return np.asarray(jx.guided_warp(*(jnp.asarray(a) for a in arrays), **options))


@pytest.mark.parametrize(
    "strides, keep",
    [
        ((1, 3, 5, 9), 4),
        pytest.param((2, 5), 3, marks=pytest.mark.slow),
        pytest.param((1,), 1, marks=pytest.mark.slow),
        pytest.param((1, 2, 3, 4, 5, 6, 7), 5, marks=pytest.mark.slow),
    ],
)
def test_against_the_loop(x64, strides, keep):
    """The ranking is in float32 and cut to 2^-17: pixels whose last kept tap has a near rival are left out."""
    arrays = inputs(*SIZE, dtype=np.float64)
    for sigma_guide, sigma_space in ((0.05, 1.0), (0.5, 0.7), (2.0, 30.0), (1e-3, 1.0), (1e-20, 1.0), (0.3, 1e-3)):
        sigmas = {"sigma_guide": sigma_guide, "sigma_space": sigma_space}
        result = warp(*arrays, strides=strides, keep=keep, **sigmas)
        expected, gap = oracles.guided_warp(*arrays, strides, sigma_guide, sigma_space, keep)
        clear = gap > 3 * 2.0**-17
        assert clear.mean() > 0.9
        np.testing.assert_allclose(result[clear], expected[clear], rtol=1e-9, err_msg=str(sigmas))
        assert np.isfinite(result).all()
        assert result.min() >= arrays[0].min()
        assert result.max() <= arrays[0].max()


def test_float32_with_default_options():
    arrays = inputs(*SIZE)
    expected, gap = oracles.guided_warp(*arrays)
    clear = gap > 3 * 2.0**-17
    assert clear.mean() > 0.9
    np.testing.assert_allclose(warp(*arrays)[clear], expected[clear], atol=2e-4)


def test_motion_far_out_of_the_frame():
    """Taps outside have no weight; where none is left it is the pixel of the frame nearest to the landing place."""
    image, motion, target, source = inputs(*SIZE, amount=12)
    for k, place in enumerate([(1e6, 0), (-1e6, 3), (0, 1e30), (-1e30, -1e30), (100, 0), (np.nan, 0), (0, np.inf)]):
        motion[k, k] = place
    result = warp(image, motion, target, source)
    expected, gap = oracles.guided_warp(image, motion, target, source)
    clear = gap > 3 * 2.0**-17
    np.testing.assert_allclose(result[clear], expected[clear], atol=2e-4)
    np.testing.assert_array_equal(result[0, 0], image[0, -1])
    np.testing.assert_array_equal(result[2, 2], image[-1, 2])
    np.testing.assert_array_equal(result[3, 3], image[0, 0])


def test_packed_guides_change_few_taps():
    arrays = inputs(*SIZE)
    exact, packed = warp(*arrays), warp(*arrays, guides="packed")
    same = np.isclose(exact, packed, atol=1e-6).all(-1)
    assert same.mean() > 0.95
    assert np.abs(exact - packed).max() < 0.5
    exact16 = [a.astype(np.float16).astype(np.float32) for a in arrays[2:]]
    np.testing.assert_array_equal(warp(*arrays[:2], *exact16), warp(*arrays[:2], *exact16, guides="packed"))


@pytest.mark.parametrize("size", [(1, 6), (6, 1), (1, 1)], ids=str)
def test_small_images(size):
    arrays = inputs(*size, guides=1, amount=1)
    expected, gap = oracles.guided_warp(*arrays, strides=(1,), keep=3)
    clear = gap > 3 * 2.0**-17
    np.testing.assert_allclose(warp(*arrays, **SMALL)[clear], expected[clear], atol=2e-4)


def small(seed=0):
    return inputs(5, 7, seed=seed, guides=1, amount=1)


def test_identity_where_the_neighbours_differ():
    """Distinct guides and a small sigma: zero motion returns the image, whole pixels its shift, bit for bit."""
    image = random(5, 7, 2)
    guide = np.random.default_rng(1).permutation(35).astype(np.float32).reshape(5, 7, 1)
    for dx, dy in ((0, 0), (1, 0), (-1, 1)):
        motion = np.full((5, 7, 2), (dx, dy), np.float32)
        source = oracles.shift(guide, -dx, -dy)
        inner = (slice(1, -1), slice(1, -1))
        result = warp(image, motion, guide, source, **SMALL, sigma_guide=1e-3)
        np.testing.assert_array_equal(result[inner], oracles.shift(image, dx, dy)[inner])


def test_equal_costs_go_to_the_first_tap():
    """Equal guides: the centre, then of the four next ones the two that come first row by row."""
    image, guide = random(5, 7, 2), np.full((5, 7, 1), 0.5, np.float32)
    result = warp(image, np.zeros((5, 7, 2), np.float32), guide, guide, **SMALL, sigma_space=1.0)
    w = np.exp(-0.5)
    expected = (image[2, 3] + w * image[1, 3] + w * image[2, 2]) / (1 + 2 * w)
    np.testing.assert_allclose(result[2, 3], expected, rtol=1e-5)
    assert guided_taps((1, 3)) == oracles.guided_offsets((1, 3))


@pytest.mark.parametrize("sigma", [1e-3, 1e-10, 1e-20])
def test_equal_guides_are_weighted_by_distance_at_any_sigma(sigma):
    image, motion, guide, _ = small()
    guide[:] = 0.5
    expected, _ = oracles.guided_warp(image, motion, guide, guide, (1,), sigma, 1.0, 3)
    np.testing.assert_allclose(
        warp(image, motion, guide, guide, **SMALL, sigma_guide=sigma, sigma_space=1.0), expected, atol=1e-5
    )


@pytest.mark.parametrize("sigma", [1e-3, 1e-10, 1e-20])
def test_a_small_sigma_takes_the_best_tap(sigma):
    arrays = small()
    expected, gap = oracles.guided_warp(*arrays, (1,), sigma, 1.0, 3)
    result = warp(*arrays, **SMALL, sigma_guide=sigma, sigma_space=1.0)
    np.testing.assert_allclose(result[gap > 1e-4], expected[gap > 1e-4], atol=1e-2 if sigma == 1e-3 else 1e-6)


def test_bad_pixels_and_guides():
    """A tap with a bad guide has no weight, a bad pixel that is not kept leaves no trace."""
    image, motion, target, source = small()
    source[1, 1], source[2, 4], source[3, 3] = np.nan, np.inf, -np.inf
    image[1, 1], image[2, 4] = np.nan, np.inf
    target[0, 5] = np.nan
    result = warp(image, motion, target, source, **SMALL)
    expected, gap = oracles.guided_warp(image, motion, target, source, (1,), keep=3)
    clear = (gap > 3 * 2.0**-17) & np.isfinite(expected).all(-1)
    assert clear.mean() > 0.8
    np.testing.assert_allclose(result[clear], expected[clear], atol=2e-4)


def test_no_tap_left():
    image, motion, target, source = small()
    source[:] = np.nan
    result = warp(image, motion, target, source, **SMALL)
    np.testing.assert_array_equal(result, oracles.backward_warp(image, motion, "nearest").astype(np.float32))


@pytest.mark.parametrize("kind", ["float16", pytest.param("bfloat16", marks=pytest.mark.slow)])
def test_dtypes(kind):
    image, motion, target, source = small()
    image = jnp.asarray(image, kind)
    result = jx.guided_warp(image, *(jnp.asarray(a) for a in (motion, target, source)), **SMALL)
    assert result.dtype == image.dtype
    exact = warp(np.float32(image), motion, target, source, **SMALL)
    np.testing.assert_allclose(np.float32(result), exact, rtol=float(jnp.finfo(image.dtype).eps))


@functools.cache
def pullback():
    @jax.jit
    def run(cotangent, image, motion, target, source, sigma_guide, sigma_space):
        def forward(image, motion, target, source, a, b):
            return jx.guided_warp(image, motion, target, source, **SMALL, sigma_guide=a, sigma_space=b)

        result, pull = jax.vjp(forward, image, motion, target, source, sigma_guide, sigma_space)
        return result, pull(cotangent)

    return run


@pytest.mark.slow
def test_gradients_against_differences_of_the_loop(x64):
    """With respect to image, motion, both guides and both sigmas."""
    arrays = (*inputs(5, 7, dtype=np.float64, guides=1, amount=1), np.float64(0.5), np.float64(1.3))
    cotangent = random(5, 7, 2, seed=9, low=-1, dtype=np.float64)
    result, found = pullback()(cotangent, *arrays)

    def loss(image, motion, target, source, a, b):
        return np.sum(cotangent * oracles.guided_warp(image, motion, target, source, (1,), float(a), float(b), 3)[0])

    assert np.isfinite(result).all()
    oracles.assert_gradients(loss, arrays, [np.asarray(g) for g in found], step=1e-7, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.05, 1e-3, 1e-12, 1e-20])
def test_gradients_stay_finite(sigma):
    image, motion, target, source = small()
    motion[0, 0], motion[1, 1], motion[2, 2], motion[3, 3] = np.nan, np.inf, 1e6, (0, -1e30)
    source[4, 4], target[4, 0] = np.nan, np.nan
    result, found = pullback()(np.ones_like(image), image, motion, target, source, np.float32(sigma), np.float32(1))
    assert np.isfinite(result).all()
    for gradient in found:
        assert np.isfinite(gradient).all()
    for at in ((0, 0), (1, 1), (2, 2), (3, 3)):
        np.testing.assert_array_equal(np.asarray(found[1])[at], 0)


@pytest.mark.parametrize("sigma", [1e-3, 1e-12, 1e-20])
def test_gradients_stay_finite_where_guides_are_equal(sigma):
    image, motion, guide, _ = small()
    guide[:] = 0.5
    arrays = image, motion, guide, guide, np.float32(sigma), np.float32(1)
    _, found = pullback()(np.ones_like(image), *arrays)
    for gradient in found:
        assert np.isfinite(gradient).all()


def test_other_sigmas_compile_nothing():
    arrays = [jnp.asarray(a) for a in small()]
    jx.guided_warp(*arrays, **SMALL, sigma_guide=0.1, sigma_space=2.0)
    before = guided._guided_warp._cache_size()
    for a, b in ((0.05, 1.0), (1e-20, 3.0), (7.0, 0.1)):
        jx.guided_warp(*arrays, **SMALL, sigma_guide=a, sigma_space=b)
    assert guided._guided_warp._cache_size() == before


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"image": (4, 5)}, ValueError, r"image: expected shape \[H, W, C\], got \[4, 5\]"),
        ({"motion": (5, 4, 2)}, ValueError, r"motion: expected shape \[4, 5, 2\], got \[5, 4, 2\]"),
        ({"target_guide": (4, 4, 3)}, ValueError, r"target_guide: expected shape \[4, 5, C\], got \[4, 4, 3\]"),
        ({"source_guide": (4, 5, 2)}, ValueError, r"source_guide: expected shape \[4, 5, 3\], got \[4, 5, 2\]"),
        ({"strides": ()}, ValueError, "strides: expected 1 to 7 distinct integers"),
        ({"strides": (1, 1)}, ValueError, "strides: expected 1 to 7 distinct integers"),
        ({"strides": (0,)}, ValueError, "strides: expected 1 to 7 distinct integers"),
        ({"strides": (1, 2, 3, 4, 5, 6, 7, 8)}, ValueError, "strides: expected 1 to 7 distinct integers"),
        ({"keep": 0}, ValueError, "keep: expected 1 to 5, got 0"),
        ({"keep": 6}, ValueError, "keep: expected 1 to 5, got 6"),
        ({"guides": "uint8"}, ValueError, "guides: expected one of 'float32', 'packed', got 'uint8'"),
    ],
)
def test_errors(unchecked, change, error, message):
    shapes = {"image": (4, 5, 1), "motion": (4, 5, 2), "target_guide": (4, 5, 3), "source_guide": (4, 5, 3)}
    options = {name: value for name, value in change.items() if name not in shapes}
    arrays = [jnp.ones(change.get(name, shape)) for name, shape in shapes.items()]
    with pytest.raises(error, match=message):
        jx.guided_warp(*arrays, **options)
    with pytest.raises(TypeError, match="image: expected a floating-point array"):
        jx.guided_warp(arrays[0].astype(int), *arrays[1:], **options)
