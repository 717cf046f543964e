"""The grid warp and the filling of holes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from oracles import random

from jaxtrapolate.ops.fill import fill_around, fill_pyramid
from jaxtrapolate.ops.grid import grid_warp
from jaxtrapolate.ops.warp import backward_warp

SIZES = [(1, 1), (1, 7), (6, 1), (13, 11), (32, 48)]


def constant(size, value):
    return np.broadcast_to(np.float32(value), (*size, len(value))).copy()


def ramp(size):
    """A colour that is linear in x and y, so that bilinear fetches are exact."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    return np.stack([0.1 * x + 0.03 * y, 0.02 * x - 0.07 * y, np.ones_like(x)], -1)


@pytest.mark.slow
@pytest.mark.parametrize("cell", [3, 8])
@pytest.mark.parametrize("size", [*SIZES[:2], *(pytest.param(s, marks=pytest.mark.slow) for s in SIZES[2:])])
def test_no_flow_returns_the_image(size, cell):
    image, depth = random(*size, 3), random(*size, 1, seed=1, low=0.5)
    warped, covered = grid_warp(image, np.zeros((*size, 2), np.float32), depth, 0.5, cell=cell)
    assert covered.all()
    assert np.array_equal(warped, image)


@pytest.mark.parametrize("snap", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_whole_pixel_translation_is_exact(snap):
    size = (20, 31)
    image, depth = random(*size, 3), random(*size, 1, seed=1, low=0.5)
    warped, covered = grid_warp(image, constant(size, (4, -6)), depth, 0.5, snap=snap)
    assert np.asarray(covered)[:-3, 2:].all()
    assert np.array_equal(np.asarray(warped)[:-3, 2:], image[3:, :-2])
    assert not np.asarray(covered)[-2:].any()
    assert not np.asarray(covered)[:, :1].any()


@pytest.mark.parametrize("cell", [2, pytest.param(8, marks=pytest.mark.slow)])
def test_affine_motion_is_exact(cell):
    """A bilinear cell holds an affine flow, and its inverse is exact: all of a linear image, within rounding."""
    size = (33, 47)
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
    matrix, shift = np.array([[0.15, 0.06], [-0.04, 0.1]]), np.array([-2.3, 1.2])
    flow = np.stack([x, y], -1) @ matrix.T + shift
    warped, covered = grid_warp(ramp(size), flow.astype(np.float32), None, 1.0, cell=cell)
    source = (np.stack([x, y], -1) - shift) @ np.linalg.inv(np.eye(2) + matrix).T
    inner = np.all((source > 0) & (source < np.array(size[::-1]) - 1), -1)
    assert np.asarray(covered)[inner].all()
    expected = np.stack(
        [0.1 * source[..., 0] + 0.03 * source[..., 1], 0.02 * source[..., 0] - 0.07 * source[..., 1]], -1
    )
    np.testing.assert_allclose(np.asarray(warped)[inner][:, :2], expected[inner], atol=2e-4)


def test_the_nearer_layer_covers_and_its_silhouette_is_followed():
    """A box that lies on vertices moves over a wall: it arrives whole, and uncovers a hole where it was."""
    size = (41, 41)
    box = np.zeros(size, bool)
    box[8:25, 8:25] = True
    image = np.where(box[..., None], np.float32([1, 0.5, 0.2]), np.float32(0.1) * random(*size, 3))
    depth = np.where(box, 2, 10).astype(np.float32)[..., None]
    flow = np.where(box[..., None], np.float32([12, 0]), np.float32([0, 0]))
    warped, covered = (np.asarray(a) for a in grid_warp(image, flow, depth, 1.0))
    assert covered[8:25, 20:37].all()
    np.testing.assert_allclose(warped[9:24, 21:36], image[9:24, 9:24], atol=1e-6)
    assert np.array_equal(warped[33:], image[33:])
    assert not covered[12:20, 12:16].any()


@pytest.mark.slow
def test_a_snapped_silhouette_arrives_where_a_coarse_one_does_not():
    size = (41, 41)
    box = np.zeros(size, bool)
    box[11:27, 11:27] = True  # within reach of the vertices at 8 and 24
    image = np.where(box[..., None], np.float32([1, 1, 1]), np.float32([0, 0, 0]))
    depth = np.where(box, 2, 10).astype(np.float32)[..., None]
    flow = np.where(box[..., None], np.float32([3, 0]), np.float32([0, 0]))
    truth = np.roll(image, 3, 1)
    errors = []
    for snap in (True, False):
        warped, covered = grid_warp(image, flow, depth, 1.0, snap=snap)
        errors.append(np.abs(np.asarray(fill_pyramid(warped, covered)) - truth).mean())
    assert errors[0] < 0.7 * errors[1]


def test_torn_and_broken_cells_leave_holes():
    size = (17, 33)
    flow = np.zeros((*size, 2), np.float32)
    flow[:, 17:] = [20, 0]
    _, covered = grid_warp(random(*size, 1), flow, None, 1.0)
    assert np.asarray(covered)[:, :17].all()
    assert not np.asarray(covered)[:, 19:30].any()
    flow = np.zeros((*size, 2), np.float32)
    flow[8, 8] = np.nan  # a vertex: its four cells are not drawn
    _, covered = grid_warp(random(*size, 1), flow, None, 1.0)
    assert not np.asarray(covered)[2:14, 2:14].any()
    assert np.asarray(covered)[:, 17:].all()


def test_infinite_depth_lies_behind():
    size = (25, 25)
    flow = np.zeros((*size, 2), np.float32)
    flow[:, :9] = [8, 0]  # the sky, moving under what stands
    depth = np.full((*size, 1), 5, np.float32)
    depth[:, :9] = np.inf
    image = random(*size, 1)
    warped, _ = grid_warp(image, flow, depth, 1.0, snap=False)
    assert np.array_equal(np.asarray(warped)[:, 16:], image[:, 16:])


@pytest.mark.slow
def test_eager_is_jit_is_vmap():
    size = (13, 18)
    image, depth = random(*size, 2), random(*size, 1, seed=2, low=0.5)
    flow = 3 * np.stack([np.sin(np.mgrid[:13, :18][1] / 5), np.cos(np.mgrid[:13, :18][0] / 4)], -1).astype(np.float32)
    pair = [jnp.stack([jnp.asarray(a), jnp.asarray(a) * 0.9]) for a in (image, flow, depth)]
    mapped = jax.vmap(lambda i, f, d: grid_warp(i, f, d, 0.5, cell=4))(*pair)
    for k in (0, 1):
        alone = grid_warp(*(a[k] for a in pair), 0.5, cell=4)
        assert np.array_equal(alone[1], mapped[1][k])
        np.testing.assert_allclose(alone[0], mapped[0][k], atol=1e-6)


@pytest.mark.slow
def test_gradients(x64):
    size = (9, 10)
    rng = np.random.default_rng(0)
    image, depth = rng.random((*size, 2)), rng.random((*size, 1)) + 1
    flow = 0.3 + 0.02 * rng.random((*size, 2))
    check_grads(lambda i, a: grid_warp(i, flow, depth, a, cell=3)[0], (image, 0.61), order=1, modes=("fwd", "rev"))
    check_grads(lambda f: grid_warp(image, f, None, 1.0, cell=3)[0], (flow,), order=1, modes=("fwd", "rev"), rtol=1e-3)


def test_what_does_not_fit_is_named(unchecked):
    image, flow, depth = random(4, 5, 3), np.zeros((4, 5, 2), np.float32), random(4, 5, 1)
    with pytest.raises(ValueError, match=r"flow: expected shape \[4, 5, 2\]"):
        grid_warp(image, flow[:3], depth, 0.5)
    with pytest.raises(ValueError, match=r"depth: expected shape \[4, 5, 1\]"):
        grid_warp(image, flow, depth[:, :3], 0.5)
    with pytest.raises(ValueError, match="cell: expected an integer of at least 1, got 0"):
        grid_warp(image, flow, depth, 0.5, cell=0)
    for fill in (fill_pyramid, fill_around):
        with pytest.raises(TypeError, match="covered: expected a bool array, got float32"):
            fill(image, depth[..., 0])
        with pytest.raises(ValueError, match=r"covered: expected shape \[4, 5\], got \[3, 5\]"):
            fill(image, np.ones((3, 5), bool))


# Filling


def holes(size, share=0.3, seed=4):
    mask = np.random.default_rng(seed).random(size) < share
    mask.flat[-1] = True
    return mask


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("fill", [fill_pyramid, fill_around])
def test_covered_pixels_stay_and_a_constant_is_kept(size, fill):
    covered, image = holes(size), random(*size, 3)
    filled = np.asarray(fill(image, covered))
    assert np.array_equal(filled[covered], image[covered])
    assert np.array_equal(np.asarray(fill(image, np.ones(size, bool))), image)
    assert not np.asarray(fill(image, np.zeros(size, bool))).any()
    even = np.asarray(fill_pyramid(constant(size, (0.3, 7.7)), covered))
    np.testing.assert_allclose(even, constant(size, (0.3, 7.7)), rtol=1e-6)


def pyramid_loop(image, covered):
    """Pull-push in float64, pixel by pixel."""
    height, width, _ = image.shape
    if max(height, width) == 1:
        return image if covered[0, 0] else 0 * image
    coarse = np.zeros((-(-height // 2), -(-width // 2), image.shape[2]))
    known = np.zeros(coarse.shape[:2], bool)
    for j, i in np.ndindex(known.shape):
        block = [(y, x) for y in (2 * j, 2 * j + 1) for x in (2 * i, 2 * i + 1) if y < height and x < width]
        used = [image[p] for p in block if covered[p]]
        known[j, i] = bool(used)
        coarse[j, i] = np.mean(used, 0) if used else 0
    above = pyramid_loop(coarse, known)
    result = image.astype(np.float64)
    for y, x in np.argwhere(~covered):
        total = 0.0
        for j, wj in ((y // 2, 0.75), (y // 2 + (1 if y % 2 else -1), 0.25)):
            for i, wi in ((x // 2, 0.75), (x // 2 + (1 if x % 2 else -1), 0.25)):
                total = total + wj * wi * above[np.clip(j, 0, above.shape[0] - 1), np.clip(i, 0, above.shape[1] - 1)]
        result[y, x] = total
    return result


@pytest.mark.parametrize("size", [(1, 9), (13, 11), (16, 21)])
def test_pyramid_is_the_loop(size):
    image, covered = random(*size, 2), holes(size, 0.15)
    np.testing.assert_allclose(fill_pyramid(image, covered), pyramid_loop(image, covered), rtol=1e-5, atol=1e-6)


def test_what_is_not_finite_fills_nothing():
    image, covered = np.ones((6, 6, 1), np.float32), holes((6, 6))
    covered[0, 0], image[0, 0] = True, np.nan
    filled = np.asarray(fill_pyramid(image, covered))
    assert np.isnan(filled[0, 0])
    assert np.nansum(filled) == 35


def test_around_takes_the_farthest_then_the_closest():
    image = np.arange(25, dtype=np.float32).reshape(5, 5, 1)
    covered = np.zeros((5, 5), bool)
    covered[2, 0] = covered[2, 4] = covered[0, 2] = covered[4, 2] = True
    depth = np.ones((5, 5, 1), np.float32)
    depth[2, 4] = 9
    assert np.asarray(fill_around(image, covered, depth=depth))[2, 2, 0] == image[2, 4, 0]
    assert np.asarray(fill_around(image, covered))[2, 1, 0] == image[2, 0, 0]
    assert np.asarray(fill_around(image, covered))[2, 2, 0] == image[2, 0, 0]  # as far as the others: left comes first
    depth[2, 4], depth[4, 2] = np.nan, np.inf
    assert np.asarray(fill_around(image, covered, depth=depth))[2, 2, 0] == image[4, 2, 0]


@pytest.mark.slow
def test_filling_is_linear_and_differentiable():
    image, covered = random(7, 9, 2), holes((7, 9))
    for fill in (fill_pyramid, fill_around):
        gradient = jax.grad(lambda i, fill=fill: jnp.sum(fill(i, covered)))(jnp.asarray(image))
        np.testing.assert_allclose(
            np.sum(np.asarray(gradient) * image), np.sum(np.asarray(fill(image, covered))), rtol=1e-5
        )
        assert not np.asarray(gradient)[~covered].any()


def test_warped_then_filled_is_close_to_a_backward_warp():
    """On a smooth flow the grid agrees with the exact inverse of the flow within its cell's curvature."""
    size = (32, 48)
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32)
    flow = np.stack([2 + np.sin(y / 12), 1 + 0.5 * np.cos(x / 15)], -1).astype(np.float32)
    warped, covered = grid_warp(ramp(size), flow, None, 1.0, cell=4)
    back = -flow
    for _ in range(20):
        back = -np.asarray(backward_warp(flow, back))
    expected = np.asarray(backward_warp(ramp(size), back))
    inner = np.asarray(covered)[4:-4, 4:-4]
    assert inner.all()
    np.testing.assert_allclose(np.asarray(warped)[4:-4, 4:-4], expected[4:-4, 4:-4], atol=5e-3)
