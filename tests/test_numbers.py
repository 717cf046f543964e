"""What float32 holds: quotients, shares and sums of small and large numbers against float64; one line for mistakes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import random, random_motion

import jaxtrapolate as jx
from jaxtrapolate.methods.extranet import relative_depth
from jaxtrapolate.methods.hindsight import block_sums, from_blocks, plain_share
from jaxtrapolate.ops import grid, holes, radiance
from jaxtrapolate.precision import divide, share

H, W = 19, 22


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1.0, 1e12, 1e30])
def test_the_derivative_of_a_quotient(scale):
    """JAX's own has denominator^-2 in it, which over- or underflows."""
    a, b = np.float32(0.3 * scale), np.float32(0.7 * scale)
    found = jax.grad(lambda a, b: divide(a, b), (0, 1))(jnp.asarray(a), jnp.asarray(b))
    np.testing.assert_allclose(found, [1 / np.float64(b), -np.float64(a) / np.float64(b) ** 2], rtol=1e-5)
    curved = jax.grad(jax.grad(lambda b: divide(jnp.float32(1), b)))(jnp.float32(2))
    np.testing.assert_allclose(curved, 2 / 8)
    nothing = jax.grad(lambda a, b: divide(a, b), (0, 1))(jnp.float32(1), jnp.float32(0))
    np.testing.assert_array_equal(nothing, [0, 0])


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-30, 1e-15, 1.0, 1e25])
def test_shares(scale):
    part, rest = np.float32([0, 0.2, 3, 1e-3]) * np.float32(scale), np.float32([1, 0.7, 0, 2]) * np.float32(scale)
    a, b = np.float64(part), np.float64(rest)
    np.testing.assert_allclose(share(jnp.asarray(part), jnp.asarray(rest)), a**2 / (a**2 + b**2), rtol=1e-5)
    gradient = jax.grad(lambda a, b: share(a, b).sum(), (0, 1))(jnp.asarray(part), jnp.asarray(rest))
    whole = (a**2 + b**2) ** 2
    np.testing.assert_allclose(gradient[0], 2 * a * b**2 / whole, rtol=1e-4)
    np.testing.assert_allclose(gradient[1], -2 * b * a**2 / whole, rtol=1e-4)
    assert share(jnp.float32(0), jnp.float32(0), otherwise=1) == 1


