"""Chains, conventions, cameras, occlusion motion and dilation, against float64 loops."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracles import SIZES, random, random_motion

import jaxtrapolate as jx

CROSS = ((-1, 0), (0, -1), (0, 1), (1, 0))
DIAGONAL = ((-1, -1), (-1, 1), (1, -1), (1, 1))
SQUARE = tuple((j, i) for j in (-1, 0, 1) for i in (-1, 0, 1) if (j, i) != (0, 0))
property_test = settings(max_examples=30, deadline=None, derandomize=True)


@pytest.fixture
def loose():
    """For what the strict promotion of ranks forbids inside the library."""
    with jax.numpy_rank_promotion("allow"):
        yield


def chain(newer, older):
    return np.asarray(jx.chain_motion(jnp.asarray(newer), jnp.asarray(older)))


# Chains


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_chain_against_the_loop(strict, size):
    newer, older = random_motion(*size, amount=3), random_motion(*size, seed=2, amount=3)
    np.testing.assert_allclose(chain(newer, older), oracles.chain_motion(newer, older), atol=5e-6)


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_chain_with_zero_is_exact(strict, size):
    motion, zero = random_motion(*size), np.zeros((*size, 2), np.float32)
    np.testing.assert_array_equal(chain(zero, motion), motion)
    np.testing.assert_array_equal(chain(motion, zero), motion)


def test_chain_of_constant_motion_adds_up(strict):
    newer, older = (np.full((5, 7, 2), v, np.float32) for v in ((1.5, -2.25), (0.25, 4)))
    np.testing.assert_array_equal(chain(newer, older), newer + older)


def test_chain_keeps_what_is_not_finite(strict):
    newer, older = np.zeros((5, 7, 2), np.float32), random_motion(5, 7)
    newer[0, 0], newer[1, 1], newer[2, 2] = (np.nan, 0), (np.inf, 0), (0.5, 0)
    older[2, 3], older[4, 4] = np.nan, np.inf
    result = chain(newer, older)
    finite = np.isfinite(result).all(-1)
    assert {tuple(at) for at in np.argwhere(~finite)} == {(0, 0), (1, 1), (2, 2), (2, 3), (4, 4)}


@property_test
@given(
    arrays(np.float32, (5, 7, 2), elements=st.floats(-(2.0**100), 2.0**100, width=32)),
    arrays(np.float32, (5, 7, 2), elements=st.floats(-(2.0**100), 2.0**100, width=32)),
)
def test_chain_finite_in_finite_out(newer, older):
    assert np.isfinite(chain(newer, older)).all()


@property_test
@given(
    arrays(np.float32, (5, 7, 2), elements=st.integers(-9, 9).map(float)),
    arrays(np.float32, (5, 7, 2), elements=st.floats(-100, 100, width=32)),
)
def test_chain_of_whole_pixels_is_exact(newer, older):
    expected = np.empty_like(newer)
    for r, c, x, y, _ in oracles.places(newer):
        expected[r, c] = newer[r, c] + older[int(np.clip(y, 0, 4)), int(np.clip(x, 0, 6))]
    np.testing.assert_array_equal(chain(newer, older), expected)


@functools.cache
def chain_pullback():
    @jax.jit
    def run(newer, older, cotangent):
        result, pull = jax.vjp(jx.chain_motion, newer, older)
        return result, pull(cotangent)

    return run


def test_chain_gradients(x64):
    newer, older = (random_motion(5, 7, seed=s, dtype=np.float64) for s in (1, 2))
    cotangent = random(5, 7, 2, seed=4, low=-1, dtype=np.float64)
    _, found = chain_pullback()(newer, older, cotangent)
    oracles.assert_gradients(lambda a, b: np.sum(cotangent * oracles.chain_motion(a, b)), (newer, older), found)
    newer[0, 0], newer[1, 1], newer[2, 2] = np.nan, np.inf, 1e30
    _, found = chain_pullback()(newer, older, cotangent)
    assert all(np.isfinite(gradient).all() for gradient in found)


# Conventions


@pytest.mark.parametrize("sign", ["previous_minus_current", "current_minus_previous"])
@pytest.mark.parametrize("units", ["pixels", "uv", "ndc"])
@pytest.mark.parametrize("y_axis", ["down", "up"])
def test_convert_motion_tells_where_a_point_was(loose, sign, units, y_axis):
    """A point at (4, 1) of a 6 x 8 frame was at (2.5, 3): what an engine of each convention stores leads there."""
    height, width = 6, 8

    def place(x, y):  # in the engine's units
        u, v = (x + 0.5) / width, (y + 0.5) / height
        v = v if y_axis == "down" else 1 - v
        if units == "pixels":
            return np.array([u * width, v * height])
        return np.array([u, v]) if units == "uv" else np.array([2 * u - 1, 2 * v - 1])

    stored = place(2.5, 3) - place(4, 1)
    stored = stored if sign == "previous_minus_current" else -stored
    motion = jnp.broadcast_to(jnp.asarray(stored, jnp.float32), (height, width, 2))
    result = jx.convert_motion(motion, sign=sign, units=units, y_axis=y_axis)
    assert result.dtype == jnp.float32
    np.testing.assert_allclose(result[1, 4], [-1.5, 2], rtol=1e-6)


def test_convert_motion_keeps_our_convention_bit_for_bit(loose):
    motion = random(5, 7, 2, low=-9, high=9)
    motion[0, 0] = np.nan
    ours = {"sign": "previous_minus_current", "units": "pixels", "y_axis": "down"}
    np.testing.assert_array_equal(jx.convert_motion(jnp.asarray(motion), **ours), motion)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["float16", "bfloat16"])
def test_convert_motion_keeps_the_dtype(loose, kind):
    motion = jnp.ones((5, 7, 2), kind)
    result = jx.convert_motion(motion, sign="current_minus_previous", units="uv", y_axis="up")
    assert result.dtype == motion.dtype
    np.testing.assert_array_equal(np.float32(result[0, 0]), [-7, 5])


def test_convert_motion_gradient(loose):
    motion = jnp.asarray(random(5, 7, 2))
    options = {"sign": "current_minus_previous", "units": "ndc", "y_axis": "up"}
    found = jax.grad(lambda m: jnp.sum(jx.convert_motion(m, **options)))(motion)
    np.testing.assert_array_equal(found, np.broadcast_to(np.float32([-3.5, 2.5]), (5, 7, 2)))


# Cameras


def cameras(height, width, dtype=np.float32):
    projection = oracles.perspective(height, width)
    now, before = (oracles.look(0.1, (0.2, 0.1, 0)), projection), (oracles.look(-0.05, (0, 0, 0.3)), projection)
    return now, before, *(jx.Camera(*(jnp.asarray(m, dtype) for m in pair)) for pair in (now, before))


def scene(height, width, dtype=np.float32):
    position = random(height, width, 3, low=-2, high=2)
    position[..., 2] -= 5
    return position.astype(dtype)


def moving(dtype=np.float32):
    turn = oracles.look(0.3)
    turn[:3, 3] = 0.5, 0, -0.2
    return np.stack([np.eye(4), turn]).astype(dtype)


@pytest.mark.parametrize("size", [(5, 7), (1, 6), (1, 1)], ids=str)
def test_camera_motion_against_projection(loose, size):
    now, before, camera, previous = cameras(*size)
    position = scene(*size)
    result = jx.camera_motion(jnp.asarray(position), camera, previous)
    np.testing.assert_allclose(result, oracles.camera_motion(position, now, before), atol=2e-5)
    np.testing.assert_array_equal(jx.camera_motion(jnp.asarray(position), camera, camera), np.zeros((*size, 2)))


def test_camera_motion_of_objects(loose):
    now, before, camera, previous = cameras(5, 7)
    position, matrices = scene(5, 7), moving()
    stencil = np.random.default_rng(3).integers(-1, 4, (5, 7, 1)).astype(np.float32)
    given = (jnp.asarray(a) for a in (matrices, stencil))
    result = jx.camera_motion(
        jnp.asarray(position), camera, previous, **dict(zip(("object_motion", "stencil"), given, strict=True))
    )
    expected = oracles.camera_motion(position, now, before, matrices, stencil)
    np.testing.assert_allclose(result, expected, atol=2e-5)
    assert np.abs(expected - oracles.camera_motion(position, now, before)).max() > 0.1


def test_camera_motion_brings_positions_to_their_pixels(loose):
    """Positions laid out through the pixel grid of a camera: p + motion[p] is where the previous camera sees them."""
    height, width = 4, 6
    projection = oracles.perspective(height, width)
    y, x = np.mgrid[:height, :width]
    ndc = np.stack([2 * (x + 0.5) / width - 1, 1 - 2 * (y + 0.5) / height], -1)
    position = np.concatenate([ndc * 4 / [projection[0, 0], projection[1, 1]], np.full((height, width, 1), -4.0)], -1)
    moved = oracles.look(eye=(8 / width / projection[0, 0], 0, 0))  # by one pixel at this depth
    still = jx.Camera(*(jnp.asarray(m, jnp.float32) for m in (np.eye(4), projection)))
    previous = jx.Camera(*(jnp.asarray(m, jnp.float32) for m in (moved, projection)))
    result = jx.camera_motion(jnp.asarray(position, jnp.float32), still, previous)
    np.testing.assert_allclose(result, np.broadcast_to([-1.0, 0.0], (height, width, 2)), atol=1e-5)


def test_camera_motion_behind_a_camera_and_without_position(loose):
    now, before, camera, previous = cameras(5, 7)
    position = scene(5, 7)
    position[0, 0], position[1, 1], position[2, 2] = (0, 0, 9), (np.nan, 0, -5), (0, np.inf, -5)
    position[3, 3] = 0.2, 0.1, 0.15  # ahead of the previous camera alone
    result = np.asarray(jx.camera_motion(jnp.asarray(position), camera, previous))
    np.testing.assert_allclose(result, oracles.camera_motion(position, now, before), atol=2e-5)
    assert {tuple(at) for at in np.argwhere(np.isnan(result).all(-1))} == {(0, 0), (1, 1), (2, 2), (3, 3)}
    found = jax.grad(lambda p, c, b: jnp.sum(jnp.nan_to_num(jx.camera_motion(p, c, b))), argnums=(0, 1, 2))(
        jnp.asarray(position), camera, previous
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    np.testing.assert_array_equal(np.asarray(found[0])[[0, 1, 2, 3], [0, 1, 2, 3]], 0)


def test_camera_motion_gradients(x64, loose):
    now, before, _, _ = cameras(5, 7, np.float64)
    position, matrices = scene(5, 7, np.float64), moving(np.float64)
    stencil = np.random.default_rng(3).integers(-1, 4, (5, 7, 1)).astype(np.float64)
    cotangent = random(5, 7, 2, seed=4, low=-1, dtype=np.float64)

    @jax.jit
    def gradient(*arguments):
        def loss(position, view, projection, old_view, matrices):
            cameras = jx.Camera(view, projection), jx.Camera(old_view, before[1])
            return jnp.sum(cotangent * jx.camera_motion(position, *cameras, object_motion=matrices, stencil=stencil))

        return jax.grad(loss, argnums=(0, 1, 2, 3, 4))(*arguments)

    def loss(position, view, projection, old_view, matrices):
        cameras = (view, projection), (old_view, before[1])
        return np.sum(cotangent * oracles.camera_motion(position, *cameras, matrices, stencil))

    given = (position, now[0], now[1], before[0], matrices)
    stencil = jnp.asarray(stencil)
    oracles.assert_gradients(loss, given, gradient(*given), directions=2)


# Occlusion motion and dilation


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_occlusion_motion_against_the_loop(strict, size):
    depth = random(*size, 1, seed=8)
    for motion in (random_motion(*size), random(*size, 2, low=-6, high=6), random_motion(*size, kinks=True)):
        result = jx.occlusion_motion(jnp.asarray(motion), jnp.asarray(depth))
        np.testing.assert_array_equal(result, oracles.occlusion_motion(motion, depth))


def test_occlusion_motion_finds_the_occluder(strict):
    """A near box that moved right uncovers background on its left, whose occlusion vector is the box's."""
    motion, depth = np.zeros((4, 9, 2), np.float32), np.full((4, 9, 1), 5, np.float32)
    motion[:, 5:7], depth[:, 5:7] = (-2, 0), 1  # box at 5..6 now, at 3..4 before
    result = np.asarray(jx.occlusion_motion(jnp.asarray(motion), jnp.asarray(depth)))
    np.testing.assert_array_equal(result[:, 3:5], np.broadcast_to(np.float32([-2, 0]), (4, 2, 2)))
    np.testing.assert_array_equal(result[:, :3], 0)


