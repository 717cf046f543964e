"""backward_warp, in_frame: exact where they can be, against loops and other packages elsewhere, and their gradients."""

import functools
import warnings

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import scipy.ndimage
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracles import SIZES, inner_motion, random, random_motion

import jaxtrapolate as jx
from jaxtrapolate.ops import warp as warp_module
from jaxtrapolate.ops.warp import root

pytestmark = pytest.mark.usefixtures("strict")

FILTERS = ["nearest", "bilinear", "bicubic"]
property_test = settings(max_examples=40, deadline=None, derandomize=True)


def warp(image, motion, **options):
    return np.asarray(jx.backward_warp(jnp.asarray(image), jnp.asarray(motion), **options))


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_identity_is_bit_exact(size, filter):
    image = random(*size, 2, low=-3, high=3)
    np.testing.assert_array_equal(warp(image, np.zeros((*size, 2), np.float32), filter=filter), image)


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("dx, dy", [(1, 0), (0, -1), (-2, 1), (2, 2), (9, -8)])
def test_whole_pixels_are_exact(filter, dx, dy):
    image = random(5, 7, 2, low=-3, high=3)
    motion = np.full((5, 7, 2), (dx, dy), np.float32)
    np.testing.assert_array_equal(warp(image, motion, filter=filter), oracles.shift(image, dx, dy))
    for outside, value in (("zero", 0.0), (0.25, 0.25)):
        expected = oracles.shift(image, dx, dy, value)
        np.testing.assert_array_equal(warp(image, motion, filter=filter, outside=outside), expected)


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize(
    "size, outside", [(size, "edge") for size in SIZES] + [((5, 7), "zero"), ((5, 7), 0.25)], ids=str
)
def test_against_the_loop(size, filter, outside):
    image = random(*size, 2, low=-1)
    motion = random_motion(*size, amount=3)
    result = warp(image, motion, filter=filter, outside=outside)
    np.testing.assert_allclose(result, oracles.backward_warp(image, motion, filter, outside), atol=2e-6)


@pytest.mark.parametrize("filter, outside", [("nearest", "edge"), ("bilinear", "edge"), ("bilinear", 2.0)])
def test_motion_of_another_size(filter, outside):
    image, motion = random(5, 7, 2), random_motion(4, 9, amount=3)
    result = warp(image, motion, filter=filter, outside=outside)
    assert result.shape == (4, 9, 2)
    np.testing.assert_allclose(result, oracles.backward_warp(image, motion, filter, outside), atol=2e-6)


