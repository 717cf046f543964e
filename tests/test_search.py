"""iterative_search and its starts: exact motions, a loop from the paper, gradients of the converged answer."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from oracles import SIZES, random

import jaxtrapolate as jx

pytestmark = pytest.mark.usefixtures("strict")


def search_loop(flow, fraction, start=None, iterations=3, filter="bilinear"):
    """Section 5.1 of the paper, pixel by pixel in float64: position, fraction * flow there, error."""
    flow = np.asarray(flow, np.float64)
    height, width, channels = flow.shape
    found, offset, error = (
        np.zeros((height, width, 2)),
        np.zeros((height, width, channels - 2)),
        np.zeros((height, width)),
    )
    for r, c in np.ndindex(height, width):
        p = np.array([c, r], np.float64)
        q = p if start is None else np.float64(start[r, c])
        for _ in range(iterations):
            q = p - fraction * oracles.sample(flow, *q, filter)[:2]  # eq. 5
        value = oracles.sample(flow, *q, filter)
        found[r, c], offset[r, c] = q, fraction * value[2:]  # eq. 6
        error[r, c] = np.hypot(*(q + fraction * value[:2] - p))  # eq. 7
    return found, offset, error[..., None]


def converged(flow, fraction, iterations=300):
    return search_loop(flow, fraction, iterations=iterations)


def smooth_flow(height, width, *, slope=0.3, dtype=np.float32):
    """Changes by less than a pixel per pixel, so that all solvers converge."""
    rng = np.random.default_rng(3)
    return (rng.uniform(-1, 1, (height, width, 3)) * slope + [0.6, -0.4, 0.1]).astype(dtype)


def affine_flow(height, width, matrix, offset):
    """flow(q) = matrix (q - centre) + offset, and the change of depth the first component."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    around = np.stack([x - (width - 1) / 2, y - (height - 1) / 2], -1)
    flow = around @ np.asarray(matrix).T + np.asarray(offset)
    return np.concatenate([flow, flow[..., :1]], -1)


def run(flow, fraction, **options):
    found = jx.iterative_search(jnp.asarray(flow), fraction, **options)
    return tuple(np.asarray(a) for a in (found.position, found.depth_offset, found.error))


SOLVERS = ["fixed_point", "newton"]
FILTERS = ["bilinear", "nearest"]


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("size", [*SIZES, (37, 5)], ids=str)
def test_against_the_loop(size, filter):
    """(37, 5) is more than two strips of the CPU's loop, the last one not full."""
    # nearest is sensitive to rounding at ties: a fraction that is far from them
    flow = (
        random(*size, 3, low=-2, high=2) if filter == "bilinear" else np.round(random(*size, 3, low=-3, high=3) * 4) / 4
    )
    fraction = 0.4 if filter == "bilinear" else 0.37
    expected = search_loop(flow, np.float32(fraction), filter=filter)
    for found, wanted in zip(run(flow, fraction, filter=filter), expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-5)


