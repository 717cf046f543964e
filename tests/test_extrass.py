"""ExtraSS at the input's resolution: against oracles' guided warps, the blend against a loop, what is left out."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from flax import nnx
from marks import slow_rows
from oracles import random
from small_extranet import image_of, make_window, random_model

import jaxtrapolate as jx
from jaxtrapolate.methods.extrass import (
    Blend,
    Refinement,
    blend_mask,
    doubled,
    encoded_truth,
    extrass_refine,
    extrass_refine_config,
    half,
)
from jaxtrapolate.networks import FRNet, FRNetConfig
from jaxtrapolate.records import GBuffer, replace
from jaxtrapolate.weights import save_weights

SMALL = FRNetConfig(widths=(4, 6))
SIZE = (9, 13)


def guide(buffers):
    return np.concatenate([buffers.albedo, buffers.normal], -1)


def warped(source, target, motion, floor=0.01):
    """Divided by the base colour, guided-warped, multiplied by the target's; and where ties make it another."""
    light = np.float64(source.color) / np.maximum(np.float64(source.gbuffer.albedo), floor)
    found, gap = oracles.guided_warp(light, motion, guide(target), guide(source.gbuffer))
    return found * np.maximum(target.albedo, floor), gap > 1e-4


def test_extrass_warp_against_the_oracle():
    history, target = make_window(SIZE, rendered=1, sky=False)
    found = image_of(jx.load("extrass_warp", space="linear"), history, target)
    expected, sure = warped(history[-1], target.gbuffer, target.motion)
    np.testing.assert_allclose(found[sure], expected[sure], rtol=2e-3, atol=1e-4)
    assert sure.mean() > 0.9