@pytest.mark.parametrize("filter", ["nearest", "bilinear"])
def test_against_opencv(filter):
    image = random(9, 13, 3)
    # OpenCV may hold coordinates as multiples of 1/32
    motion = np.round(random(9, 13, 2, seed=3, low=-6, high=6) * 32) / 32 + np.float32(1 / 64 * (filter == "nearest"))
    x = np.arange(13, dtype=np.float32)[None, :] + motion[..., 0]
    y = np.arange(9, dtype=np.float32)[:, None] + motion[..., 1]
    flag = {"nearest": cv2.INTER_NEAREST, "bilinear": cv2.INTER_LINEAR}[filter]
    expected = cv2.remap(image, x, y, flag, borderMode=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(warp(image, motion, filter=filter), expected, atol=2e-6)


def test_against_scipy():
    image = random(9, 13, 1)
    motion = random(9, 13, 2, seed=3, low=-6, high=6)
    x, y = np.arange(13)[None, :] + motion[..., 0], np.arange(9)[:, None] + motion[..., 1]
    expected = scipy.ndimage.map_coordinates(image[..., 0], [y, x], order=1, mode="nearest")
    np.testing.assert_allclose(warp(image, motion)[..., 0], expected, atol=3e-6)


@pytest.mark.parametrize("filter, degree", [("bilinear", 1), ("bicubic", 1), ("bicubic", 2)])
def test_polynomials_are_reproduced(filter, degree):
    y, x = np.mgrid[:8, :9].astype(np.float32) / 4
    image = (0.5 + x - 2 * y if degree == 1 else 0.5 + x - 2 * y + x * x - x * y + 0.5 * y * y)[..., None]
    motion = inner_motion(8, 9)
    to_x, to_y = x + motion[..., 0] / 4, y + motion[..., 1] / 4
    extra = to_x**2 - to_x * to_y + 0.5 * to_y**2 if degree == 2 else 0
    expected = 0.5 + to_x - 2 * to_y + extra
    # a quadratic needs all four taps; a linear function is kept up to the border
    border = 1 if degree == 2 else 0
    column, row = x * 4 + motion[..., 0], y * 4 + motion[..., 1]
    used = (column >= border) & (column <= 8 - border) & (row >= border) & (row <= 7 - border)
    assert used.sum() > 20
    np.testing.assert_allclose(warp(image, motion, filter=filter)[..., 0][used], expected[used], rtol=1e-5)


def test_nearest_ties_go_right_and_down():
    image = np.arange(12, dtype=np.float32).reshape(3, 4, 1)
    motion = np.full((3, 4, 2), -0.5, np.float32)
    np.testing.assert_array_equal(warp(image, motion, filter="nearest"), image)
    expected = oracles.shift(image, 1, 1)
    np.testing.assert_array_equal(warp(image, -motion, filter="nearest"), expected)


def test_the_frame_ends_half_a_pixel_beyond_the_centres():
    image = np.ones((1, 3, 1), np.float32)
    motion = np.zeros((1, 3, 2), np.float32)
    for axis, low, high in ((0, (0, -0.5), (2, 0.5)), (1, (1, -0.5), (1, 0.5))):
        for column, amount in (low, high):
            for beyond, inside in ((0, True), (1e-3, False)):
                moved = motion.copy()
                moved[0, column, axis] = amount * (1 + beyond)
                assert warp(image, moved, outside="zero")[0, column, 0] == inside
                assert bool(jx.in_frame(jnp.asarray(moved))[0, column]) == inside


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_in_frame_against_the_loop(size):
    motion = random(*size, 2, low=-6, high=6)
    motion.flat[0] = np.nan
    motion.flat[-1] = np.inf
    result = jx.in_frame(jnp.asarray(motion))
    assert result.dtype == bool
    np.testing.assert_array_equal(result, oracles.in_frame(motion))


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e6, -1e30, 3.4e38])
def test_extreme_motion(filter, bad):
    image = random(5, 7, 2)
    motion = np.zeros((5, 7, 2), np.float32)
    motion[1, 2] = (bad, 0)
    motion[3, 4] = (0, bad)
    edge, zero = (warp(image, motion, filter=filter, outside=o) for o in ("edge", "zero"))
    np.testing.assert_allclose(edge, oracles.backward_warp(image, motion, filter), atol=1e-6)
    np.testing.assert_array_equal(zero[1, 2], np.zeros(2))
    np.testing.assert_array_equal(zero[3, 4], np.zeros(2))
    if not np.isfinite(bad):
        np.testing.assert_array_equal(edge[1, 2], image[1, 2])
    assert np.isfinite(edge).all()
    assert not np.asarray(jx.in_frame(jnp.asarray(motion)))[[1, 3], [2, 4]].any()