def test_start_and_iterations_against_the_loop():
    flow, start = smooth_flow(6, 8), random(6, 8, 2, seed=5, low=-2, high=9)
    for iterations in (0, 1, 4):
        found = run(flow, 0.7, start=jnp.asarray(start), iterations=iterations)
        for a, b in zip(found, search_loop(flow, np.float32(0.7), start, iterations), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("solver, filter", [("fixed_point", "nearest"), ("newton", "bilinear")])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_no_motion_is_the_identity(size, solver, filter):
    position, offset, error = run(np.zeros((*size, 3), np.float32), 0.3, solver=solver, filter=filter)
    y, x = np.mgrid[: size[0], : size[1]]
    np.testing.assert_array_equal(position, np.stack([x, y], -1))
    np.testing.assert_array_equal(offset, 0)
    np.testing.assert_array_equal(error, 0)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("dx, dy, fraction", [(1, 0, 1.0), (-2, 3, 1.0), (4, -2, 0.5), (8, 8, 0.25)])
def test_whole_pixels_are_exact(solver, dx, dy, fraction):
    """Everywhere, also where the position lies outside the frame."""
    flow = np.broadcast_to(np.float32([dx, dy, 2]), (5, 7, 3))
    position, offset, error = run(flow, fraction, solver=solver)
    y, x = np.mgrid[:5, :7]
    np.testing.assert_array_equal(position, np.stack([x - fraction * dx, y - fraction * dy], -1))
    np.testing.assert_array_equal(offset, 2 * fraction)
    np.testing.assert_array_equal(error, 0)


@pytest.mark.parametrize("solver, iterations", [("fixed_point", 60), ("newton", 4)])
@pytest.mark.parametrize("angle, zoom", [(0.3, 1.0), (0.0, 1.4), (-0.2, 0.75), (0.5, 1.1)])
def test_rotation_and_zoom_are_found(solver, iterations, angle, zoom):
    """The point that comes to p by (1 - a) q + a (s R q + d): the inverse of I + a (s R - I), known exactly."""
    height, width, fraction, offset = 15, 21, 0.6, np.array([0.4, -0.7])
    turn = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) - np.eye(2)
    flow = affine_flow(height, width, turn, offset)
    position, depth, error = run(flow.astype(np.float32), fraction, solver=solver, iterations=iterations)
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    y, x = np.mgrid[:height, :width]
    p = np.stack([x, y], -1) - centre - fraction * offset
    exact = p @ np.linalg.inv(np.eye(2) + fraction * turn).T + centre
    # beyond the outermost centres the flow is not the affine one any more
    inner = ((exact >= 0) & (exact <= [width - 1, height - 1])).all(-1)
    assert inner.mean() > 0.5
    np.testing.assert_allclose(position[inner], exact[inner], atol=1e-4)
    there = (exact - centre) @ turn.T + offset
    np.testing.assert_allclose(depth[inner][:, 0], fraction * there[inner][:, 0], atol=1e-4)
    assert error[inner].max() < 1e-4


def test_newton_needs_fewer_steps():
    y, x = np.mgrid[:24, :24] / 4
    flow = np.stack([np.sin(x + y), np.cos(x - y), x], -1).astype(np.float32)
    fixed, newton = (run(flow, 0.9, solver=solver)[2] for solver in SOLVERS)
    assert np.median(newton) < 0.05 * np.median(fixed)


def test_newton_holds_where_the_matrix_is_singular():
    """A flow of -q / fraction maps all points of a cell to one: no step may be longer than ten times the miss."""
    flow = affine_flow(6, 8, [[-2, 0], [0, -2]], [0.3, 0.2]).astype(np.float32)
    position, _, error = run(flow, 0.5, solver="newton", iterations=1)
    y, x = np.mgrid[:6, :8]
    miss = run(flow, 0.5, iterations=0)[2][..., 0]
    assert (np.hypot(*np.moveaxis(position - np.stack([x, y], -1), -1, 0)) <= 10.001 * miss + 1e-6).all()
    assert np.isfinite(error).all()


def test_without_depth():
    flow = smooth_flow(5, 7)
    found = jx.iterative_search(jnp.asarray(flow[..., :2]), 0.5)
    assert found.depth_offset is None
    np.testing.assert_array_equal(found.position, run(flow, 0.5)[0])


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_flow_that_is_not_finite(filter, bad):
    """No motion there; an infinite error for those whose answer would use it, and only for those."""
    flow = np.zeros((6, 7, 3), np.float32)
    flow[..., 0] = 0.25
    flow[2, 3, 1] = bad
    position, offset, error = run(flow, 1.0, filter=filter)
    assert np.isfinite(position).all()
    assert np.isfinite(offset).all()
    hit = np.zeros((6, 7), bool)
    hit[2, 3] = True
    hit[2, 4] = filter == "bilinear"
    np.testing.assert_array_equal(np.isinf(error[..., 0]), hit)
    np.testing.assert_allclose(error[~hit], 0, atol=1e-6)
    flow = np.full((3, 4, 3), bad, np.float32)
    position, offset, error = run(flow, 0.5, filter=filter)
    np.testing.assert_array_equal(position[2, 3], [3, 2])
    assert np.isinf(error).all()