def test_occlusion_motion_of_extreme_vectors(strict):
    motion, depth = random_motion(5, 7), random(5, 7, 1, seed=8)
    for k, bad in enumerate([np.nan, np.inf, -np.inf, 1e6, -1e30]):
        motion[k, k, k % 2] = bad
    result = np.asarray(jx.occlusion_motion(jnp.asarray(motion), jnp.asarray(depth)))
    np.testing.assert_array_equal(result, oracles.occlusion_motion(motion, depth))
    assert np.isfinite(result).all()


def test_occlusion_motion_gradient(strict):
    motion, depth = random_motion(5, 7), random(5, 7, 1, seed=8)
    by_motion, by_depth = jax.grad(lambda m, d: jnp.sum(jx.occlusion_motion(m, d)), argnums=(0, 1))(
        jnp.asarray(motion), jnp.asarray(depth)
    )
    number = np.arange(1, 36, dtype=np.float32).reshape(5, 7, 1)
    splatted, _ = oracles.splat_nearest(number, motion, depth)
    count = np.zeros(36)
    for _, _, x, y, _ in oracles.places(motion):
        count[int(splatted[int(np.clip(np.floor(y), 0, 4)), int(np.clip(np.floor(x), 0, 6)), 0])] += 1
    np.testing.assert_array_equal(by_motion, np.repeat(count[1:].reshape(5, 7, 1), 2, -1))
    assert not by_depth.any()


