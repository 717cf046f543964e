"""Losses: against float64 loops from the paper, the released network's values, and at every degenerate case."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_gradients, random

from jaxtrapolate.training.losses import (
    charbonnier_loss,
    extranet_loss,
    hole_loss,
    l1_loss,
    relative_loss,
    shading_loss,
)


def images(height, width, seed=0):
    mask = (random(height, width, 1, seed=seed + 2) > 0.4).astype(np.float32)
    return random(height, width, 3, seed=seed, high=2.0), random(height, width, 3, seed=seed + 1, high=2.0), mask


def shading(prediction, target, shade, fraction):
    """One channel (or all of a pixel) after the other, sorted, the largest averaged."""
    error = np.abs(np.float64(prediction) - np.float64(target)).reshape(-1, prediction.shape[-1])
    columns = [error.mean(1)] if shade == "paper" else list(error.T)
    count = max(int(fraction * len(error)), 1)
    return np.mean([sum(sorted(column, reverse=True)[:count]) / count for column in columns])


def reference(prediction, target, mask, *, hole_weight=1.0, shade_weight=1.0, shade="release", fraction=0.1):
    prediction, target, mask = (np.asarray(a, np.float64) for a in (prediction, target, mask))
    total, hole, holes = 0.0, 0.0, 0.0
    for r, c, k in np.ndindex(prediction.shape):
        error = abs(prediction[r, c, k] - target[r, c, k])
        total += error
        hole += error * (1 - mask[r, c, 0])
        holes += 1 - mask[r, c, 0]
    parts = {
        "l1": total / prediction.size,
        "hole": hole / holes if holes else 0.0,
        "shade": shading(prediction, target, shade, fraction),
    }
    return parts["l1"] + hole_weight * parts["hole"] + shade_weight * parts["shade"], parts


@pytest.mark.parametrize("size", [(13, 10), (1, 6), (1, 1)])
@pytest.mark.parametrize("shade", ["release", "paper"])
def test_against_a_loop(size, shade):
    prediction, target, mask = images(*size)
    options = {"hole_weight": 0.7, "shade_weight": 1.3, "shade": shade, "fraction": 0.25}
    total, parts = extranet_loss(*map(jnp.asarray, (prediction, target, mask)), **options)
    expected, expected_parts = reference(prediction, target, mask, **options)
    np.testing.assert_allclose(total, expected, rtol=1e-5)
    for name, value in expected_parts.items():
        np.testing.assert_allclose(parts[name], value, rtol=1e-5, err_msg=name)


def test_charbonnier_against_the_formula():
    prediction, target, _ = images(5, 7)
    difference = np.float64(prediction) - np.float64(target)
    for epsilon in (1e-3, 0.5):
        found = charbonnier_loss(jnp.asarray(prediction), jnp.asarray(target), epsilon=epsilon)
        np.testing.assert_allclose(found, np.mean(np.sqrt(difference**2 + epsilon**2)), rtol=1e-6)


@pytest.mark.parametrize("number", [0, 1])
def test_released_values(data, number):
    """The losses of the authors' code, and their sum."""
    vectors = np.load(data / "extranet_vectors.npz")
    arrays = [jnp.asarray(vectors[f"{number}_{name}"]) for name in ("output", "target", "mask")]
    total, parts = extranet_loss(*arrays)
    np.testing.assert_allclose(total, vectors[f"{number}_loss"], atol=1e-5)
    for name, value in parts.items():
        np.testing.assert_allclose(value, vectors[f"{number}_loss_{name}"], atol=1e-5, err_msg=name)


@pytest.mark.parametrize("shade", ["release", "paper"])
def test_gradients(x64, shade):
    """Against differences of the loop; random errors have neither ties nor zeros."""
    prediction, target, mask = (np.asarray(a, np.float64) for a in images(5, 7))
    mask = 0.1 + 0.8 * mask

    def loop(prediction, target, mask):
        return reference(prediction, target, mask, shade=shade, fraction=0.2)[0]

    def loss(*arrays):
        return extranet_loss(*arrays, shade=shade, fraction=0.2)[0]

    arrays = prediction, target, mask
    gradients = jax.jit(jax.grad(loss, (0, 1, 2)))(*map(jnp.asarray, arrays))
    assert_gradients(loop, arrays, gradients)