def test_a_change_of_depth_that_is_not_finite_counts_as_none():
    flow = np.zeros((4, 5, 3), np.float32)
    flow[1, 2, 2] = np.nan
    _, offset, error = run(flow, 0.5)
    np.testing.assert_array_equal(offset, 0)
    np.testing.assert_array_equal(error, 0)


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_extreme_flow(solver):
    @jax.jit
    def gradient(flow, fraction):
        def total(flow, fraction):
            found = jx.iterative_search(flow, fraction, solver=solver)
            return jnp.sum(jnp.tanh(found.position)) + jnp.sum(jnp.where(jnp.isfinite(found.error), found.error, 0))

        return jax.grad(total, argnums=(0, 1))(flow, fraction)

    for amount in (1e6, -1e30, 3e38):
        flow = np.zeros((5, 6, 3), np.float32)
        flow[2, 2, 0] = flow[3, 1, 1] = amount
        position, _, error = run(flow, 0.5, solver=solver)
        assert not np.isnan(error).any()
        assert np.isfinite(position).all()
        assert all(np.isfinite(g).all() for g in gradient(jnp.asarray(flow), jnp.float32(0.5)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["float16", "bfloat16", "float64"])
def test_dtypes(x64, kind):
    flow = jnp.asarray(random(3, 500, 3, low=-2, high=2), kind)
    found = jx.iterative_search(flow, 0.5)
    assert found.position.dtype == found.error.dtype == ("float64" if kind == "float64" else "float32")
    expected = search_loop(np.float64(flow), 0.5)
    np.testing.assert_allclose(found.position, expected[0], atol=1e-9 if kind == "float64" else 2e-3)


@pytest.mark.slow
def test_jit_vmap_and_eager_agree():
    flows = np.stack([smooth_flow(20, 6), 0.5 * smooth_flow(20, 6)])
    fractions = np.float32([0.3, 0.8])

    def position(flow, fraction):
        return jx.iterative_search(flow, fraction).position

    mapped = jax.vmap(position)(jnp.asarray(flows), jnp.asarray(fractions))
    for k in (0, 1):
        given = jnp.asarray(flows[k]), jnp.asarray(fractions[k])
        eager = position(*given)
        np.testing.assert_allclose(mapped[k], eager, atol=1e-6)
        np.testing.assert_allclose(jax.jit(position)(*given), eager, atol=1e-6)


def test_another_fraction_traces_nothing():
    import jax._src.test_util as jtu

    flow = jnp.asarray(smooth_flow(5, 7))
    jx.iterative_search(flow, 0.25)
    with jtu.count_jit_and_pmap_lowerings() as count:
        for fraction in (0.5, 0.75, 1.0):
            jx.iterative_search(flow, fraction)
    assert count() == 0


# Gradients, in float64, of a solution that has converged


@functools.cache
def derivatives(solver, iterations):
    def outputs(flow, fraction):
        found = jx.iterative_search(flow, fraction, solver=solver, iterations=iterations)
        return found.position, found.depth_offset

    @jax.jit
    def both(flow, fraction, d_flow, d_fraction, cotangents):
        values, forward = jax.jvp(outputs, (flow, fraction), (d_flow, d_fraction))
        _, pull = jax.vjp(outputs, flow, fraction)
        return values, forward, pull(cotangents)

    return both


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver, iterations", [pytest.param("fixed_point", 120, marks=pytest.mark.slow), ("newton", 8)]
)
def test_gradients_against_differences_of_the_converged_loop(x64, solver, iterations):
    """Forward and reverse, with respect to flow and fraction."""
    flow, fraction = np.float64(smooth_flow(5, 6)), np.float64(0.7)
    rng = np.random.default_rng(0)
    d_flow, d_fraction = rng.uniform(-1, 1, flow.shape), np.float64(0.3)
    cotangents = (rng.uniform(-1, 1, (5, 6, 2)), rng.uniform(-1, 1, (5, 6, 1)))
    values, forward, reverse = derivatives(solver, iterations)(flow, fraction, d_flow, d_fraction, cotangents)
    step = 1e-6
    up, down = (converged(flow + s * d_flow, fraction + s * d_fraction)[:2] for s in (step, -step))
    for value, wanted in zip(values, converged(flow, fraction)[:2], strict=True):
        np.testing.assert_allclose(value, wanted, atol=1e-9)
    expected = [(a - b) / (2 * step) for a, b in zip(up, down, strict=True)]
    for found, wanted in zip(forward, expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-7)
    by_forward = sum(np.sum(c * f) for c, f in zip(cotangents, forward, strict=True))
    by_reverse = np.sum(reverse[0] * d_flow) + reverse[1] * d_fraction
    np.testing.assert_allclose(by_reverse, by_forward, rtol=1e-10)


