"""splat_nearest and splat: against loops over every pair of pixels, exact where they can be, and their gradients."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracles import SIZES, inner_motion, random, random_motion

import jaxtrapolate as jx

pytestmark = pytest.mark.usefixtures("strict")

MODES = ["sum", "average", "linear", "softmax"]
property_test = settings(max_examples=30, deadline=None, derandomize=True)


def splat(values, motion, weights=None, mode="average"):
    weights = None if weights is None else jnp.asarray(weights)
    return np.asarray(jx.splat(jnp.asarray(values), jnp.asarray(motion), weights=weights, mode=mode))


def splat_nearest(values, motion, depth, **options):
    result = jx.splat_nearest(jnp.asarray(values), jnp.asarray(motion), jnp.asarray(depth), **options)
    return [np.asarray(a) for a in result]


def weights_for(mode, *size, dtype=np.float32):
    if mode in ("sum", "average"):
        return None
    span = {"linear": (0.1, 2.0), "softmax": (-3.0, 3.0)}[mode]
    return random(*size, 1, seed=5, low=span[0], high=span[1], dtype=dtype)


# Depth-tested


@pytest.mark.parametrize("footprint", [1, 4])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_nearest_against_the_loop(size, footprint):
    values, depth = random(*size, 2), random(*size, 1, seed=8, low=-1)
    for motion in (random_motion(*size), random_motion(*size, kinks=True), random(*size, 2, low=-1.5, high=1.5)):
        result, covered = splat_nearest(values, motion, depth, footprint=footprint)
        expected, expected_covered = oracles.splat_nearest(values, motion, depth, footprint)
        np.testing.assert_array_equal(covered, expected_covered)
        np.testing.assert_array_equal(result, expected)


@pytest.mark.parametrize("dx, dy", [(0, 0), (1, 0), (0, -2), (3, 1), (-20, 20)])
def test_nearest_whole_pixels(dx, dy):
    values, depth = random(5, 7, 2), np.ones((5, 7, 1), np.float32)
    motion = np.full((5, 7, 2), (dx, dy), np.float32)
    result, covered = splat_nearest(values, motion, depth, footprint=1)
    np.testing.assert_array_equal(result, oracles.shift(values, -dx, -dy, 0))
    np.testing.assert_array_equal(covered[..., None], oracles.shift(np.ones_like(depth), -dx, -dy, 0) > 0)


@pytest.mark.parametrize("footprint", [1, 4])
def test_ties_go_to_the_lower_source(footprint):
    values = np.arange(1, 36, dtype=np.float32).reshape(5, 7, 1).repeat(2, -1)
    y, x = np.mgrid[:5, :7]
    motion = np.stack([3 - x, 2 - y], -1).astype(np.float32)  # all land on one pixel
    depth = np.full((5, 7, 1), 0.5, np.float32)
    depth[0, 0] = 0.75
    depth[3, 3:6] = 0.25
    result, covered = splat_nearest(values, motion, depth, footprint=footprint)
    assert covered.sum() == footprint
    assert result[2, 3, 0] == values[3, 3, 0]


def test_depths_of_any_kind_are_ordered():
    """What is not positive is nothing, as far as infinity: of those the lower source is taken, behind any surface."""
    values = np.arange(1, 36, dtype=np.float32).reshape(5, 7, 1).repeat(2, -1)
    y, x = np.mgrid[:5, :7]
    motion = np.stack([3 - x, 2 - y], -1).astype(np.float32)
    depth = np.full((5, 7, 1), np.nan, np.float32)
    for k, value in enumerate([0.0, -0.0, -1e-30, -2.0, -np.inf, np.inf]):
        depth.flat[29 - k] = value
        result, _ = splat_nearest(values, motion, depth, footprint=1)
        assert result[2, 3, 0] == values.reshape(-1, 2)[29 - k, 0]
    falling = [np.inf, 3e38, 2.0, 1e-30]
    for k, value in enumerate(falling):
        depth.flat[k + 5] = value
        result, _ = splat_nearest(values, motion, depth, footprint=1)
        assert result[2, 3, 0] == values.reshape(-1, 2)[k + 5, 0]
    result, covered = splat_nearest(values, motion, np.full_like(depth, np.nan), footprint=1)
    assert not covered.any()
    assert not result.any()


@pytest.mark.parametrize("footprint", [1, 4])
def test_nearest_extreme_motion(footprint):
    values, depth = random(5, 7, 2), random(5, 7, 1, seed=8)
    motion = random_motion(5, 7)
    for k, bad in enumerate([np.nan, np.inf, -np.inf, 1e6, -1e6, 1e30, -1e30, 3.4e38, 2.0**31, -(2.0**31)]):
        motion[k % 5, k % 7, k % 2] = bad
    result, covered = splat_nearest(values, motion, depth, footprint=footprint)
    with np.errstate(over="ignore"):
        expected, expected_covered = oracles.splat_nearest(values, motion, depth, footprint)
    np.testing.assert_array_equal(result, expected)
    np.testing.assert_array_equal(covered, expected_covered)


def test_nearest_moves_bad_pixels_unchanged():
    values = random(5, 7, 2)
    values[1, 2] = np.nan, np.inf
    depth = random(5, 7, 1)
    result, covered = splat_nearest(values, np.zeros((5, 7, 2), np.float32), depth, footprint=1)
    np.testing.assert_array_equal(result, values)
    assert covered.all()


@pytest.mark.parametrize("kind", ["float16", "bfloat16", "float64"])
def test_nearest_dtypes(x64, kind):
    values, motion = jnp.asarray(random(5, 7, 2), kind), jnp.asarray(random_motion(5, 7), kind)
    depth = jnp.asarray(random(5, 7, 1, seed=8), kind)
    result, _ = jx.splat_nearest(values, motion, depth)
    assert result.dtype == values.dtype
    expected, _ = oracles.splat_nearest(*(np.float64(a) for a in (values, motion, depth)))
    np.testing.assert_array_equal(np.float64(result), expected)


def test_nearest_gradient():
    """Each target's cotangent goes to the one source it took; motion and depth have none."""
    values, motion, depth = (jnp.asarray(a) for a in (random(5, 7, 2), random_motion(5, 7), random(5, 7, 1, seed=8)))
    cotangent = random(5, 7, 2, seed=4, low=-1)

    def loss(values, motion, depth):
        return jnp.sum(jx.splat_nearest(values, motion, depth)[0] * cotangent)

    by_values, by_motion, by_depth = jax.grad(loss, argnums=(0, 1, 2))(values, motion, depth)
    number = np.arange(35, dtype=np.float32).reshape(5, 7, 1)
    source, covered = oracles.splat_nearest(number, np.asarray(motion), np.asarray(depth))
    expected = np.zeros((35, 2), np.float32)
    np.add.at(expected, source[covered][:, 0].astype(int), cotangent[covered])
    np.testing.assert_allclose(by_values, expected.reshape(5, 7, 2), atol=1e-6)
    assert not by_motion.any()
    assert not by_depth.any()