def test_gradients_of_charbonnier(x64):
    arrays = [np.asarray(a, np.float64) for a in images(5, 7)]
    smooth = jax.jit(jax.grad(charbonnier_loss, (0, 1)))(*map(jnp.asarray, arrays[:2]))
    assert_gradients(lambda p, t: np.mean(np.sqrt((p - t) ** 2 + 1e-6)), arrays[:2], smooth, rtol=1e-4)


DEGENERATE = {
    "equal": (lambda p, t, m: (t, t, m)),
    "equal and no holes": (lambda p, t, m: (t, t, np.ones_like(m))),
    "no holes": (lambda p, t, m: (p, t, np.ones_like(m))),
    "all holes": (lambda p, t, m: (p, t, np.zeros_like(m))),
    "all alike": (lambda p, t, m: (t + 1, t, m)),
    "a target without finite values": (lambda p, t, m: (p, np.full_like(t, np.nan), m)),
    "a target with some": (lambda p, t, m: (p, np.where(p > 1, np.inf, t), m)),
    "an infinite prediction where the target is not finite": (
        lambda p, t, m: (np.where(p > 1, np.nan, p), np.where(p > 1, np.inf, t), m)
    ),
}


@partial(jax.jit, static_argnames="shade")
def differentiated(arrays, shade):
    both = jax.value_and_grad(lambda *a: extranet_loss(*a, shade=shade), argnums=(0, 1, 2), has_aux=True)
    return both(*arrays), jax.value_and_grad(charbonnier_loss, argnums=(0, 1))(*arrays[:2])


@pytest.mark.parametrize("name", sorted(DEGENERATE))
@pytest.mark.parametrize("shade", ["release", "paper"])
def test_finite_everywhere(name, shade):
    arrays = [jnp.asarray(np.float32(a)) for a in DEGENERATE[name](*images(5, 7))]
    ((total, parts), gradients), (smooth, slopes) = differentiated(arrays, shade)
    assert all(np.isfinite(value) for value in (total, smooth, *parts.values()))
    assert all(np.isfinite(g).all() for g in (*gradients, *slopes))
    if name.startswith("equal"):
        assert total == 0
        assert not any(np.any(g) for g in (*gradients, *slopes))
    if "no holes" in name:
        assert parts["hole"] == 0


def test_what_is_not_finite_in_the_target_counts_nowhere():
    """The same as of a frame without those values."""
    prediction, target, mask = images(8, 5)
    left = target.copy()
    left[6:] = np.nan
    for shade in ("release", "paper"):
        found, _ = extranet_loss(*map(jnp.asarray, (prediction, left, mask)), shade=shade)
        expected, _ = reference(prediction[:6], target[:6], mask[:6], shade=shade)
        np.testing.assert_allclose(found, expected, rtol=1e-5)
    found = charbonnier_loss(jnp.asarray(prediction), jnp.asarray(left))
    difference = np.float64(prediction - target)[:6]
    np.testing.assert_allclose(found, np.mean(np.sqrt(difference**2 + 1e-6)), rtol=1e-5)


def test_a_prediction_that_is_not_finite_is_seen():
    prediction, target, mask = images(8, 5)
    mask[0, 0] = 1
    for value in (np.nan, np.inf):
        broken = jnp.asarray(prediction).at[0, 0, 1].set(value)
        for shade in ("release", "paper"):
            total, parts = extranet_loss(broken, jnp.asarray(target), jnp.asarray(mask), shade=shade)
            assert not np.isfinite(total)
            assert not np.isfinite(parts["l1"])
            assert not np.isfinite(parts["shade"])
            assert np.isfinite(parts["hole"])  # it is not in a hole
        assert not np.isfinite(charbonnier_loss(broken, jnp.asarray(target)))


def test_ties_share_the_weight_of_the_smallest_that_is_kept():
    """Of four errors 2, 1, 1, 0 two are kept: the 2, and one half of each 1."""
    target = jnp.zeros((2, 2, 1))
    prediction = jnp.asarray([[[2.0], [1.0]], [[-1.0], [0.0]]])
    value, gradient = jax.value_and_grad(shading_loss)(prediction, target, fraction=0.5)
    assert value == 1.5
    np.testing.assert_array_equal(gradient[..., 0], [[0.5, 0.25], [-0.25, 0.0]])