def test_the_gradient_does_not_depend_on_how_the_answer_was_found(x64):
    flow, fraction = np.float64(smooth_flow(5, 6)), np.float64(0.7)
    start = np.random.default_rng(1).uniform(0, 5, (5, 6, 2))

    def total(flow, start, iterations):
        return jnp.sum(jnp.sin(jx.iterative_search(flow, fraction, start=start, iterations=iterations).position))

    gradient = jax.jit(jax.grad(total, argnums=(0, 1)), static_argnums=2)
    one, from_start = gradient(flow, start, 100)
    np.testing.assert_allclose(gradient(flow, start, 200)[0], one, atol=1e-9)
    np.testing.assert_array_equal(from_start, 0)


@pytest.mark.slow
def test_second_derivatives(x64):
    """Of one smooth cell, against differences of the gradient."""
    flow = affine_flow(5, 6, [[0.2, 0.1], [-0.1, 0.15]], [0.31, 0.17])

    def total(fraction):
        return jnp.sum(jnp.sin(jx.iterative_search(flow, fraction, iterations=60).position))

    step = 1e-5
    first = jax.jit(jax.grad(total))
    expected = (first(0.5 + step) - first(0.5 - step)) / (2 * step)
    np.testing.assert_allclose(jax.jit(jax.grad(first))(0.5), expected, rtol=1e-6)


def test_the_bound_near_singular_points(x64):
    """No tangent of the right-hand side is stretched more than ten times."""
    rng = np.random.default_rng(2)
    fraction = 0.5

    @jax.jit
    def along(flow, d_flow):
        return jax.jvp(lambda f: jx.iterative_search(f, fraction).position, (flow,), (d_flow,))[1]

    for slope in (-2.0, -1.9, -1.0, 40.0):
        flow = affine_flow(6, 8, [[slope, 0], [0.5, slope]], [0.3, 0.2])
        for _ in range(3):
            moved = along(flow, rng.uniform(-1, 1, flow.shape))
            assert np.linalg.norm(moved, axis=-1).max() <= 10 * fraction * np.sqrt(2) + 1e-9


def test_gradients_beside_flow_that_is_not_finite(x64):
    flow = np.float64(smooth_flow(5, 6))
    flow[1, 2], flow[3, 3, 0], flow[4, 0, 2] = np.nan, np.inf, np.nan

    def total(flow, fraction):
        found = jx.iterative_search(flow, fraction)
        error = jnp.where(jnp.isfinite(found.error), found.error, 0)
        return jnp.sum(found.position) + jnp.sum(found.depth_offset) + jnp.sum(error)

    gradients = jax.jit(jax.grad(total, argnums=(0, 1)))(flow, 0.5)
    assert all(np.isfinite(g).all() for g in gradients)
    np.testing.assert_array_equal(gradients[0][1, 2], 0)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_iterations():
    flow = jnp.asarray(smooth_flow(64, 64))

    def temporary(iterations):
        def total(flow):
            return jnp.sum(jx.iterative_search(flow, 0.5, iterations=iterations).position)

        return jax.jit(jax.grad(total)).lower(flow).compile().memory_analysis().temp_size_in_bytes

    assert temporary(50) == temporary(3)


# Starts


def test_dual_start():
    flow = random(5, 7, 3, low=-2, high=2)
    flow[2, 3, 0] = np.nan
    found = np.asarray(jx.dual_start(jnp.asarray(flow), 0.25))
    y, x = np.mgrid[:5, :7]
    expected = np.stack([x, y], -1) + 0.25 * flow[..., :2]
    expected[2, 3] = (3, 2)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_dual_start_finds_an_object_past_its_silhouette():
    """A bar moves 6 pixels; half way, pixels that it covers then show the background before: only the dual start hits.

    The background stands still, so that the default search stays where it is, at a wrong point with error 0; the dual
    one finds the bar's own.
    """
    height, width, speed = 4, 24, 6.0
    forward, backward = np.zeros((height, width, 3), np.float32), np.zeros((height, width, 3), np.float32)
    forward[:, 4:12, 0], backward[:, 10:18, 0] = speed, -speed
    # at 0.5 the bar covers 7..14; pixel 13 is background at t, and bar at t + 1
    start = jx.dual_start(jnp.asarray(backward), 0.5)
    found = run(forward, 0.5, start=start)
    default = run(forward, 0.5)
    np.testing.assert_allclose(found[0][1, 13], (10, 1), atol=1e-6)
    np.testing.assert_allclose(found[2][1, 13], 0, atol=1e-6)
    np.testing.assert_allclose(default[0][1, 13], (13, 1), atol=1e-6)


