"""Hole masks: each mask against a float64 loop over the taps, a frame onto itself, scenes made by hand, soft masks."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from oracles import random, random_motion

import jaxtrapolate as jx
from jaxtrapolate.ops.holes import HoleMasks, hole_masks
from jaxtrapolate.records import replace

SIZE = (6, 8)


def unit(v):
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-30)


def buffers(seed, dtype=np.float32):
    """Random ids in patches, normals, positions on a slanted wall with steps, and a little sky."""
    rng = np.random.default_rng(seed)
    height, width = SIZE
    stencil = rng.integers(0, 2, (height // 2, width // 2, 1)).repeat(2, 0).repeat(2, 1) * rng.integers(1, 3)
    y, x = np.mgrid[:height, :width]
    step = rng.integers(0, 2, (height // 2, width // 2)).repeat(2, 0).repeat(2, 1) * 5.0
    position = np.stack([x * 1.0, -y * 1.0, 0.2 * x - step], -1)
    sky = np.zeros((height, width, 1))
    sky[0, :3] = 1
    normal = np.where(
        sky > 0, 0, unit(np.stack([0.3 * step, 0 * x, 1 + 0 * x], -1) + rng.normal(0, 0.05, (height, width, 3)))
    )
    values = {
        "stencil": stencil,
        "position": position,
        "normal": normal,
        "sky": sky,
        "depth": 10 + step[..., None],
        "n_dot_v": rng.uniform(0.2, 1, (height, width, 1)),
    }
    return {name: value.astype(dtype) for name, value in values.items()}


def gbuffer(values, *names):
    return jx.GBuffer(**{name: jnp.asarray(value) for name, value in values.items() if not names or name in names})


def taps(x, y):
    """The pixels around a place held to the frame that have weight."""
    height, width = SIZE
    x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
    for j, i in itertools.product((int(np.floor(y)), int(np.floor(y)) + 1), (int(np.floor(x)), int(np.floor(x)) + 1)):
        weight = (1 - abs(x - i)) * (1 - abs(y - j))
        if weight > 0:
            yield j, i, weight


def spacing(position, sky):
    """The distance to the nearer of the neighbours along an axis that show a surface, the larger of both axes."""
    out = np.zeros(SIZE)
    for r, c in np.ndindex(SIZE):
        for step in ((1, 0), (0, 1)):
            ways = [(r + s * step[0], c + s * step[1]) for s in (-1, 1)]
            ways = [w for w in ways if 0 <= w[0] < SIZE[0] and 0 <= w[1] < SIZE[1]]
            ways = [w for w in ways if not sky[w] and not sky[r, c]]
            distances = [np.linalg.norm(np.float64(position[w]) - position[r, c]) for w in ways]
            out[r, c] = max(out[r, c], min(distances, default=0))
    return out


def expected_masks(target, source, motion, threshold=2.0, normal_threshold=0.98):
    """The masks of taps="weighted" as the docstring states them."""
    out = {name: np.zeros((*SIZE, 1), bool) for name in ("stencil", "normal", "position", "depth", "outside")}
    seen, around = oracles.in_frame(motion), spacing(target["position"], target["sky"][..., 0] > 0.5)
    for r, c, x, y, _ in oracles.places(motion):
        out["outside"][r, c] = not seen[r, c]
        if not seen[r, c]:
            continue
        around_it = list(taps(x, y))
        ids = [round(float(source["stencil"][j, i, 0])) for j, i, _ in around_it]
        here = round(float(target["stencil"][r, c, 0]))
        out["stencil"][r, c] = any(i != here for i in ids)
        static = here == 0 and not any(ids)
        sky, skies = target["sky"][r, c, 0] > 0.5, [source["sky"][j, i, 0] > 0.5 for j, i, _ in around_it]
        out["depth"][r, c] = any(there != sky for there in skies)
        a, b = np.float64(target["normal"][r, c]), sum(w * np.float64(source["normal"][j, i]) for j, i, w in around_it)
        if not static and (a.any() or b.any()):
            cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b) if a.any() and b.any() else 0
            out["normal"][r, c] = cosine < normal_threshold
        if isinstance(threshold, tuple):
            facing = abs(float(target["n_dot_v"][r, c, 0]))
            limit = threshold[0] * facing + threshold[1] * (1 - facing) + threshold[2] * target["depth"][r, c, 0]
        else:
            limit = threshold * around[r, c] + 1e-3 * target["depth"][r, c, 0]
        far = [np.linalg.norm(np.float64(source["position"][j, i]) - target["position"][r, c]) for j, i, _ in around_it]
        beyond = any(there != sky or (not sky and d > limit) for there, d in zip(skies, far, strict=True))
        out["position"][r, c] = static and beyond
    return out


@pytest.mark.parametrize("threshold", [2.0, (1.0, 3.0, 0.05)], ids=str)
def test_weighted_against_the_loop(threshold):
    target, source = buffers(1), buffers(2)
    for motion in (random_motion(*SIZE), random(*SIZE, 2, low=-0.7, high=0.7), random_motion(*SIZE, kinks=True)):
        motion[0, 0] = np.nan
        masks = hole_masks(gbuffer(target), gbuffer(source), jnp.asarray(motion), position_threshold=threshold)
        for name, expected in expected_masks(target, source, motion, threshold).items():
            assert getattr(masks, name).dtype == bool
            np.testing.assert_array_equal(getattr(masks, name), expected, err_msg=name)
        union = np.logical_or.reduce([masks.stencil, masks.normal, masks.position, masks.depth, masks.outside])
        np.testing.assert_array_equal(masks.any, union)


@pytest.mark.parametrize("size", [SIZE, (1, 5), (1, 1)], ids=str)
def test_a_frame_onto_itself_has_no_holes(size):
    values = {name: value[: size[0], : size[1]] for name, value in buffers(1).items()}
    masks = hole_masks(gbuffer(values), gbuffer(values), jnp.zeros((*size, 2)))
    for name in ("stencil", "normal", "position", "depth", "outside"):
        assert not getattr(masks, name).any(), name


def test_whole_pixels_have_only_the_border_as_holes():
    values = buffers(1)
    moved = {name: oracles.shift(value, -1, 1) for name, value in values.items()}
    motion = jnp.full((*SIZE, 2), jnp.asarray([1.0, -1.0]))
    masks = hole_masks(gbuffer(values), gbuffer(moved), motion)
    expected = np.zeros((*SIZE, 1), bool)
    expected[0], expected[:, -1] = True, True
    np.testing.assert_array_equal(masks.any, expected)


def test_absent_buffers_have_no_mask():
    target, source, motion = buffers(1), buffers(2), jnp.zeros((*SIZE, 2))
    masks = hole_masks(gbuffer(target, "normal", "depth"), gbuffer(source), motion)
    assert masks.stencil is None
    assert masks.position is None
    assert masks.normal is not None
    alone = hole_masks(jx.GBuffer(), jx.GBuffer(), motion)
    assert len(jax.tree.leaves(alone)) == 1
    np.testing.assert_array_equal(alone.any, alone.outside)
    # without ids the normals are compared everywhere, and so are the positions
    full = hole_masks(gbuffer(target, "normal", "position"), gbuffer(source, "normal", "position"), motion)
    zero = np.zeros_like(target["stencil"])
    still = expected_masks(target | {"stencil": zero, "sky": zero}, source | {"stencil": zero}, np.zeros((*SIZE, 2)))
    assert full.position.sum() >= still["position"].sum() > 0


def test_a_disoccluded_stripe_is_found():
    """A box of another id that moved right: the background it uncovered is no longer there in the source."""
    stencil, source = (np.zeros((4, 9, 1), np.float32) for _ in range(2))
    stencil[:, 5:7], source[:, 3:5] = 3, 3
    motion = np.zeros((4, 9, 2), np.float32)
    motion[:, 5:7, 0] = -2
    masks = hole_masks(
        jx.GBuffer(stencil=jnp.asarray(stencil)), jx.GBuffer(stencil=jnp.asarray(source)), jnp.asarray(motion)
    )
    assert {int(c) for _, c, _ in np.argwhere(np.asarray(masks.any))} == {3, 4}


def test_release_marks_more():
    """The largest distance over four taps, weightless ones too, marks pixels of a frame warped onto itself."""
    values = buffers(1)
    values["stencil"][:] = 0
    g, motion = gbuffer(values), jnp.zeros((*SIZE, 2))
    masks = hole_masks(g, g, motion, taps="release", position_threshold=(1.0, 1.0, 0.0))
    assert 0 < masks.position.sum() < masks.position.size
    weighted = hole_masks(g, g, motion, position_threshold=(1.0, 1.0, 0.0))
    assert not weighted.position.any()
    away = hole_masks(g, g, motion + 100, taps="release")
    assert away.position.all()
    assert away.outside.all()


def test_release_stencil_is_the_interpolated_id():
    values, other = buffers(1), buffers(2)
    motion = random_motion(*SIZE)
    masks = hole_masks(gbuffer(values), gbuffer(other), jnp.asarray(motion), taps="release")
    warped = oracles.backward_warp(other["stencil"], motion, outside="zero")
    np.testing.assert_array_equal(masks.stencil, np.abs(warped - values["stencil"]) > 1 / 3)


def test_bad_positions_are_holes():
    values = buffers(1)
    values["stencil"][:], values["sky"][:] = 0, 0
    values["position"][2, 3], values["position"][4, 4] = np.nan, np.inf
    masks = hole_masks(gbuffer(values), gbuffer(values), jnp.zeros((*SIZE, 2)))
    assert masks.position[2, 3]
    assert masks.position[4, 4]
    source = buffers(1)
    source["stencil"][:], source["sky"][:] = 0, 0
    masks = hole_masks(gbuffer(source), gbuffer(values), jnp.zeros((*SIZE, 2)))
    assert {tuple(at[:2]) for at in np.argwhere(np.asarray(masks.position))} == {(2, 3), (4, 4)}


def test_nearest_is_weighted_at_the_rounded_landing_place():
    target, source = buffers(1), buffers(2)
    motion = np.random.default_rng(3).uniform(-3, 3, (*SIZE, 2)).astype(np.float32)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    rounded = np.stack([np.floor(x + motion[..., 0] + 0.5) - x, np.floor(y + motion[..., 1] + 0.5) - y], -1)
    near = hole_masks(gbuffer(target), gbuffer(source), jnp.asarray(motion), taps="nearest")
    exact = hole_masks(gbuffer(target), gbuffer(source), jnp.asarray(rounded, jnp.float32))
    inside = ~np.asarray(near.outside) & ~np.asarray(exact.outside)
    for name in ("stencil", "normal", "position", "depth"):
        np.testing.assert_array_equal(
            np.asarray(getattr(near, name))[inside], np.asarray(getattr(exact, name))[inside], err_msg=name
        )


NAMES = ("stencil", "normal", "position", "depth", "outside")


@functools.cache
def soft_function():
    """The weighted sum of all soft masks and its gradients, compiled once."""

    def total(motion, target_normal, source_normal, source_position, thresholds, softness, weights, target, source):
        masks = hole_masks(
            replace(target, normal=target_normal),
            replace(source, normal=source_normal, position=source_position),
            motion,
            softness=softness,
            normal_threshold=thresholds[0],
            position_threshold=thresholds[1],
        )
        return sum(jnp.vdot(weights[name], getattr(masks, name)) for name in NAMES), masks

    return jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2, 3, 4, 5), has_aux=True))


def soft(motion, softness, *, target=None, source=None, weights=None):
    """(sum, masks), gradients; all in float64."""
    target, source = target or buffers(1, np.float64), source or buffers(2, np.float64)
    weights = {name: np.ones((*SIZE, 1)) for name in NAMES} if weights is None else weights
    arrays = np.float64(motion), target["normal"], source["normal"], source["position"], np.array([0.98, 2.0])
    return soft_function()(*arrays, np.float64(softness), weights, gbuffer(target), gbuffer(source))


@pytest.mark.slow
def test_soft_masks_become_hard(x64):
    target, source, motion = buffers(1, np.float64), buffers(2, np.float64), random_motion(*SIZE, dtype=np.float64)
    (_, masks), _ = soft(motion, 1e-5)
    for name, expected in expected_masks(target, source, motion).items():
        value = np.asarray(getattr(masks, name))
        assert value.dtype == np.float64
        assert value.min() >= 0
        assert value.max() <= 1
        if name in ("stencil", "depth"):  # the weight of the taps with another id, or of nothing
            np.testing.assert_array_equal(value > 0, expected)
        else:
            np.testing.assert_allclose(value, expected, atol=1e-3, err_msg=name)
    parts = [np.asarray(getattr(masks, name)) for name in NAMES]
    np.testing.assert_allclose(masks.any, 1 - np.prod([1 - p for p in parts], axis=0), atol=1e-12)


@pytest.mark.slow
def test_soft_gradients_are_finite(x64):
    motion = random_motion(*SIZE)
    motion[0, 0], motion[1, 1], motion[2, 2] = np.nan, np.inf, 1e6
    for value in (0.3, 1e-3, 1e-8):
        _, found = soft(motion, value)
        for gradient in found:
            assert np.isfinite(gradient).all()
    _, found = soft(motion, 0.3)
    assert all(np.abs(gradient).max() > 0 for gradient in found)
    same = buffers(1, np.float64)
    (_, masks), found = soft(np.zeros((*SIZE, 2)), 0.3, source=same)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((masks, found)))


def test_soft_gradients_against_differences(x64):
    """Of the mask of normals, smooth in motion, normals, threshold and softness; the others jump with the taps."""
    weights = {name: random(*SIZE, 1, seed=5, dtype=np.float64) * (name == "normal") for name in NAMES}
    target, source, motion = (
        buffers(1, np.float64),
        buffers(3, np.float64),
        oracles.inner_motion(*SIZE, dtype=np.float64),
    )
    lift = np.array([0, 0, 0.1])
    target["normal"], source["normal"] = target["normal"] + lift, source["normal"] + lift

    def total(motion, target_normal, source_normal, softness):
        changed = {"target": target | {"normal": target_normal}, "source": source | {"normal": source_normal}}
        return float(soft(motion, softness, weights=weights, **changed)[0][0])

    arrays = (motion, target["normal"], source["normal"], np.float64(0.5))
    _, found = soft(motion, 0.5, weights=weights, target=target, source=source)
    found = [np.asarray(found[k]) for k in (0, 1, 2, 5)]
    assert all(np.abs(gradient).max() > 0 for gradient in found)
    oracles.assert_gradients(total, arrays, found, directions=2)


def test_soft_gradient_beside_a_bad_position(x64):
    source = buffers(1, np.float64)
    source["position"][2, 3], source["position"][4, 4] = np.nan, np.inf
    _, found = soft(np.zeros((*SIZE, 2)), 0.3, source=source)
    assert all(np.isfinite(gradient).all() for gradient in found)


def test_union_of_nothing(unchecked):
    with pytest.raises(ValueError, match="no mask is there"):
        _ = HoleMasks().any


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"taps": "all"}, ValueError, "taps: expected one of 'weighted', 'nearest', 'release', got 'all'"),
        ({"motion": jnp.zeros((6, 8, 3))}, ValueError, r"motion: expected shape \[H, W, 2\], got \[6, 8, 3\]"),
        ({"motion": jnp.zeros((6, 8, 2), int)}, TypeError, "motion: expected a floating-point array"),
        ({"target": jx.GBuffer(stencil=jnp.zeros((6, 7, 1)))}, ValueError, r"target\.stencil: .*\[6, 8, 1\], got"),
        ({"source": jx.GBuffer(normal=jnp.zeros((6, 8, 1)))}, ValueError, r"source\.normal: .*\[6, 8, 3\], got"),
        ({"source": None}, TypeError, "source: expected a GBuffer, got NoneType"),
    ],
)
def test_errors(unchecked, change, error, message):
    arguments = {"target": jx.GBuffer(), "source": jx.GBuffer(), "motion": jnp.zeros((6, 8, 2))} | change
    positional = [arguments.pop(name) for name in ("target", "source", "motion")]
    with pytest.raises(error, match=message):
        hole_masks(*positional, **arguments)