def test_extreme_values():
    """Half precision is summed in float32; squares that would overflow do not."""
    target = jnp.zeros((300, 40, 3), jnp.float16)
    prediction = jnp.full_like(target, 6e4)
    total, _ = extranet_loss(prediction, target, jnp.zeros((300, 40, 1), jnp.float16))
    assert total.dtype == jnp.float32
    np.testing.assert_allclose(total, 3 * np.float64(np.float16(6e4)), rtol=1e-6)
    large = jnp.full((2, 3, 1), 1e30)
    value, gradient = jax.value_and_grad(charbonnier_loss)(large, jnp.zeros_like(large))
    np.testing.assert_allclose(value, 1e30, rtol=1e-6)
    np.testing.assert_allclose(gradient, 1 / 6, rtol=1e-6)


def test_mapped_is_one_after_the_other():
    pairs = [images(5, 7, seed) for seed in (0, 10)]
    batch = [jnp.stack([jnp.asarray(pair[k]) for pair in pairs]) for k in range(3)]
    totals, parts = jax.jit(jax.vmap(extranet_loss))(*batch)
    for k, pair in enumerate(pairs):
        total, each = extranet_loss(*map(jnp.asarray, pair))
        np.testing.assert_allclose(totals[k], total, rtol=1e-6)
        for name, value in each.items():
            np.testing.assert_allclose(parts[name][k], value, rtol=1e-6)


def test_no_implicit_promotion(strict):
    arrays = [jnp.asarray(a) for a in images(5, 7)]
    for shade in ("release", "paper"):
        jax.eval_shape(jax.grad(lambda *a, shade=shade: extranet_loss(*a, shade=shade)[0]), *arrays)
    jax.eval_shape(jax.grad(charbonnier_loss), *arrays[:2])


def test_another_weight_or_fraction_traces_nothing():
    import jax._src.test_util as jtu

    arrays = [jnp.asarray(a) for a in images(5, 7)]
    extranet_loss(*arrays, hole_weight=0.5, shade_weight=0.5, fraction=0.3)
    with jtu.count_jit_and_pmap_lowerings() as count:
        for value in (0.25, 0.75):
            extranet_loss(*arrays, hole_weight=value, shade_weight=value, fraction=value)
    assert count() == 0


def test_errors(unchecked):
    image = jnp.zeros((4, 5, 3))
    with pytest.raises(ValueError, match="shade: expected one of 'release', 'paper', got 'all'"):
        shading_loss(image, image, shade="all")
    with pytest.raises(ValueError, match=r"target: expected shape \[4, 5, 3\], got \[4, 6, 3\]"):
        l1_loss(image, jnp.zeros((4, 6, 3)))
    with pytest.raises(ValueError, match=r"mask: expected shape \[4, 5, 1\], got \[4, 5, 3\]"):
        hole_loss(image, image, image)
    with pytest.raises(TypeError, match="prediction: expected a floating-point array"):
        charbonnier_loss(image.astype(int), image)


def test_relative_loss():
    """What is left of the guess's squared error, where the target is finite; no gradient to the guess."""
    generator = np.random.default_rng(3)
    prediction, target, guess = generator.normal(size=(3, 7, 5, 3)).astype(np.float32)
    target[2, 3] = np.nan
    known = np.isfinite(target)
    left, before = (np.mean((np.float64(a) - target)[known] ** 2) for a in (prediction, guess))
    given = tuple(map(jnp.asarray, (prediction, target, guess)))
    np.testing.assert_allclose(relative_loss(*given, epsilon=0.1), left / (before + 0.1), rtol=1e-5)
    np.testing.assert_allclose(relative_loss(given[2], given[1], given[2], epsilon=0.0), 1, rtol=1e-6)
    ours, theirs = jax.grad(relative_loss, argnums=(0, 2))(*given)
    assert np.isfinite(ours).all()
    assert not np.any(np.asarray(ours)[2, 3])
    assert not np.any(theirs)
    exact = jnp.nan_to_num(given[1])
    assert float(relative_loss(exact, given[1], exact)) == 0
    assert float(relative_loss(exact, jnp.full_like(exact, jnp.nan), exact)) == 0