def latest_loop(offset, depth, ratio, reach):
    """The offset of the smallest depth in the square; first along the row, then along the column, own pixel first."""
    height, width, _ = offset.shape
    out, depth = np.zeros(offset.shape), oracles.far(depth)
    order = [0, *(k for k in range(-reach, reach + 1) if k != 0)]
    for r, c in np.ndindex(height, width):
        best, chosen = np.inf, offset[r, c]
        for j in order:
            for i in order:
                if 0 <= r + j < height and 0 <= c + i < width and depth[r + j, c + i, 0] < best:
                    best, chosen = depth[r + j, c + i, 0], offset[r + j, c + i]
        out[r, c] = np.array([c, r]) - ratio * chosen
    return out


QUICK = [((1, 6), 0), ((1, 1), 1), ((5, 7), 2)]  # each reach, and the sizes where it ends at once


@pytest.mark.slow
@pytest.mark.parametrize(
    "size, reach",
    [
        (size, reach) if (size, reach) in QUICK else pytest.param(size, reach, marks=pytest.mark.slow)
        for size in SIZES
        for reach in (0, 1, 2)
    ],
    ids=str,
)
def test_latest_start_against_the_loop(size, reach):
    offset, depth = random(*size, 2, low=-2, high=2), np.round(random(*size, 1, seed=4) * 4).astype(np.float32)
    depth.flat[0] = np.nan
    depth.flat[-1] = np.inf
    depth = depth if size != (1, 1) else np.ones((1, 1, 1), np.float32)
    found = jx.latest_start(jnp.asarray(offset), 2.0, depth=jnp.asarray(depth), reach=reach)
    np.testing.assert_allclose(found, latest_loop(offset, depth, 2.0, reach), rtol=1e-5, atol=1e-6)


def test_latest_start_without_depth():
    offset = random(4, 5, 2)
    offset[1, 1] = np.nan
    found = np.asarray(jx.latest_start(jnp.asarray(offset), 0.5))
    y, x = np.mgrid[:4, :5]
    expected = np.stack([x, y], -1) - 0.5 * np.nan_to_num(offset, nan=0.0)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"flow": jnp.ones((4, 5))}, ValueError, r"flow: expected shape \[H, W, C\], got \[4, 5\]"),
        ({"flow": jnp.ones((4, 5, 4))}, ValueError, r"flow: expected shape \[H, W, 3\] or \[H, W, 2\]"),
        ({"flow": jnp.ones((4, 5, 3), int)}, TypeError, "flow: .* got dtype int32"),
        ({"start": jnp.ones((4, 4, 2))}, ValueError, r"start: expected shape \[4, 5, 2\], got \[4, 4, 2\]"),
        ({"solver": "secant"}, ValueError, "solver: expected one of 'fixed_point', 'newton', got 'secant'"),
        ({"filter": "bicubic"}, ValueError, "filter: expected one of 'bilinear', 'nearest', got 'bicubic'"),
        ({"iterations": -1}, ValueError, "iterations: expected an integer of at least 0, got -1"),
        ({"iterations": 2.5}, ValueError, "iterations: .* got 2.5"),
        ({"fraction": jnp.ones(3)}, ValueError, r"fraction: expected shape \[\], got \[3\]"),
    ],
)
def test_errors(unchecked, change, error, message):
    arguments = {"flow": jnp.ones((4, 5, 3)), "fraction": 0.5} | change
    with pytest.raises(error, match=message):
        jx.iterative_search(arguments.pop("flow"), arguments.pop("fraction"), **arguments)


def test_errors_of_starts(unchecked):
    offset = jnp.ones((4, 5, 2))
    with pytest.raises(ValueError, match=r"flow: expected shape \[H, W, 3\]"):
        jx.dual_start(jnp.ones((4, 5, 1)), 0.5)
    with pytest.raises(ValueError, match=r"offset: expected shape \[H, W, 2\]"):
        jx.latest_start(jnp.ones((4, 5, 3)), 0.5)
    with pytest.raises(ValueError, match=r"depth: expected shape \[4, 5, 1\]"):
        jx.latest_start(offset, 0.5, depth=jnp.ones((4, 4, 1)))
    with pytest.raises(ValueError, match=r"reach: .* got -1"):
        jx.latest_start(offset, 0.5, reach=-1)
