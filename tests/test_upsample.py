"""Upsampling from one frame: against OpenCV, the oracles' filters, and EASU written out from its published shader."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from marks import slow_rows
from oracles import random

from jaxtrapolate.ops.upsample import easu, upsample

SIZES = [(5, 7), (1, 6), (6, 1), (1, 1)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("scale", [2, 1.5, 3])
def test_bilinear_is_opencvs(size, scale):
    """Of sizes that the scale divides exactly: others OpenCV places by the scale, we by the sizes."""
    image = random(*size, 3)
    expected = cv2.resize(image, None, fx=round(size[1] * scale) / size[1], fy=round(size[0] * scale) / size[0])
    np.testing.assert_allclose(upsample(jnp.asarray(image), scale=scale), expected.reshape(-1, *expected.shape[1:]),
                               atol=1e-5)  # fmt: skip


@pytest.mark.parametrize("filter", ["nearest", "bilinear", "bicubic"])
def test_places_with_jitter_by_the_oracle(filter):
    image, jitter = random(5, 6, 3), np.float32([0.3, -0.2])
    found = upsample(jnp.asarray(image), filter=filter, jitter=jnp.asarray(jitter))
    for r, c in np.ndindex(10, 12):
        expected = oracles.sample(image, (c + 0.5) / 2 - 0.5 - jitter[0], (r + 0.5) / 2 - 0.5 - jitter[1], filter)
        np.testing.assert_allclose(found[r, c], expected, atol=1e-5)


def test_a_jittered_ramp_lies_where_it_was():
    """A frame whose samples are shifted shows, upsampled, the unshifted screen: of a ramp exactly."""
    jitter = np.float32([0.25, -0.4])
    x, y = np.meshgrid(np.arange(9) + jitter[0], np.arange(7) + jitter[1])
    image = np.stack([x, y, x + y], -1).astype(np.float32)
    x, y = np.meshgrid((np.arange(18) + 0.5) / 2 - 0.5, (np.arange(14) + 0.5) / 2 - 0.5)
    for filter in ("bilinear", "bicubic"):
        found = upsample(jnp.asarray(image), filter=filter, jitter=jnp.asarray(jitter))
        inner = np.s_[3:-3, 3:-3]
        np.testing.assert_allclose(found[inner], np.stack([x, y, x + y], -1)[inner], atol=1e-5)


def published(image, scale):
    """FsrEasuF of FidelityFX Super Resolution 1.0, one pixel after the other."""
    image = np.float64(image)
    height, width, _ = image.shape
    result = np.zeros((round(height * scale), round(width * scale), 3))
    ratio = np.array([width / result.shape[1], height / result.shape[0]])
    for row, column in np.ndindex(result.shape[:2]):
        pp = np.array([column, row]) * ratio + 0.5 * ratio - 0.5
        fp = np.floor(pp).astype(int)
        pp = pp - fp

        def at(i, j, fp=fp):
            return image[np.clip(fp[1] + j, 0, height - 1), np.clip(fp[0] + i, 0, width - 1)]

        places = {"b": (0, -1), "c": (1, -1), "i": (-1, 1), "j": (0, 1), "f": (0, 0), "e": (-1, 0), "k": (1, 1)}
        places |= {"l": (2, 1), "h": (2, 0), "g": (1, 0), "o": (1, 2), "n": (0, 2)}
        luma = {name: 0.5 * at(*p)[0] + at(*p)[1] + 0.5 * at(*p)[2] for name, p in places.items()}
        direction, length = np.zeros(2), 0.0
        shares = [(1 - pp[0]) * (1 - pp[1]), pp[0] * (1 - pp[1]), (1 - pp[0]) * pp[1], pp[0] * pp[1]]
        for share, (a, b, c, d, e) in zip(shares, ["befgj", "cfghk", "fijkn", "gjklo"], strict=True):
            for k, (low, high) in enumerate(((b, d), (a, e))):
                most = max(abs(luma[high] - luma[c]), abs(luma[c] - luma[low]))
                difference = luma[high] - luma[low]
                direction[k] += difference * share
                length += share * min(abs(difference) / most, 1) ** 2 if most else 0
        square = direction @ direction
        if square < 1 / 32768:
            direction[0] = 1
        else:
            direction /= np.sqrt(square)
        length = (length / 2) ** 2
        stretch = direction @ direction / max(abs(direction))
        extent = np.array([1 + (stretch - 1) * length, 1 - 0.5 * length])
        lobe = 0.5 + (0.25 - 0.04 - 0.5) * length
        total, weights = np.zeros(3), 0.0
        for p in places.values():
            off = np.array(p) - pp
            v = np.array([off @ direction, off @ [-direction[1], direction[0]]]) * extent
            d2 = min(v @ v, 1 / lobe)
            weight = (25 / 16 * (0.4 * d2 - 1) ** 2 - 9 / 16) * (lobe * d2 - 1) ** 2
            total, weights = total + at(*p) * weight, weights + weight
        four = [at(*places[name]) for name in "fgjk"]
        result[row, column] = np.clip(total / weights, np.min(four, 0), np.max(four, 0))
    return result


@pytest.mark.parametrize("size, scale", [((6, 7), 2), ((1, 5), 2), ((1, 1), 2), *slow_rows(((5, 9), 1.5), ((9, 5), 1))])
def test_easu_is_the_published_shader(size, scale):
    image = random(*size, 3)
    image[:, size[1] // 2 :] *= 0.3  # an edge
    np.testing.assert_allclose(easu(jnp.asarray(image), scale=scale), published(image, scale), atol=2e-5)


@pytest.mark.slow
def test_easu_of_what_is_flat_and_of_an_edge():
    """Flat stays flat; a slanted edge is less of a staircase than bilinear makes it, and nothing rings."""
    flat = jnp.full((4, 5, 3), 0.37)
    np.testing.assert_allclose(easu(flat), jnp.full((8, 10, 3), 0.37), atol=1e-6)

    def edge(height, width):
        y, x = np.mgrid[:height, :width]
        inside = (x + 0.5) / width + 0.35 * (y + 0.5) / height < 0.7
        return np.repeat(inside[..., None], 3, -1).astype(np.float32)

    truth = cv2.resize(edge(384, 384), (48, 48), interpolation=cv2.INTER_AREA)
    small = jnp.asarray(cv2.resize(truth, (24, 24), interpolation=cv2.INTER_AREA))
    errors = [np.square(np.asarray(a) - truth).mean() for a in (easu(small), upsample(small))]
    assert errors[0] < 0.8 * errors[1]
    assert easu(small).min() >= 0
    assert easu(small).max() <= 1


@pytest.mark.slow
def test_gradients_are_finite_and_dtypes_stay():
    image = jnp.asarray(random(4, 5, 3))
    for function in (upsample, easu):
        for given in (image, jnp.zeros_like(image)):
            assert np.isfinite(jax.grad(lambda a, f=function: jnp.sum(jnp.square(f(a))))(given)).all()
        assert function(image.astype(jnp.bfloat16)).dtype == jnp.bfloat16


def test_no_implicit_promotion(strict):
    image, jitter = jnp.asarray(random(4, 5, 3)), jnp.zeros(2)
    for function in (upsample, easu):
        jax.eval_shape(jax.grad(lambda a, f=function: jnp.sum(f(a, scale=1.5, jitter=jitter))), image)


def test_errors(unchecked):
    image = jnp.zeros((4, 5, 3))
    with pytest.raises(ValueError, match="scale: expected a positive number, got 0"):
        upsample(image, scale=0)
    with pytest.raises(ValueError, match="filter: expected one of 'nearest', 'bilinear', 'bicubic', got 'cubic'"):
        upsample(image, filter="cubic")
    with pytest.raises(ValueError, match=r"jitter: expected shape \[2\], got \[3\]"):
        easu(image, jitter=jnp.zeros(3))
    with pytest.raises(ValueError, match=r"image: expected shape \[H, W, 3\], got \[4, 5, 1\]"):
        easu(image[..., :1])