# Differentiable


@pytest.mark.parametrize(
    "size, mode",
    [(SIZES[0], mode) for mode in MODES] + [(size, "average") for size in SIZES[1:]] + [((1, 1), "softmax")],
)
def test_against_every_pair(size, mode):
    values, weights = random(*size, 2, low=-1), weights_for(mode, *size)
    for motion in (random_motion(*size), random(*size, 2, seed=9, low=-0.8, high=0.8), np.zeros((*size, 2), "f4")):
        result = splat(values, motion, weights, mode)
        np.testing.assert_allclose(result, oracles.splat(values, motion, weights, mode), atol=3e-6)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dx, dy", [(0, 0), (2, -1), (-9, 0)])
def test_whole_pixels_are_exact(mode, dx, dy):
    values = random(5, 7, 2, low=-3, high=3)
    weights = None if mode in ("sum", "average") else np.ones((5, 7, 1), np.float32)
    motion = np.full((5, 7, 2), (dx, dy), np.float32)
    np.testing.assert_array_equal(splat(values, motion, weights, mode), oracles.shift(values, -dx, -dy, 0))


def test_softmax_of_any_size_of_weights():
    """Weights of 1e4 on one pixel and -1e4 on the next: at each target the largest there counts."""
    values, motion = random(5, 7, 2), random(5, 7, 2, seed=9, low=-0.8, high=0.8)
    for scale in (1e2, 1e4, 1e30):
        weights = (random(5, 7, 1, seed=5, low=-1) * np.float32(scale)).astype(np.float32)
        result = splat(values, motion, weights, "softmax")
        np.testing.assert_allclose(result, oracles.splat(values, motion, weights, "softmax"), atol=1e-3)
        assert np.isfinite(result).all()
    equal = splat(values, motion, np.full((5, 7, 1), -1e30, np.float32), "softmax")
    np.testing.assert_allclose(equal, splat(values, motion), atol=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_bad_motion_weights_and_pixels(mode):
    values, motion, weights = random(5, 7, 2), np.zeros((5, 7, 2), np.float32), weights_for(mode, 5, 7)
    motion[0, 0], motion[1, 1], motion[2, 2], motion[3, 3] = np.nan, (np.inf, 0), 1e30, (0, -1e6)
    if weights is not None:
        weights[4, 4], weights[4, 5] = np.nan, np.inf
    values[0, 6], values[1, 6] = np.nan, np.inf
    result, expected = splat(values, motion, weights, mode), oracles.splat(values, motion, weights, mode)
    np.testing.assert_allclose(result, expected, atol=1e-6)
    assert np.isnan(result).sum() == 2
    for at in ((0, 0), (1, 1), (2, 2), (3, 3)) + (((4, 4), (4, 5)) if weights is not None else ()):
        np.testing.assert_array_equal(result[at], 0)


@pytest.mark.parametrize("mode, kind", [("average", "float16"), ("softmax", "bfloat16"), ("average", "float64")])
def test_dtypes(x64, mode, kind):
    values, motion = jnp.asarray(random(5, 7, 2), kind), jnp.asarray(random_motion(5, 7), np.float32)
    weights = None if mode == "average" else jnp.asarray(weights_for(mode, 5, 7), kind)
    result = jx.splat(values, motion, weights=weights, mode=mode)
    assert result.dtype == values.dtype
    wide = None if weights is None else np.float64(weights)
    step = float(jnp.finfo(values.dtype).eps)
    expected = oracles.splat(np.float64(values), np.float64(motion), wide, mode)
    np.testing.assert_allclose(np.float64(result), expected, atol=max(step, 1e-6))


@functools.cache
def pullback(mode):
    @jax.jit
    def run(values, motion, weights, cotangent):
        def forward(v, m, w):
            return jx.splat(v, m, weights=w if mode in ("linear", "softmax") else None, mode=mode)

        result, pull = jax.vjp(forward, values, motion, weights)
        return result, pull(cotangent)

    return run


def gradients(values, motion, weights, mode, cotangent):
    weights = np.zeros((*values.shape[:2], 1)) if weights is None else weights
    result, found = pullback(mode)(*(np.float64(a) for a in (values, motion, weights, cotangent)))
    return np.asarray(result), [np.asarray(g) for g in found]


@pytest.mark.slow
@pytest.mark.parametrize("mode, size", [(mode, (5, 7)) for mode in MODES] + [("average", (1, 1))])
def test_gradients_against_differences_of_the_loop(x64, mode, size):
    values, motion = random(*size, 2, dtype=np.float64), random_motion(*size, amount=1, dtype=np.float64)
    weights = weights_for(mode, *size, dtype=np.float64)
    cotangent = random(*size, 2, seed=4, low=-1, dtype=np.float64)
    result, found = gradients(values, motion, weights, mode, cotangent)
    np.testing.assert_allclose(result, oracles.splat(values, motion, weights, mode), rtol=1e-9, atol=1e-12)

    def loss(values, motion, *weights):
        return np.sum(cotangent * oracles.splat(values, motion, *weights, mode=mode))

    given = (values, motion) if weights is None else (values, motion, weights)
    oracles.assert_gradients(loss, given, found[: len(given)], directions=2)


@pytest.mark.parametrize("mode", MODES)
def test_gradients_stay_finite(x64, mode):
    """In holes, out of the frame, for motion that is not finite, and where weights differ by more than exp can hold."""
    values, motion, weights = random(5, 7, 2), random_motion(5, 7, amount=4), weights_for(mode, 5, 7)
    motion[0, 0], motion[1, 1], motion[2, 2], motion[3, 3] = np.nan, np.inf, 1e30, -1e6
    motion[4, :4] = 0
    if weights is not None:
        weights[4, 4], weights[4, 5] = np.nan, np.inf
        weights[3] *= 1e6 if mode == "softmax" else 0
    result, found = gradients(values, motion, weights, mode, np.ones((5, 7, 2)))
    assert np.isfinite(result).all()
    for gradient in found:
        assert np.isfinite(gradient).all()
        for at in ((0, 0), (1, 1), (2, 2), (3, 3)):
            np.testing.assert_array_equal(gradient[at], 0)


def test_gradient_at_a_pixel_centre(x64):
    """The documented side: the move to the right and down."""
    values, cotangent = random(5, 7, 2), random(5, 7, 2, seed=4)
    _, (by_values, by_motion, _) = gradients(values, np.zeros((5, 7, 2)), None, "sum", cotangent)
    np.testing.assert_allclose(by_values, cotangent, atol=1e-12)
    step = 1e-6
    for axis in (0, 1):
        moved = np.zeros((5, 7, 2))
        moved[2, 3, axis] = step
        change = oracles.splat(values, moved, mode="sum") - oracles.splat(values, moved * 0, mode="sum")
        np.testing.assert_allclose(by_motion[2, 3, axis], np.sum(change * cotangent) / step, rtol=1e-6)


# Properties

finite = {"allow_nan": False, "allow_infinity": False, "width": 32}


@property_test
@given(
    arrays(np.float32, (5, 7, 2), elements=st.floats(-(2.0**60), 2.0**60, **finite)),
    arrays(np.float32, (5, 7, 2), elements=st.one_of(st.floats(-4, 4, width=32), st.floats(**finite))),
    arrays(np.float32, (5, 7, 1), elements=st.floats(0, 2.0**30, **finite)),
)
def test_finite_in_finite_out(values, motion, weights):
    bound = np.abs(values).max() * (1 + 1e-5)
    for mode in MODES:
        result = splat(values, motion, weights if mode in ("linear", "softmax") else None, mode)
        assert np.isfinite(result).all()
        if mode != "sum":
            assert np.abs(result).max() <= bound
    result, covered = splat_nearest(values, motion, weights)
    assert np.isin(result[covered], values).all()
    assert not result[~covered].any()


@property_test
@given(st.integers(0, 2**31))
def test_splatting_is_the_adjoint_of_warping(seed):
    """<splat_sum(v, m), w> = <v, backward_warp(w, m)> for motion within the frame."""
    v, w, motion = random(5, 7, 2, seed=seed), random(5, 7, 2, seed=seed + 1), inner_motion(5, 7, seed=seed, margin=0)
    pushed, pulled = splat(v, motion, mode="sum"), np.asarray(jx.backward_warp(jnp.asarray(w), jnp.asarray(motion)))
    np.testing.assert_allclose(np.vdot(pushed, w), np.vdot(v, pulled), rtol=1e-5)


@property_test
@given(
    arrays(np.float32, (5, 7, 2), elements=st.floats(width=32, allow_subnormal=False)),
    st.integers(-9, 9),
    st.integers(-9, 9),
)
def test_any_image_shifts_exactly(values, dx, dy):
    motion = np.full((5, 7, 2), (dx, dy), np.float32)
    expected = oracles.shift(values, -dx, -dy, 0)
    np.testing.assert_array_equal(splat(values, motion), expected)
    np.testing.assert_array_equal(splat(values, motion, mode="sum"), expected)


# Errors


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"values": jnp.ones((4, 5))}, ValueError, r"values: expected shape \[H, W, C\], got \[4, 5\]"),
        ({"values": jnp.ones((4, 5, 2), int)}, TypeError, "values: .* got dtype int32"),
        ({"motion": jnp.ones((5, 4, 2))}, ValueError, r"motion: expected shape \[4, 5, 2\], got \[5, 4, 2\]"),
        ({"mode": "max"}, ValueError, "mode: expected one of 'sum', 'average', 'linear', 'softmax', got 'max'"),
        ({"mode": "softmax"}, ValueError, "weights: absent"),
        ({"mode": "linear", "weights": jnp.ones((4, 5))}, ValueError, r"weights: expected shape \[4, 5, 1\]"),
        ({"weights": jnp.ones((4, 5, 1))}, ValueError, "weights: expected None for mode='average'"),
    ],
)
def test_splat_errors(unchecked, change, error, message):
    arguments = {"values": jnp.ones((4, 5, 2)), "motion": jnp.zeros((4, 5, 2))} | change
    with pytest.raises(error, match=message):
        jx.splat(arguments.pop("values"), arguments.pop("motion"), **arguments)


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"values": jnp.ones((4, 5))}, ValueError, r"values: expected shape \[H, W, C\], got \[4, 5\]"),
        ({"motion": jnp.ones((4, 5, 3))}, ValueError, r"motion: expected shape \[4, 5, 2\], got \[4, 5, 3\]"),
        ({"depth": jnp.ones((4, 5))}, ValueError, r"depth: expected shape \[4, 5, 1\], got \[4, 5\]"),
        ({"depth": jnp.ones((4, 5, 1), int)}, TypeError, "depth: .* got dtype int32"),
        ({"footprint": 2}, ValueError, "footprint: expected 1 or 4, got 2"),
    ],
)
def test_splat_nearest_errors(unchecked, change, error, message):
    arguments = {"values": jnp.ones((4, 5, 2)), "motion": jnp.zeros((4, 5, 2)), "depth": jnp.ones((4, 5, 1))} | change
    positional = [arguments.pop(name) for name in ("values", "motion", "depth")]
    with pytest.raises(error, match=message):
        jx.splat_nearest(*positional, **arguments)