def test_motion_that_is_not_finite_where_the_sizes_differ():
    image, motion = random(2, 3, 1), np.full((4, 5, 2), np.nan, np.float32)
    np.testing.assert_array_equal(warp(image, motion)[3, 4], image[1, 2])
    np.testing.assert_array_equal(warp(image, motion)[0, 4], image[0, 2])


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_pixel_does_not_spread(filter, bad):
    image = random(5, 7, 2)
    image[2, 3, 1] = bad
    for motion in (np.zeros((5, 7, 2)), np.full((5, 7, 2), (1, -1)), np.full((5, 7, 2), (0.25, 0))):
        motion = motion.astype(np.float32)
        result = warp(image, motion, filter=filter)
        expected = oracles.backward_warp(np.nan_to_num(image, nan=1e9, posinf=1e9), motion, filter)
        touched = np.abs(expected) > 1e6
        assert not np.isfinite(result[touched]).any()
        np.testing.assert_allclose(result[~touched], expected[~touched], atol=1e-6)
        assert touched[..., 0].sum() == 0
        assert touched.sum() <= {"nearest": 1, "bilinear": 2, "bicubic": 4}[filter]


@pytest.mark.parametrize(
    "filter, kind, motion_kind",
    [
        ("bilinear", "float16", "float32"),
        ("bilinear", "bfloat16", "bfloat16"),
        ("bilinear", "float32", "float16"),
        ("bilinear", "float32", "float64"),
        ("bilinear", "float64", "float32"),
        ("nearest", "bfloat16", "float16"),
        ("bicubic", "bfloat16", "bfloat16"),
    ],
)
def test_dtypes(x64, filter, kind, motion_kind):
    image = jnp.asarray(random(2, 600, 1), kind)
    motion = jnp.asarray(random_motion(2, 600, amount=3), motion_kind)
    result = jx.backward_warp(image, motion, filter=filter)
    assert result.dtype == image.dtype
    expected = oracles.backward_warp(np.float64(image), np.float64(motion), filter)
    # half-precision coordinates would be wrong by whole pixels at the right
    step = float(jnp.finfo(image.dtype).eps)
    np.testing.assert_allclose(np.float64(result), expected, rtol=step, atol=max(step, 1e-4))
    same = jx.backward_warp(image, jnp.zeros_like(motion), filter=filter)
    np.testing.assert_array_equal(np.float64(same), np.float64(image))


def test_half_range_is_kept(x64):
    image = jnp.full((2, 600, 1), 65504.0, jnp.float16)
    result = jx.backward_warp(image, jnp.full((2, 600, 2), 0.3, jnp.float32))
    np.testing.assert_array_equal(np.float32(result), 65504.0)


finite = {"allow_nan": False, "allow_infinity": False, "width": 32}


@property_test
@given(
    arrays(np.float32, (5, 7, 2), elements=st.floats(-(2.0**100), 2.0**100, **finite)),
    arrays(np.float32, (5, 7, 2), elements=st.floats(**finite)),
)
def test_finite_in_finite_out(image, motion):
    for filter in FILTERS:
        result = warp(image, motion, filter=filter)
        assert np.isfinite(result).all()
        if filter != "bicubic":
            assert result.min() >= image.min() - np.abs(image).max() * 1e-6
            assert result.max() <= image.max() + np.abs(image).max() * 1e-6


@property_test
@given(
    arrays(np.float32, (5, 7, 2), elements=st.floats(width=32, allow_subnormal=False)),
    st.integers(-9, 9),
    st.integers(-9, 9),
    st.sampled_from(FILTERS),
)
def test_any_image_shifts_exactly(image, dx, dy, filter):
    motion = np.full((5, 7, 2), (dx, dy), np.float32)
    np.testing.assert_array_equal(warp(image, motion, filter=filter), oracles.shift(image, dx, dy))


# Gradients, all in float64 and through one compiled function for each filter


@functools.cache
def pullback(filter, fill):
    @jax.jit
    def run(image, motion, value, cotangent):
        result, pull = jax.vjp(
            lambda i, m, v: jx.backward_warp(i, m, filter=filter, outside=v if fill else "edge"), image, motion, value
        )
        return result, pull(cotangent)

    return run