@pytest.mark.parametrize("neighbours, offsets", [("diagonal", DIAGONAL), ("cross", CROSS), ("square", SQUARE)])
@pytest.mark.parametrize("size", SIZES[:4], ids=str)
def test_dilate_motion_against_the_loop(strict, size, neighbours, offsets):
    motion, depth = random_motion(*size), random(*size, 1, seed=8)
    depth = np.round(depth * 4)  # with ties
    depth.flat[0] = np.nan
    depth.flat[-1] = -np.inf
    motion.flat[2:4] = np.nan
    result = jx.dilate_motion(jnp.asarray(motion), jnp.asarray(depth), neighbours=neighbours)
    np.testing.assert_array_equal(result, oracles.dilate_motion(motion, depth, offsets))


def test_dilate_motion_gradient(strict):
    motion, depth = random_motion(5, 7), random(5, 7, 1, seed=8)
    by_motion, by_depth = jax.grad(lambda m, d: jnp.sum(jx.dilate_motion(m, d)), argnums=(0, 1))(
        jnp.asarray(motion), jnp.asarray(depth)
    )
    number = np.arange(35, dtype=np.float32).reshape(5, 7, 1).repeat(2, -1)
    picked = oracles.dilate_motion(number, depth, DIAGONAL)[..., 0].astype(int)
    np.testing.assert_array_equal(np.asarray(by_motion)[..., 0], np.bincount(picked.flat, minlength=35).reshape(5, 7))
    assert not by_depth.any()