@pytest.mark.parametrize("size", [(1, 1), (8, 16), (H, W)], ids=str)
def test_block_sums(size):
    image = random(*size, 1)
    found = block_sums(jnp.asarray(image))
    for j in range(found.shape[0]):
        for i in range(found.shape[1]):
            part = np.float64(image[8 * j : 8 * j + 8, 8 * i : 8 * i + 8])
            np.testing.assert_allclose(found[j, i, 0], part.sum(), rtol=1e-5)
    weights = jnp.asarray(random(*found.shape, seed=1))
    gradient = jax.grad(lambda a: jnp.vdot(weights, block_sums(a)))(jnp.asarray(image))
    rows, columns = (np.arange(n) // 8 for n in size)
    np.testing.assert_array_equal(gradient, weights[rows][:, columns])


def test_a_derivative_that_is_not_finite_stays_in_its_block():
    one = jnp.zeros((3, 3, 1)).at[1, 1].set(jnp.nan)
    gradient = np.asarray(jax.grad(lambda a: jnp.vdot(one, block_sums(a)))(jnp.zeros((H, W, 1))))
    rows, columns, _ = np.nonzero(np.isnan(gradient))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (8, 15, 8, 15)


def test_between_blocks():
    values = random(3, 3, 1)
    x, y = (jnp.asarray(a, jnp.float32) for a in np.meshgrid(np.arange(W), np.arange(H)))
    found = from_blocks(jnp.asarray(values), x + 0.5, y + 0.5)  # 4 is the middle of a block's pixels less half a one
    np.testing.assert_allclose(found[3, 3], values[0, 0], rtol=1e-6)
    np.testing.assert_allclose(found[11, 7], (values[1, 0] + values[1, 1]) / 2, rtol=1e-6)


def material():
    one = random(H, W, 1, seed=3)
    return jx.GBuffer(albedo=random(H, W, 3, seed=2), specular=one, roughness=one, n_dot_v=one)


@pytest.mark.slow
@pytest.mark.parametrize("apart", [0, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3])
def test_hindsight_has_finite_gradients_where_nothing_errs(apart):
    """A still scene, and frames that are nearly alike: fourth powers of small errors underflow."""
    buffers, color = material(), random(H, W, 3, seed=1)
    other = color * (1 + np.float32(apart) * random(H, W, 3, seed=4, low=-0.5, high=0.5))
    still = jnp.zeros((H, W, 2))

    def total(color, other, motion):
        shares = plain_share(jx.Frame(color, buffers), jx.Frame(other, buffers), motion, by="albedo+specular")
        return jnp.sum(shares), shares

    arrays = jnp.asarray(color), jnp.asarray(other), still
    gradients, shares = jax.grad(total, (0, 1, 2), has_aux=True)(*arrays)
    assert all(np.isfinite(g).all() for g in gradients)
    if apart == 0:
        np.testing.assert_array_equal(shares, 1)
    if apart >= 1e-4:  # against float64; below, float32 holds the errors themselves to a few digits
        with jax.enable_x64(True):
            wide = jax.tree.map(lambda a: jnp.asarray(np.asarray(a), jnp.float64), (arrays, buffers))
            (color, other, still), buffers = wide
            expected = plain_share(jx.Frame(color, buffers), jx.Frame(other, buffers), still, by="albedo+specular")
        np.testing.assert_allclose(shares, expected, atol=0.02)


@pytest.mark.parametrize("scale", [1e-30, 1.0, 3e38])
def test_linear_weights_of_any_size(scale):
    """Only their ratios count."""
    image, motion = random(H, W, 2), random_motion(H, W)
    weights = random(H, W, 1, seed=5, low=0.1)
    expected = jx.splat(jnp.asarray(image), jnp.asarray(motion), weights=jnp.asarray(weights), mode="linear")
    scaled = jnp.asarray(weights * np.float32(scale))
    found = jx.splat(jnp.asarray(image), jnp.asarray(motion), weights=scaled, mode="linear")
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_soft_masks_of_normals_of_any_length(scale):
    """They are scaled to length 1."""
    normal, other = (random(H, W, 3, seed=s, low=-1) for s in (1, 2))
    motion = jnp.asarray(random_motion(H, W))

    def masks(a, b):
        return holes.hole_masks(jx.GBuffer(normal=a), jx.GBuffer(normal=b), motion, softness=0.5).normal

    expected = masks(jnp.asarray(normal), jnp.asarray(other))
    found = masks(jnp.asarray(normal * np.float32(scale)), jnp.asarray(other * np.float32(scale)))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_curves_at_the_ends_of_float32():
    for curve, expected in ((radiance.tonemap, 1 / 2.2), (radiance.compress, 0.5)):
        value, gradient = jax.value_and_grad(curve)(jnp.float32(2e-38))
        np.testing.assert_allclose(value, 2e-38**expected, rtol=1e-4)
        np.testing.assert_allclose(gradient, expected * 2e-38 ** (expected - 1), rtol=1e-3)
        assert jax.value_and_grad(curve)(jnp.float32(1e-42)) == (0, 0)
    np.testing.assert_allclose(radiance.tonemap(jnp.float16(1e-6)), 1e-6 ** (1 / 2.2), rtol=0.1)  # subnormal there
    largest = float(jnp.finfo(jnp.float32).max)
    assert jax.value_and_grad(radiance.log_decode)(jnp.float32(100)) == (largest, 0)


def test_a_far_search_ends():
    flow = jnp.zeros((5, 6, 3)).at[:, 3:].set(3e38)
    found = jx.iterative_search(flow, 0.5, solver="newton", filter="bilinear")
    assert np.isfinite(found.position).all()
    np.testing.assert_array_equal(jx.chain_motion(jnp.full((2, 2, 2), 3e38), jnp.full((2, 2, 2), 3e38)), 2.0**31)


def test_relative_depth_against_float64():
    depth = np.float32([[[1e-2], [1e5], [np.inf], [0], [np.nan], [3.0]]])
    finite = np.float64(depth[np.isfinite(depth) & (depth > 0)])
    mean = 1 / np.mean(1 / finite)
    expected = np.where(np.isfinite(depth) & (depth > 0), mean / (mean + np.float64(depth)), 0)
    np.testing.assert_allclose(relative_depth(jnp.asarray(depth), None), expected, rtol=1e-5)


@pytest.mark.slow
def test_bfloat16_colours_are_searched_for_in_float32():
    """Bright colours: the inverse of the curve they are blended in has no digits left near 1 in bfloat16."""
    flow = jnp.zeros((H, W, 2))
    frames = [jx.Frame(color=jnp.asarray(20 * random(H, W, 3, seed=s)), motion=flow, time=float(s)) for s in range(3)]
    half = jx.load("bidirectional_image", dtype="bfloat16")((frames[0],), jx.Frame(time=1.0), (frames[2],))
    full = jx.load("bidirectional_image")((frames[0],), jx.Frame(time=1.0), (frames[2],))
    np.testing.assert_allclose(half, full, rtol=2**-7, atol=1e-3)


# One line for a mistake


def test_mistakes_end_in_a_line_of_the_librarys_own(unchecked):
    image, motion = jnp.ones((4, 5, 3)), jnp.zeros((4, 5, 2))
    for strides in (3, "13", (1.5,)):
        with pytest.raises(TypeError, match="strides: expected 1 to 7 distinct integers"):
            jx.guided_warp(image, motion, image, image, strides=strides)
    with pytest.raises(TypeError, match="sigma_guide: expected a number or an array of no axes, got 'half'"):
        jx.guided_warp(image, motion, image, image, sigma_guide="half")
    with pytest.raises(TypeError, match="fraction: expected a number or an array of no axes, got 'half'"):
        jx.iterative_search(motion, "half")
    with pytest.raises(ValueError, match=r"fraction: expected shape \[\], got \[2\]"):
        jx.iterative_search(motion, jnp.ones(2))
    frame = jx.Frame(color=image, motion=motion)
    for name in ("warp", "guided_net"):
        method = jx.load(name)
        with pytest.raises(TypeError, match=r"history\[0\]: expected a Frame, got"):
            method((image,), frame)
        with pytest.raises(TypeError, match="target: expected a Frame, got"):
            method((frame,), image)
        with pytest.raises(TypeError, match="history: expected a tuple of Frame, oldest first, got"):
            method(image, frame)
        with pytest.raises(TypeError, match=r"history\[0\].color: expected a floating-point array"):
            method((jx.Frame(color="red", motion=motion),), jx.Frame(motion=motion))
    assert grid.grid_warp(image, motion, None, 0.5)[1].all()
