"""Work in strips: the same as all rows at once, whatever the height, mapped and differentiated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import random

from jaxtrapolate.ops.strips import by_strips, once, rows_of

pytestmark = pytest.mark.usefixtures("strict")


def upside_down(sources, top, rows):
    """Rows from anywhere: each row plus its mirror image, its number, and whether it is positive."""
    image, gain = sources
    number = top + jnp.arange(rows)
    mirrored = image[image.shape[0] - 1 - number]
    total = gain * (rows_of(image, top, rows) + mirrored)
    return {"total": total, "number": jnp.broadcast_to(number[:, None], (rows, 2)), "up": once(total > 0)}


def expected(image, gain):
    total = gain * (image + image[::-1])
    number = np.broadcast_to(np.arange(len(image))[:, None], (len(image), 2))
    return {"total": total, "number": number, "up": total > 0}


@pytest.mark.parametrize("height", [1, 15, 16, 17, 32, 37])
def test_all_rows(height):
    image = random(height, 3, low=-1)
    made = by_strips(upside_down, height, (jnp.asarray(image), jnp.float32(0.5)))
    for name, wanted in expected(image, np.float32(0.5)).items():
        np.testing.assert_array_equal(made[name], wanted)


def test_mapped_and_differentiated():
    images, gains = random(2, 37, 3, low=-1), np.float32([0.5, 2])

    def total(image, gain):
        return jnp.sum(jnp.square(by_strips(upside_down, 37, (image, gain))["total"]))

    gradients = jax.jit(jax.vmap(jax.grad(total, argnums=(0, 1))))(jnp.asarray(images), jnp.asarray(gains))
    for k in (0, 1):
        both = np.float64(images[k]) + images[k][::-1]
        np.testing.assert_allclose(gradients[0][k], 4 * np.float64(gains[k]) ** 2 * both, rtol=1e-5)
        np.testing.assert_allclose(gradients[1][k], 2 * gains[k] * np.sum(both**2), rtol=1e-5)