# Errors


OPTIONS = {"sign": "previous_minus_current", "units": "uv", "y_axis": "up"}


@pytest.mark.parametrize(
    "function, arguments, options, error, message",
    [
        ("chain_motion", [(4, 5, 3), (4, 5, 2)], {}, ValueError, r"newer: expected shape \[H, W, 2\], got \[4, 5, 3\]"),
        ("chain_motion", [(4, 5, 2), (5, 4, 2)], {}, ValueError, r"older: expected shape \[4, 5, 2\], got \[5, 4, 2\]"),
        ("convert_motion", [(4, 5)], OPTIONS, ValueError, r"motion: expected shape \[H, W, 2\], got \[4, 5\]"),
        (
            "convert_motion",
            [(4, 5, 2)],
            OPTIONS | {"sign": "back"},
            ValueError,
            "sign: .* 'current_minus_previous', got",
        ),
        (
            "convert_motion",
            [(4, 5, 2)],
            OPTIONS | {"units": "texel"},
            ValueError,
            "units: .*'pixels', 'uv', 'ndc', got",
        ),
        ("convert_motion", [(4, 5, 2)], OPTIONS | {"y_axis": "left"}, ValueError, "y_axis: .*'down', 'up', got 'left'"),
        ("occlusion_motion", [(4, 5, 2), (4, 5, 2)], {}, ValueError, r"depth: expected shape \[4, 5, 1\], got"),
        ("occlusion_motion", [(4, 5), (4, 5, 1)], {}, ValueError, r"motion: expected shape \[H, W, 2\], got"),
        ("dilate_motion", [(4, 5, 2), (4, 4, 1)], {}, ValueError, r"depth: expected shape \[4, 5, 1\], got"),
        (
            "dilate_motion",
            [(4, 5, 2), (4, 5, 1)],
            {"neighbours": "all"},
            ValueError,
            "neighbours: .*'square', got 'all'",
        ),
    ],
)
def test_errors(unchecked, function, arguments, options, error, message):
    with pytest.raises(error, match=message):
        getattr(jx, function)(*(jnp.ones(shape) for shape in arguments), **options)
    with pytest.raises(TypeError, match="expected a floating-point array"):
        getattr(jx, function)(*(jnp.ones(shape, int) for shape in arguments), **options)


