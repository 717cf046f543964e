"""Demodulation, logarithm, tone map and sRGB: their formulas in float64, their inverses, and finite gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
import skimage.color
from oracles import random

import jaxtrapolate as jx
from jaxtrapolate.ops import radiance
from jaxtrapolate.ops.radiance import compress, expand
from jaxtrapolate.records import replace

SIZE = (5, 7)


def gbuffer(dtype=np.float32):
    albedo = random(*SIZE, 3, seed=1, dtype=dtype)
    albedo[0, 0], albedo[1, 1] = 0, (0.5, 0, 1e-4)
    sky = np.zeros((*SIZE, 1), dtype)
    sky[4, :3] = 1
    buffers = {"albedo": albedo, "sky": sky}
    for k, name in enumerate(("specular", "metallic")):
        buffers[name] = random(*SIZE, 1, seed=2 + k, dtype=dtype)
    return jx.GBuffer(**{name: jnp.asarray(value) for name, value in buffers.items()})


def divisor(g, by="albedo+specular", floor=1e-2):
    out = np.float64(g.albedo)
    if by == "albedo+specular" and g.specular is not None:
        out = out + 0.08 * np.float64(g.specular) * (1 - (0 if g.metallic is None else np.float64(g.metallic)))
    out = np.maximum(out, floor)
    return out if g.sky is None else np.where(np.asarray(g.sky) > 0.5, 1, out)


@pytest.mark.parametrize(
    "absent", [(), ("specular",), ("metallic",), ("sky",), ("specular", "metallic", "sky")], ids=str
)
@pytest.mark.parametrize("by", ["albedo+specular", "albedo"])
def test_demodulate_against_the_formula(by, absent):
    g, color = replace(gbuffer(), **dict.fromkeys(absent)), random(*SIZE, 3, high=4)
    for floor in (1e-2, 0.2):
        expected = divisor(g, by, floor)
        result = radiance.demodulate(jnp.asarray(color), g, by=by, floor=floor)
        np.testing.assert_allclose(result, color / expected, rtol=1e-6)
        np.testing.assert_allclose(radiance.demodulation_divisor(g, by=by, floor=floor), expected, rtol=1e-6)
        np.testing.assert_allclose(radiance.modulate(result, g, by=by, floor=floor), color, rtol=3e-7)


def test_what_reflects_nothing_is_black_without_a_floor():
    """As the release of ExtraNet: 0 where the albedo is 0, nothing divided by 0, gradients included."""
    g, color = gbuffer(), jnp.asarray(random(*SIZE, 3, low=0.5))
    g = replace(g, albedo=g.albedo.at[1:3, 2:4].set(0).at[0, 0, 1].set(0), sky=None)
    result = np.asarray(radiance.demodulate(color, g, by="albedo", floor=0.0))
    black = np.asarray(g.albedo) == 0
    assert (result[black] == 0).all()
    np.testing.assert_allclose(result[~black], np.asarray(color)[~black] / np.asarray(g.albedo)[~black], rtol=1e-6)
    gradient = jax.grad(
        lambda c, a: jnp.sum(radiance.demodulate(c, replace(g, albedo=a), by="albedo", floor=0.0)), (0, 1)
    )
    assert all(np.isfinite(v).all() for v in gradient(color, g.albedo))


def test_demodulate_by_none():
    color, bare = jnp.asarray(random(*SIZE, 3)), jx.GBuffer()
    np.testing.assert_array_equal(radiance.demodulate(color, bare, by="none"), color)
    np.testing.assert_array_equal(radiance.modulate(color, bare, by="none"), color)
    np.testing.assert_array_equal(radiance.demodulation_divisor(gbuffer(), by="none"), np.ones((*SIZE, 3)))


@pytest.mark.parametrize("kind", ["float16", "bfloat16"])
def test_demodulate_dtypes(kind):
    color = jnp.asarray(random(*SIZE, 3), kind)
    result = radiance.demodulate(color, gbuffer())
    assert result.dtype == color.dtype
    eps = float(jnp.finfo(color.dtype).eps)
    np.testing.assert_allclose(np.float64(result), np.float64(color) / divisor(gbuffer()), rtol=2 * eps)


def test_a_bad_albedo_gives_the_floor():
    g = gbuffer()
    g = replace(g, albedo=g.albedo.at[2, 2].set(jnp.nan))
    found = np.asarray(radiance.demodulation_divisor(g))
    np.testing.assert_allclose(found[2, 2], 1e-2)


def test_demodulate_gradients(x64):
    g = gbuffer(np.float64)
    color, cotangent = (random(*SIZE, 3, seed=s, dtype=np.float64) for s in (5, 6))
    arrays = (color, *(np.asarray(getattr(g, n)) for n in ("albedo", "specular", "metallic")), np.float64(0.3))

    def build(albedo, specular, metallic):
        return jx.GBuffer(albedo=albedo, specular=specular, metallic=metallic, sky=g.sky)

    def loss(color, albedo, specular, metallic, floor):
        return jnp.sum(cotangent * radiance.demodulate(color, build(albedo, specular, metallic), floor=floor))

    def reference(color, albedo, specular, metallic, floor):
        return np.sum(cotangent * color / divisor(build(albedo, specular, metallic), floor=float(floor)))

    found = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3, 4)))(*arrays)
    oracles.assert_gradients(reference, arrays, [np.asarray(f) for f in found])


VALUES = np.concatenate([[0, 1e-30, 1e-6, 0.001, 0.0031308, 0.04045, 0.5, 1, 2, 100, 6e4], random(50, high=3)])
VALUES = VALUES.astype(np.float32)


def test_formulas():
    x = np.float64(VALUES)
    given = jnp.asarray(VALUES)
    np.testing.assert_allclose(radiance.log_encode(given), np.log1p(x), rtol=3e-7)
    np.testing.assert_allclose(radiance.tonemap(given), (x / (1 + x)) ** (1 / 2.2), rtol=2e-6)
    np.testing.assert_allclose(radiance.tonemap(given, gamma=1.0), x / (1 + x), rtol=2e-6)
    np.testing.assert_allclose(radiance.log_decode(given[:5]), np.expm1(x[:5]), rtol=3e-7)


def test_srgb_against_skimage():
    """skimage has the two directions inside its conversions from and to XYZ; grey keeps its value."""
    encoded = np.linspace(0, 1, 101)
    grey = np.repeat(encoded[:, None], 3, 1)
    linear = skimage.color.rgb2xyz(grey)[:, 1]  # Y of grey is its linear value
    np.testing.assert_allclose(radiance.srgb_decode(jnp.asarray(encoded, jnp.float32)), linear, atol=2e-6)
    np.testing.assert_allclose(radiance.srgb_encode(jnp.asarray(linear, jnp.float32)), encoded, atol=3e-5)


@pytest.mark.parametrize(
    "there, back, high",
    [("log_encode", "log_decode", 1e4), ("tonemap", "tonemap_inverse", 50), ("srgb_encode", "srgb_decode", 1)],
)
def test_inverses(there, back, high):
    x = random(5, 7, 3, high=high)
    x[0, 0] = 0
    again = getattr(radiance, back)(getattr(radiance, there)(jnp.asarray(x)))
    np.testing.assert_allclose(again, x, rtol=2e-4 if there == "tonemap" else 2e-5, atol=1e-7)


def test_special_values():
    special = jnp.asarray([-np.inf, -1.0, -0.0, np.nan, np.inf], jnp.float32)
    np.testing.assert_array_equal(radiance.log_encode(special), [0, 0, 0, 0, np.inf])
    np.testing.assert_array_equal(radiance.log_decode(special), [0, 0, 0, 0, np.inf])
    np.testing.assert_array_equal(radiance.tonemap(special), [0, 0, 0, np.nan, 1])
    outside = jnp.asarray([-1.0, 0, 1.0, 2.0, np.nan], jnp.float32)
    np.testing.assert_array_equal(radiance.tonemap_inverse(outside), [0, 0, np.inf, np.inf, np.nan])
    np.testing.assert_allclose(radiance.srgb_encode(jnp.asarray([-0.01])), [-0.1292])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["log_encode", "log_decode", "tonemap", "tonemap_inverse", "srgb_encode", "srgb_decode"]
)
def test_elementwise_gradients(x64, name):
    function = getattr(radiance, name)
    x = np.array([1e-4, 0.01, 0.2, 0.55, 0.93])
    slope = jax.vmap(jax.grad(lambda v: function(v)))(jnp.asarray(x))
    up, down = (np.asarray(function(jnp.asarray(x * (1 + s)))) for s in (1e-6, -1e-6))
    np.testing.assert_allclose(slope, (up - down) / (2e-6 * x), rtol=1e-6)
    special = jnp.asarray([-1.0, 0.0, 1.5, 1e30, np.nan, np.inf])
    found = np.asarray(jax.vmap(jax.grad(lambda v: jnp.nan_to_num(function(v))))(special))
    last = {"log_decode": 3, "srgb_encode": 4, "srgb_decode": 4}.get(name, 6)  # those grow without bound
    assert np.isfinite(found[:last]).all()
    if name in ("log_encode", "tonemap"):
        np.testing.assert_array_equal(found[:2], 0)


def test_errors(unchecked):
    color, g = jnp.ones((*SIZE, 3)), gbuffer()
    with pytest.raises(ValueError, match="by: expected one of 'albedo\\+specular', 'albedo', 'none', got 'all'"):
        radiance.demodulate(color, g, by="all")
    for function in (radiance.demodulate, radiance.modulate):
        with pytest.raises(ValueError, match=r"gbuffer\.albedo: absent"):
            function(color, replace(g, albedo=None))
        with pytest.raises(ValueError, match=r"gbuffer\.albedo: expected shape \[2, 3, 3\], got \[5, 7, 3\]"):
            function(jnp.ones((2, 3, 3)), g)
        with pytest.raises(ValueError, match=r"expected shape \[H, W, 3\], got \[5, 7, 1\]"):
            function(jnp.ones((*SIZE, 1)), g)
        with pytest.raises(TypeError, match="expected a floating-point array"):
            function(color.astype(int), g)
        with pytest.raises(TypeError, match="gbuffer: expected a GBuffer"):
            function(color, None)


def test_compress_and_expand():
    x = np.concatenate([[0.0], np.logspace(-8, 4, 200)])
    packed = compress(jnp.asarray(x, jnp.float32))
    np.testing.assert_allclose(packed, np.sqrt(x / (1 + x)), rtol=3e-7, atol=0)
    back = np.asarray(expand(packed), np.float64)
    assert np.all(np.abs(back - x) <= 3e-7 * x * (1 + x))
    odd = compress(jnp.array([-1.0, np.nan, np.inf, 0.0], jnp.float32))
    np.testing.assert_array_equal(odd, [0, 0, 1, 0])
    largest = np.finfo(np.float32).max
    np.testing.assert_array_equal(expand(jnp.array([-1.0, 0.0, 1.0, 2.0], jnp.float32)), [0, 0, largest, largest])
    for function, places in ((compress, [-1.0, 0.0, 1e-8, 1.0, 65504.0, np.inf]), (expand, [-1.0, 0.0, 0.5, 1.0, 2.0])):
        assert np.isfinite(jax.grad(lambda v, f=function: f(v).sum())(jnp.array(places, jnp.float32))).all()