@pytest.mark.parametrize("size", [(4, 6), (5, 7), (1, 3)])
def test_half_and_back(size):
    image = random(*size, 3)
    smaller = half(jnp.asarray(image))
    assert smaller.shape == (-(-size[0] // 2), -(-size[1] // 2), 3)
    back = doubled(smaller, jnp.asarray(image))
    for r, c in np.ndindex(size):
        np.testing.assert_array_equal(back[r, c], image[r // 2 * 2, c // 2 * 2])


def mask_loop(light, image, buffers, *, similar, changed, softness, least):
    """Eq. 6, one pixel after the other."""

    def step(x):
        return np.clip((x / softness + 1) / 2, 0, 1) if softness else float(x > 0)

    result = np.zeros((*light.shape[:2], 1))
    for r, c in np.ndindex(light.shape[:2]):
        if buffers.sky[r, c, 0] > 0.5 or not np.isfinite([light[r, c], image[r, c]]).all():
            continue
        a, b = r // 2 * 2, c // 2 * 2
        albedo = np.float64(buffers.albedo[a, b]) - buffers.albedo[r, c]
        alike = (1 - np.linalg.norm(albedo) / np.sqrt(3)) * (np.float64(buffers.normal[a, b]) @ buffers.normal[r, c])
        difference = np.abs(np.float64(light[r, c]) - image[r, c]).sum() / max(np.abs(light[r, c]).sum(), least)
        result[r, c] = step(alike - similar) * step(difference - changed)
    return result


@pytest.mark.parametrize("softness", [0.0, 0.4])
def test_the_blend_against_a_loop(softness):
    buffers = make_window((7, 9), rendered=1)[1].gbuffer
    light, image = random(7, 9, 3, seed=1), random(7, 9, 3, seed=2)
    light[2, 3], image[3, 4, 1], light[4, 4] = np.nan, np.inf, 0
    how = {"similar": 0.8, "changed": 0.5, "softness": softness, "least": 1e-2}
    found = blend_mask(jnp.asarray(light), jnp.asarray(image), buffers, SimpleNamespace(**how))
    expected = mask_loop(light, image, jax.tree.map(np.asarray, buffers), **how)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert 0.05 < np.mean(expected > 0) < 0.9


def test_without_buffers_all_surfaces_are_alike():
    light, image = jnp.full((3, 4, 3), 0.5), jnp.ones((3, 4, 3))
    assert np.all(blend_mask(light, image, None, Blend()) == 1)
    assert np.all(blend_mask(light, light, GBuffer(), Blend()) == 0)


def silent(flow=(0.0, 0.0)):
    """A network whose flow is the same everywhere."""
    model = nnx.clone(random_model(SMALL, FRNet))
    for decoder in model.decoders:
        decoder.head.feature.kernel[...] = jnp.zeros_like(decoder.head.feature.kernel[...])
        decoder.head.feature.bias[...] = jnp.zeros_like(decoder.head.feature.bias[...])
    bias = np.zeros((4, 2), np.float32)
    bias[:] = flow
    model.decoders[-1].head.feature.bias[...] = jnp.asarray(bias.reshape(-1))
    return model


PREPARED = Refinement(space="linear")


def test_what_the_network_is_shown_against_the_oracle():
    """Both histories halved and warped there by the halved motion, chained to the older one."""
    history, target = make_window(SIZE, rendered=2, sky=False)
    method = extrass_refine(silent(), preparation=PREPARED)
    values = method.values_before("network", method.state, (), history, target)
    motion = np.asarray(target.motion)
    older = oracles.chain_motion(oracles.chain_motion(motion, history[2].motion), history[1].motion)
    small = jax.tree.map(lambda a: np.asarray(a)[::2, ::2], target.gbuffer)
    for found, source, moved in zip(values["inputs"], (history[2], history[0]), (motion, older), strict=False):
        frame = jx.Frame(color=source.color[::2, ::2], gbuffer=jax.tree.map(lambda a: a[::2, ::2], source.gbuffer))
        light, sure = warped(frame, small, moved[::2, ::2] / 2)
        light = np.maximum(light, 0)
        np.testing.assert_allclose(np.asarray(found)[sure], np.sqrt(light / (1 + light))[sure], atol=2e-3)
        assert sure.mean() > 0.8
    np.testing.assert_array_equal(values["inputs"][2], small.roughness)


ROWS = [(True, "light"), (False, "change"), *slow_rows((False, "light"), (True, "change"))]


@pytest.mark.parametrize(("modulated", "taken"), ROWS)
def test_the_answer_is_the_flows_light_where_the_mask_takes_it(modulated, taken):
    preparation = Refinement(space="linear", modulated=modulated, taken=taken)
    method = extrass_refine(silent((1.0, 0.0)), preparation=preparation)
    history, target = make_window(SIZE, rendered=2)
    values = method.values_before("network", method.state, (), history, target)
    newer = np.asarray(values["inputs"][0], np.float64)
    moved = oracles.backward_warp(newer, np.broadcast_to([1.0, 0.0], (*newer.shape[:2], 2)))

    def larger(image):
        return np.repeat(np.repeat(image, 2, 0), 2, 1)[: SIZE[0], : SIZE[1]]

    light = larger(moved)
    if taken == "change":
        before = np.maximum(np.float64(values["image" if modulated else "warped"]), 0)
        before = np.sqrt(before / (1 + before))
        most = np.maximum(np.maximum(before, larger(newer)), light)
        light = np.clip(before + light - larger(newer), 0, most)
    light = light**2 / (1 - light**2)
    buffers = jax.tree.map(np.asarray, target.gbuffer)
    if not modulated:
        light = light * np.where(buffers.sky > 0.5, 1, np.maximum(buffers.albedo, 0.01))
    image = np.asarray(values["image"])
    mask = mask_loop(light, image, buffers, similar=0.1, changed=0.1, softness=0, least=1e-3)
    found = image_of(method, history, target)
    np.testing.assert_allclose(found, np.where(mask > 0, light, image), rtol=5e-3, atol=1e-4)
    assert 0.2 < mask.mean() < 1


def test_with_one_rendered_frame_it_is_the_guided_warp():
    """And with motion that does not lead to the second."""
    method = extrass_refine(silent((2.0, 1.0)))
    history, target = make_window(SIZE, rendered=2)
    plain = image_of(jx.load("extrass_warp"), history[-1:], target)
    np.testing.assert_array_equal(image_of(method, history[-1:], target), plain)
    broken = (history[0], replace(history[1], motion=None), history[2])
    np.testing.assert_array_equal(image_of(method, broken, target), plain)
    assert set(method.missing(history[-1:], target)) == {"halved warps", "network", "blend", "sky"}


def test_where_no_light_moves_no_network_runs():
    """Both histories alike: whatever the flow is, the answer is the guided warp."""
    history, target = make_window(SIZE, rendered=1, sky=False)
    still = jnp.zeros_like(target.motion)
    frame = replace(history[0], motion=still)
    between = replace(frame, color=None)
    target = replace(target, motion=still, gbuffer=frame.gbuffer)
    found = image_of(extrass_refine(silent((2.0, 1.0))), (frame, between, frame), target)
    np.testing.assert_array_equal(found, image_of(jx.load("extrass_warp"), (frame,), target))


@pytest.mark.parametrize("modulated", [True, False])
def test_the_truth_at_half_size(modulated):
    target = make_window((5, 6), rendered=1)[1]
    color = random(5, 6, 3, high=3.0)
    found = encoded_truth(jnp.asarray(color), target.gbuffer, preparation=Refinement(modulated=modulated))
    light = np.float64(color)
    if not modulated:
        divisor = np.where(np.asarray(target.gbuffer.sky) > 0.5, 1, np.maximum(target.gbuffer.albedo, 0.01))
        light = light / divisor
    light = light[::2, ::2]
    np.testing.assert_allclose(found, np.sqrt(light / (1 + light)), rtol=1e-5)


def test_weights_from_a_file(tmp_path):
    model = random_model(SMALL, FRNet)
    preparation = Refinement(modulated=False, curve="log")
    tree = nnx.to_pure_dict(nnx.state(model))
    path = save_weights(tmp_path, "extrass_refine", tree, config=extrass_refine_config(SMALL, preparation), note="none")
    history, target = make_window(SIZE, rendered=2)
    found = image_of(jx.load("extrass_refine", weights=path), history, target)
    np.testing.assert_array_equal(found, image_of(extrass_refine(model, preparation=preparation), history, target))
    changed = {o.name: (o.default, o.value) for o in jx.load("extrass_refine").replace(changed=0.2).options}["changed"]
    assert changed == (0.0, 0.2), "the default is what the weights that come with it say"


def test_errors():
    with pytest.raises(ValueError, match="curve: expected one of 'tone', 'log', got 'mu'"):
        Refinement(curve="mu")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="floor: expected 0 or more, got -1"):
        Refinement(floor=-1)