def gradients(image, motion, *, filter="bilinear", value=None, cotangent=None):
    """Of sum(result * cotangent), with respect to image, motion and the outside number."""
    image, motion = np.float64(image), np.float64(motion)
    cotangent = np.ones((*motion.shape[:2], image.shape[-1])) if cotangent is None else np.float64(cotangent)
    given = np.float64(0 if value is None else value)
    result, found = pullback(filter, value is not None)(image, motion, given, cotangent)
    return np.asarray(result), [np.asarray(g) for g in found]


@pytest.mark.slow
@pytest.mark.parametrize(
    "filter, size",
    [
        ("bilinear", size) if size in SIZES[::4] else pytest.param("bilinear", size, marks=pytest.mark.slow)
        for size in SIZES
    ]
    + [("nearest", (5, 7)), ("bicubic", (5, 7))],
)
def test_gradients_against_differences_of_the_loop(x64, size, filter):
    image, motion = random(*size, 2, dtype=np.float64), random_motion(*size, dtype=np.float64)
    cotangent = random(*size, 2, seed=4, low=-1, dtype=np.float64)
    result, found = gradients(image, motion, filter=filter, value=0.7, cotangent=cotangent)
    np.testing.assert_allclose(result, oracles.backward_warp(image, motion, filter, 0.7), rtol=1e-12)

    def loss(image, motion, value):
        return np.sum(cotangent * oracles.backward_warp(image, motion, filter, float(value)))

    oracles.assert_gradients(loss, (image, motion, np.float64(0.7)), found)


@pytest.mark.parametrize("filter", ["bilinear", "bicubic"])
def test_zero_motion_gradient(x64, filter):
    """The next difference, at the last the inner one, as documented; for bicubic, which is smooth, the central one."""
    image = random(5, 7, 2)
    _, (_, found, _) = gradients(image, np.zeros((5, 7, 2)), filter=filter, value=0.0)
    image = np.float64(image).sum(-1)
    for axis, along in ((1, 0), (0, 1)):
        step = np.diff(image, axis=axis)
        expected = np.concatenate([step, np.take(step, [-1], axis)], axis)
        if filter == "bicubic":
            expected = np.gradient(image, axis=axis)
        np.testing.assert_allclose(found[..., along], expected, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES[1:], ids=str)
def test_zero_motion_gradient_of_small_images(x64, size):
    _, (image, motion, _) = gradients(random(*size, 2), np.zeros((*size, 2)), value=0.0)
    np.testing.assert_array_equal(image, np.ones((*size, 2)))
    for axis, along in ((1, 0), (0, 1)):
        if size[axis] == 1:
            np.testing.assert_array_equal(motion[..., along], 0)


@pytest.mark.parametrize("filter", ["bilinear", "bicubic"])
@pytest.mark.parametrize("dx", [-0.25, -0.5, 0.25, 0.5])
def test_gradient_beyond_the_border_is_zero(x64, filter, dx):
    motion = np.zeros((5, 7, 2))
    column = 0 if dx < 0 else 6
    motion[:, column, 0] = dx
    _, (_, found, _) = gradients(random(5, 7, 2), motion, filter=filter, value=0.0)
    np.testing.assert_array_equal(found[:, column, 0], 0)
    assert np.abs(found[:, column, 1]).min() > 0, "along the border the value still changes"


@pytest.mark.parametrize("filter, value", [("nearest", 0.5), ("bilinear", None), ("bilinear", 0.5), ("bicubic", 0.5)])
def test_gradients_stay_finite(x64, filter, value):
    image, motion = random(5, 7, 2), random_motion(5, 7)
    motion[0, 0], motion[1, 1], motion[2, 2], motion[3, 3] = np.nan, np.inf, (0, -np.inf), 1e30
    _, (image_gradient, found, outside) = gradients(image, motion, filter=filter, value=value)
    assert np.isfinite(image_gradient).all()
    assert np.isfinite(found).all()
    for at in ((0, 0), (1, 1), (2, 2), (3, 3)):
        np.testing.assert_array_equal(found[at], 0)
    assert outside == (0 if value is None else 2 * (~oracles.in_frame(motion)).sum())


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("filter", ["bilinear", "bicubic"])
def test_gradients_beside_a_bad_pixel(x64, filter, bad):
    """A pixel that has no weight leaves no trace in the gradients, those of the motion included."""
    image, cotangent = random(5, 7, 2), np.ones((5, 7, 2))
    image[1, 2] = bad
    cotangent[1, 2] = 0
    _, (image_gradient, found, _) = gradients(image, np.zeros((5, 7, 2)), filter=filter, value=0.0, cotangent=cotangent)
    others = np.ones((5, 7), bool)
    others[1, 2] = False
    assert np.isfinite(image_gradient).all()
    assert np.isfinite(found[others]).all()


