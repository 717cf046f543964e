"""Where frames show points of the world: against their cameras."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow

import jaxtrapolate as jx
from jaxtrapolate.ops.projection import fitted_projection, project
from jaxtrapolate.scenes import TRAINING_SEEDS, SceneSequence

SIZE = (45, 70)


@pytest.fixture(autouse=True)
def plain(unchecked):
    """NumPy arrays are taken, and the library's own errors seen."""


def grid(size):
    y, x = np.mgrid[: size[0], : size[1]]
    return np.stack([x, y], -1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["interior", *slow("forest")])
def test_fitted_to_a_scene(name):
    """To a hundredth of a pixel where its own camera shows the points, at another time too."""
    sequence = SceneSequence(name, TRAINING_SEEDS[3], frames=9, size=SIZE)
    before, after = sequence.frame(1), sequence.frame(8)
    known = np.asarray(before.gbuffer.sky < 0.5)[..., 0]
    matrix, misses = fitted_projection(before.gbuffer.position, known)
    assert misses < 0.01
    at = np.asarray(project(matrix, before.gbuffer.position))
    assert np.abs(at - grid(SIZE))[known].max() < 0.02
    static = np.asarray((after.gbuffer.sky < 0.5) & (after.gbuffer.stencil < 0.5))[..., 0]
    exact = np.asarray(jx.camera_motion(after.gbuffer.position, after.camera, before.camera)) + grid(SIZE)
    found = np.asarray(project(matrix, after.gbuffer.position))
    both = static & np.isfinite(exact).all(-1) & (np.abs(exact) < 500).all(-1)
    assert both.sum() > 100
    assert np.abs(found - exact)[both].max() < 0.1


def camera_matrix(rng):
    """A camera before a cloud of points, as `[3, 4]`."""
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn = turn * np.sign(np.linalg.det(turn))
    inner = np.array([[60.0, 0, SIZE[1] / 2], [0, 60.0, SIZE[0] / 2], [0, 0, 1]])
    return inner @ np.concatenate([turn, [[0.1], [0.2], [9.0]]], 1)


def test_fitted_to_float64_points():
    """Points cast along each pixel's ray of a known camera, at random depths, far from the origin."""
    rng = np.random.default_rng(1)
    matrix = camera_matrix(rng)
    away = np.array([300.0, -200.0, 100.0])
    rays = np.linalg.solve(matrix[:, :3], np.concatenate([grid(SIZE), np.ones((*SIZE, 1))], -1)[..., None])[..., 0]
    origin = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    points = origin + away + rays * rng.uniform(5, 40, (*SIZE, 1))
    known = rng.uniform(size=SIZE) < 0.7
    points[~known] = np.nan
    fitted, misses = fitted_projection(jnp.asarray(points, jnp.float32), known)
    assert misses < 0.02
    at = np.asarray(project(fitted, jnp.asarray(points, jnp.float32)))
    assert np.isnan(at[~known]).all()
    assert np.abs(at - grid(SIZE))[known].max() < 0.1


def test_what_no_camera_shows():
    """Too few points, none, and positions at random: said by the distance that is missed."""
    rng = np.random.default_rng(2)
    points = jnp.asarray(rng.uniform(-1, 1, (*SIZE, 3)), jnp.float32)
    few = np.zeros(SIZE, bool)
    few[0, :10] = True
    for known in (few, np.zeros(SIZE, bool)):
        matrix, misses = fitted_projection(points, known)
        assert misses == np.inf
        assert not np.asarray(matrix).any()
        assert np.isnan(np.asarray(project(matrix, points))).all()
    assert fitted_projection(points, np.ones(SIZE, bool))[1] > 5


def test_behind_the_camera():
    matrix = jnp.asarray(camera_matrix(np.random.default_rng(3)), jnp.float32)
    center = -np.linalg.solve(np.float64(matrix[:, :3]), np.float64(matrix[:, 3]))
    ahead = np.float64(matrix[2, :3])
    points = jnp.asarray(np.stack([center + ahead, center - ahead])[None], jnp.float32)
    at = np.asarray(project(matrix, points))
    assert np.isfinite(at[0, 0]).all()
    assert np.isnan(at[0, 1]).all()


def test_gradient_is_that_of_the_point_alone():
    matrix = jnp.asarray(camera_matrix(np.random.default_rng(4)), jnp.float32)
    points = jnp.asarray(np.random.default_rng(5).uniform(-2, 2, (3, 4, 3)), jnp.float32)
    given = jax.grad(lambda p: jnp.sum(project(matrix, p)))(points)
    step = 1e-2 * np.eye(3)[0]
    numeric = (project(matrix, points + step) - project(matrix, points - step)).sum(-1) / 2e-2
    np.testing.assert_allclose(np.asarray(given)[..., 0], np.asarray(numeric), rtol=2e-2, atol=1e-2)
    fitted = jax.grad(lambda p: jnp.sum(fitted_projection(p, jnp.ones(SIZE, bool))[0]))
    assert not np.asarray(fitted(jnp.asarray(np.random.default_rng(6).uniform(size=(*SIZE, 3)), jnp.float32))).any()


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (9, 1)])
def test_sizes(size):
    points = jnp.ones((*size, 3))
    matrix, misses = fitted_projection(points, np.ones(size, bool))
    assert np.isfinite(np.asarray(matrix)).all()
    assert misses == np.inf


def test_errors():
    with pytest.raises(ValueError, match="position"):
        fitted_projection(jnp.ones((4, 5, 2)), jnp.ones((4, 5), bool))
    with pytest.raises(ValueError, match="known"):
        fitted_projection(jnp.ones((4, 5, 3)), jnp.ones((4, 6), bool))
    with pytest.raises(ValueError, match="matrix"):
        project(jnp.ones((4, 4)), jnp.ones((4, 5, 3)))
