"""far_motion, and the methods' guided warp in frames with holes that are wider than its kernels reach."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from oracles import random, random_motion

import jaxtrapolate as jx
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.ops.guided import far_motion
from jaxtrapolate.records import Frame, GBuffer


def inputs(*size, seed=0, amount=4.0):
    """Motion, both guides, holes."""
    guides = (random(*size, 2, seed=seed + k) for k in (1, 2))
    return random_motion(*size, seed=seed, amount=amount), *guides, random(*size, 1, seed=seed + 3) < 0.7


def expected(motion, target, source, holes, step, unlike=0.1):
    """By the float64 loop of the guided warp on every `step`-th pixel, whose image is its own coordinates."""
    height, width, _ = motion.shape
    at = [np.arange(min(step // 2, n - 1), n, step) for n in (height, width)]
    pick = np.ix_(*at)
    thin = motion[pick].astype(np.float64) / step
    grid = np.stack(np.meshgrid(np.arange(len(at[1])), np.arange(len(at[0]))), -1).astype(np.float64)
    found, gap = oracles.guided_warp(grid, thin, target[pick], source[pick], keep=1)
    out, clear = motion.astype(np.float64).copy(), np.ones((height, width), bool)
    for r, c, x, y, _ in oracles.places(motion):
        row, column = (int(np.clip(np.floor(v + 0.5), 0, n - 1)) for v, n in ((y, height), (x, width)))
        apart = ((target[r, c].astype(np.float64) - source[row, column]) ** 2).sum()
        if holes[r, c, 0] and apart > unlike:
            block = min(r // step, len(at[0]) - 1), min(c // step, len(at[1]) - 1)
            out[r, c] += step * (found[block] - grid[block] - thin[block])
            clear[r, c] = gap[block] > 3 * 2.0**-17
    return out, clear


@pytest.mark.parametrize(
    ("size", "step"),
    [
        ((13, 20), 2),
        pytest.param((13, 20), 3, marks=pytest.mark.slow),
        pytest.param((1, 9), 4, marks=pytest.mark.slow),
        ((7, 1), 2),
        ((1, 1), 5),
    ],
    ids=str,
)
def test_against_the_loop(size, step):
    arrays = inputs(*size)
    out, clear = expected(*arrays, step)
    result = np.asarray(far_motion(*arrays, step=step))
    assert clear.mean() > 0.9
    np.testing.assert_allclose(result[clear], out[clear], atol=2e-5)
    if min(size) > 1:
        assert 0.1 < (result != arrays[0]).mean() < 0.9


def test_only_unlike_holes_move():
    motion, target, source, holes = inputs(12, 18)
    np.testing.assert_array_equal(far_motion(motion, target, source, np.zeros_like(holes), step=2), motion)
    np.testing.assert_array_equal(far_motion(motion, target, source, holes, step=2, unlike=1e3), motion)
    np.testing.assert_array_equal(far_motion(motion, target, np.full_like(source, np.nan), holes, step=2), motion)


@pytest.mark.slow
def test_bad_motion_stays_in_its_block():
    motion, target, source, holes = inputs(12, 18)
    spoilt = motion.copy()
    spoilt[:4, 0] = [(np.nan, 0), (np.inf, 1), (1e30, -1e30), (-1e6, 0)]
    clean, result = (np.asarray(far_motion(m, target, source, holes, step=2)) for m in (motion, spoilt))
    np.testing.assert_array_equal(result[:, 2:], clean[:, 2:])
    np.testing.assert_array_equal(result[4:], clean[4:])
    warped = jx.guided_warp(random(12, 18, 3), result, target, source)
    assert np.isfinite(warped).all()


@pytest.mark.slow
def test_the_gradient_is_that_of_the_motion():
    motion, target, source, holes = inputs(8, 10)
    weights = random(8, 10, 2, seed=9)

    def total(*arrays):
        return jnp.sum(weights * far_motion(*arrays, holes, step=2))

    along, *others = jax.grad(total, argnums=(0, 1, 2))(motion, target, source)
    np.testing.assert_array_equal(along, weights)
    assert not any(np.any(other) for other in others)


def wide_hole(height=24, width=120):
    """A wall before which a post of 30 pixels moves by its width: the hole is wider than the kernels reach."""
    x = np.broadcast_to(np.arange(width), (height, width))
    frames = []
    for left in (70, 40):
        post = ((x >= left) & (x < left + 30))[..., None]
        albedo = np.where(post, [0.8, 0.1, 0.1], [0.1, 0.5, 0.7]).astype(np.float32)
        normal = np.where(post, [1.0, 0, 0], [0, 0, 1.0]).astype(np.float32)
        light = np.where(post, 1, 1 + 0.3 * np.sin(0.01 * x)[..., None]).astype(np.float32)
        depth, stencil = np.where(post, 2, 10).astype(np.float32), post.astype(np.float32)
        buffers = GBuffer(albedo=albedo, normal=normal, depth=depth, stencil=stencil)
        motion = np.where(post, [30, 0], [0, 0]).astype(np.float32)
        frames.append(Frame(color=albedo * light, gbuffer=buffers, motion=motion, time=float(len(frames))))
    hole = (x >= 70) & (x < 100)
    return frames, hole


@pytest.mark.slow
def test_a_hole_wider_than_the_kernels_is_filled_from_the_wall():
    (source, truth), hole = wide_hole()
    error = {}
    for rows in (None, 8):
        image = np.asarray(jx.load("guided_warp", rows=rows)((source,), hide(truth)))
        apart = np.abs(image - truth.color)
        assert apart[~hole].max() < 0.05
        error[rows] = apart[hole].mean()
    assert error[8] < 0.25 * error[None]