def test_no_compilation_for_another_outside_number():
    image, motion = jnp.asarray(random(5, 7, 2)), jnp.zeros((5, 7, 2))
    traces = []

    @jax.jit
    def run(image, motion, outside):
        traces.append(1)
        return jx.backward_warp(image, motion, outside=outside)

    for value in (0.0, 0.5, -3.0):
        run(image, motion, value)
    assert len(traces) == 1
    inner = warp_module._backward_warp
    jx.backward_warp(image, motion, outside=0.125)
    before = inner._cache_size()
    for value in (0.25, 7.0, -1.0):
        jx.backward_warp(image, motion, outside=value)
    jx.backward_warp(image + 1, motion - 1, outside=2.0)
    assert inner._cache_size() == before


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"image": jnp.ones((4, 5))}, ValueError, r"image: expected shape \[H, W, C\], got \[4, 5\]"),
        ({"image": jnp.ones((4, 5, 1), int)}, TypeError, "image: expected a floating-point array .* got dtype int32"),
        ({"image": [1.0]}, TypeError, "image: .* got list"),
        ({"image": jnp.ones((4, 0, 1))}, ValueError, r"image: .* got \[4, 0, 1\]"),
        ({"motion": jnp.ones((4, 5, 3))}, ValueError, r"motion: expected shape \[H, W, 2\], got \[4, 5, 3\]"),
        ({"motion": jnp.ones((4, 5, 2), int)}, TypeError, "motion: .* got dtype int32"),
        ({"filter": "cubic"}, ValueError, "filter: expected one of 'nearest', 'bilinear', 'bicubic', got 'cubic'"),
        ({"outside": "wrap"}, ValueError, "outside: expected one of 'edge', 'zero', got 'wrap'"),
    ],
)
def test_errors(unchecked, change, error, message):
    arguments = {"image": jnp.ones((4, 5, 1)), "motion": jnp.zeros((4, 5, 2))} | change
    with pytest.raises(error, match=message):
        jx.backward_warp(arguments.pop("image"), arguments.pop("motion"), **arguments)


def test_other_errors(unchecked):
    with pytest.raises(ValueError, match=r"motion: expected shape \[H, W, 2\], got \[4, 5\]"):
        jx.in_frame(jnp.ones((4, 5)))
    with pytest.raises(TypeError, match="motion"):
        jx.in_frame(jnp.ones((4, 5, 2), bool))


def test_numpy_arrays_are_taken(unchecked):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        image = random(5, 7, 2)
        np.testing.assert_array_equal(jx.backward_warp(image, np.zeros((5, 7, 2), np.float32)), image)


def test_root():
    """Of 0 it and its derivatives are 0; near 0, and with infinities, the square root."""
    square = jnp.float32([0, 1e-30, 1e-16, 4, jnp.inf])
    np.testing.assert_allclose(root(square), np.sqrt(np.asarray(square, np.float64)), rtol=1e-6)
    slope = jax.grad(root)
    assert slope(jnp.float32(0)) == 0
    assert jax.grad(slope)(jnp.float32(0)) == 0
    np.testing.assert_allclose(slope(jnp.float32(4)), 0.25)