def test_camera_motion_errors(unchecked):
    camera, position = jx.Camera(jnp.eye(4), jnp.eye(4)), jnp.ones((4, 5, 3))
    with pytest.raises(ValueError, match=r"position: expected shape \[H, W, 3\], got \[4, 5, 2\]"):
        jx.camera_motion(jnp.ones((4, 5, 2)), camera, camera)
    with pytest.raises(TypeError, match="camera: expected a Camera, got "):
        jx.camera_motion(position, jnp.eye(4), camera)
    with pytest.raises(TypeError, match=r"previous_camera\.projection: .*got NoneType"):
        jx.camera_motion(position, camera, jx.Camera(jnp.eye(4)))
    with pytest.raises(ValueError, match="object_motion, stencil: expected both or neither"):
        jx.camera_motion(position, camera, camera, stencil=jnp.ones((4, 5, 1)))
    with pytest.raises(ValueError, match=r"object_motion: expected shape \[N, 4, 4\], got \[4, 4\]"):
        jx.camera_motion(position, camera, camera, stencil=jnp.ones((4, 5, 1)), object_motion=jnp.eye(4))
    with pytest.raises(ValueError, match=r"stencil: expected shape \[4, 5, 1\], got \[4, 5, 2\]"):
        jx.camera_motion(position, camera, camera, stencil=jnp.ones((4, 5, 2)), object_motion=jnp.eye(4)[None])
