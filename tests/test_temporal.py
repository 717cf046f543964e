"""Accumulation over time: against a loop from the papers, and what TAA is for: edges that converge, ghosts that go."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow_rows
from oracles import assert_gradients, random

from jaxtrapolate.ops.temporal import accumulate, rgb_to_ycocg, ycocg_to_rgb

MATRIX = np.array([[0.25, 0.5, 0.25], [0.5, 0, -0.5], [-0.25, 0.5, -0.25]])


def loop(current, history, valid, *, scale=1, jitter=(0.0, 0.0), rectify="variance", gamma=1.0, weight=0.1):
    """One output pixel after the other."""
    current, history = np.float64(current), np.float64(history)
    height, width, _ = current.shape
    result = np.zeros((scale * height, scale * width, 3))
    for r, c in np.ndindex(result.shape[:2]):
        x, y = (c + 0.5) / scale - 0.5 - jitter[0], (r + 0.5) / scale - 0.5 - jitter[1]
        colors, weights = [], []
        for j in (-1, 0, 1):
            for i in (-1, 0, 1):
                a, b = np.round(y) + j, np.round(x) + i
                weights.append(np.exp(-2.29 * scale**2 * ((b - x) ** 2 + (a - y) ** 2)))
                colors.append(current[int(np.clip(a, 0, height - 1)), int(np.clip(b, 0, width - 1))])
        own = np.average(colors, 0, weights)
        if not valid[r, c, 0]:
            result[r, c] = own
            continue
        before, around = MATRIX @ history[r, c], np.array(colors) @ MATRIX.T
        if rectify == "clamp":
            before = np.clip(before, around.min(0), around.max(0))
        elif rectify == "variance":
            mean, reach = around.mean(0), gamma * around.std(0)
            beyond = np.max(np.abs(before - mean) / reach)
            before = mean + (before - mean) / max(beyond, 1)
        before = np.linalg.inv(MATRIX) @ before
        share = weight * max(weights)
        result[r, c] = (1 - share) * before + share * own
    return result


def images(height, width, scale):
    larger = (scale * height, scale * width)
    valid = random(*larger, 1, seed=3) > 0.2
    return random(height, width, 3), random(*larger, 3, seed=1, high=1.5), valid


@pytest.mark.parametrize(
    "size, scale, rectify",
    [((4, 5), 1, "variance"), ((3, 4), 2, "clamp"), *slow_rows(((4, 3), 2, "variance"), ((3, 5), 3, "none"))],
)
def test_against_a_loop(size, scale, rectify):
    given, jitter = images(*size, scale), np.float32([0.3, -0.45])
    options = {"scale": scale, "rectify": rectify, "gamma": 1.25, "weight": 0.3}
    found = accumulate(*map(jnp.asarray, given), jitter=jnp.asarray(jitter), **options)
    np.testing.assert_allclose(found, loop(*given, jitter=jitter, **options), atol=2e-5)


def test_colours_there_and_back():
    image = random(4, 5, 3)
    np.testing.assert_allclose(rgb_to_ycocg(jnp.asarray(image)), image @ MATRIX.T.astype(np.float32), atol=1e-6)
    np.testing.assert_allclose(ycocg_to_rgb(rgb_to_ycocg(jnp.asarray(image))), image, atol=1e-6)


@pytest.mark.slow
def test_gradients(x64):
    current, history, valid = images(3, 4, 1)
    arrays = [np.asarray(a, np.float64) for a in (current, history)]
    share = random(3, 4, 3, seed=8).astype(np.float64)
    gradients = jax.grad(lambda *a: jnp.sum(accumulate(*a, jnp.asarray(valid)) * share), (0, 1))(
        *map(jnp.asarray, arrays)
    )
    assert_gradients(lambda *a: np.sum(loop(*a, valid) * share), arrays, gradients, rtol=1e-4)


@pytest.mark.slow
def test_flat_neighbourhoods_are_their_colour():
    """A ghost over a flat wall is gone at once, with finite gradients, and the smallest frames are what they are."""
    for size in ((4, 5), (1, 1)):
        flat = jnp.full((*size, 3), 0.25)
        for rectify in ("variance", "clamp"):

            def answer(history, flat=flat, rectify=rectify):
                return accumulate(flat, history, jnp.ones((*flat.shape[:2], 1), bool), rectify=rectify)

            ghost = jnp.asarray(random(*size, 3, seed=4))
            np.testing.assert_allclose(answer(ghost), flat, atol=1e-6)
            assert np.isfinite(jax.grad(lambda h, f=answer: jnp.sum(f(h)))(ghost)).all()


def disc(height, width, scale, jitter):
    """Samples at p + jitter of a disc that stands still, on `scale` times fewer pixels."""
    x, y = np.meshgrid((np.arange(width) + jitter[0] + 0.5) * scale, (np.arange(height) + jitter[1] + 0.5) * scale)
    inside = np.hypot(x - width * scale * 0.52, y - height * scale * 0.47) < 0.3 * scale * min(width, height)
    return np.repeat(inside[..., None], 3, -1).astype(np.float32)


@pytest.mark.parametrize("scale", [1, 2])
def test_a_still_disc_converges_to_its_coverage(scale):
    """Over jittered frames the answer comes near the supersampled disc; from one frame it is a staircase."""
    size = (12, 14)
    rng = np.random.default_rng(0)
    fine = 16
    truth = disc(size[0] * scale * fine, size[1] * scale * fine, 1 / fine, (0, 0))
    truth = truth.reshape(size[0] * scale, fine, size[1] * scale, fine, 3).mean((1, 3))
    history, valid = jnp.zeros(truth.shape), jnp.zeros((*truth.shape[:2], 1), bool)
    errors = []
    for _ in range(60):
        jitter = rng.uniform(-0.5, 0.5, 2).astype(np.float32)
        current = jnp.asarray(disc(*size, scale, jitter))
        how = {"scale": scale, "jitter": jnp.asarray(jitter), "rectify": "clamp"}
        history = accumulate(current, history, valid, **how)
        valid = jnp.ones_like(valid)
        errors.append(np.square(history - truth).mean())
    assert np.mean(errors[-10:]) < 0.25 * errors[0]


def test_no_implicit_promotion(strict):
    current, history, valid = (jnp.asarray(a) for a in images(3, 4, 2))
    for rectify in ("variance", "clamp"):
        jax.eval_shape(
            lambda a, b, r=rectify: accumulate(a, b, valid, scale=2, jitter=jnp.zeros(2), rectify=r), current, history
        )


def test_errors(unchecked):
    image, valid = jnp.zeros((4, 5, 3)), jnp.ones((4, 5, 1), bool)
    with pytest.raises(ValueError, match="rectify: expected one of 'variance', 'clamp', 'none', got 'box'"):
        accumulate(image, image, valid, rectify="box")
    with pytest.raises(ValueError, match=r"history: expected shape \[8, 10, 3\], got \[4, 5, 3\]"):
        accumulate(image, image, valid, scale=2)
    with pytest.raises(ValueError, match=r"valid: expected shape \[4, 5, 1\], got \[4, 5, 3\]"):
        accumulate(image, image, image > 0)
    with pytest.raises(ValueError, match="scale: expected a whole number from 1 on, got 0"):
        accumulate(image, image, valid, scale=0)
