"""The motion of light over surfaces: shadows with known motion, over floors and past silhouettes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtrapolate as jx

SIZE = (90, 130)
STEP = np.float64([4.0, -2.0])  # pixels from the older image to the newer


@pytest.fixture(autouse=True)
def plain(unchecked):
    """NumPy arrays are taken, and the library's own errors seen."""


def shadow(shift, *, size=SIZE):
    """A round soft shadow in evenly lit noise of a camera, `[H, W, 3]`; the whole has moved by `shift` pixels."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
    away = np.hypot(x - 60 - shift[0], y - 45 - shift[1])
    light = 0.7 - 0.4 / (1 + np.exp((away - 20) / 1.5))
    return np.float32(light[..., None] * [1.0, 0.95, 0.9])


def pair():
    return shadow(STEP), shadow((0, 0))


def near(shift=STEP, *, size=SIZE):
    """Where the newer shadow's soft edge is."""
    y, x = np.mgrid[: size[0], : size[1]]
    return np.abs(np.hypot(x - 60 - shift[0], y - 45 - shift[1]) - 20) < 3


def difference(a, b, where):
    return np.square(np.asarray(a) - np.asarray(b))[where].mean()


def continued(newer, flow, confidence, fraction=0.5):
    moved = jx.backward_warp(newer, fraction * flow)
    return newer + confidence * (moved - newer)


def test_a_shadow_goes_on():
    """Half a step later it is half a step further."""
    newer, older = pair()
    flow, confidence = jx.shading_flow(newer, older)
    truth, edge = shadow(1.5 * STEP), near() | near(1.5 * STEP)
    assert difference(continued(newer, flow, confidence), truth, edge) < 0.1 * difference(newer, truth, edge)
    # along the edge nothing is seen to move: what is compared is how far the edge itself goes
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    outward = np.stack([x - 60 - STEP[0], y - 45 - STEP[1]], -1)
    outward /= np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-9)
    trusted = near() & (np.asarray(confidence)[..., 0] > 0.9)
    assert trusted.sum() > 0.4 * near().sum()
    along = np.sum(np.asarray(flow) * outward, -1)[trusted]
    assert np.abs(along + np.sum(STEP * outward, -1)[trusted]).mean() < 0.5


@pytest.mark.slow
def test_equal_images_have_no_flow():
    newer, _ = pair()
    for given in ({}, {"guide": newer}, {"round_trip": 1.0}):
        for value in jx.shading_flow(newer, newer, **given):
            assert not np.any(value)


def test_a_lamp_that_blinks_moves_nothing():
    newer, _ = pair()
    for older in (newer * np.float32(0.6), np.full_like(newer, 0.6), newer + np.float32(0.1)):
        flow, confidence = jx.shading_flow(newer, older)
        made = continued(newer, flow, confidence)
        assert difference(made, newer, np.ones(SIZE, bool)) < 2e-4
        assert np.mean(np.asarray(confidence) > 0.5) < 0.1


def box(image, light):
    """A box before the floor that is lit otherwise, and stands still."""
    image = image.copy()
    image[30:62, 70:100] = light
    return image


def test_guides_of_any_size_and_of_no_sigma():
    """Next to the largest number, or in units of none: what differs is no neighbour, as with a sigma that is small.

    Not to the last bit: smaller images are means, which round.
    """
    newer, older = pair()
    plain = np.zeros((*SIZE, 1), np.float32)
    sides = plain.copy()
    sides[:, 60:] = 1
    expected = jx.shading_flow(newer, older, guide=sides, sigma_guide=1e-12)
    for guide, sigma in ((3e38 * sides, 0.2), (3e38 * sides, 0.0), (sides, 0.0)):
        found = jx.shading_flow(newer, older, guide=np.float32(guide), sigma_guide=sigma)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, atol=0.05)
    still = jx.shading_flow(newer, older, guide=plain, sigma_guide=0.0)
    np.testing.assert_allclose(still[0], jx.shading_flow(newer, older)[0], atol=1e-4)


@pytest.mark.slow
def test_a_silhouette_stays():
    """The shadow passes behind a box: the guide keeps its motion off the box, bit for bit."""
    newer, older = (box(image, 0.5) for image in pair())
    normal = np.zeros((*SIZE, 3), np.float32)
    normal[..., 2] = 1
    normal = box(normal, np.float32([1, 0, 0]))
    flow, confidence = jx.shading_flow(newer, older, guide=normal)
    inside = box(np.zeros((*SIZE, 1), bool), True)[..., 0]
    within = inside.copy()
    within[[30, 31, 60, 61]] = False
    within[:, [70, 71, 98, 99]] = False
    made = continued(newer, flow, confidence)
    np.testing.assert_allclose(np.asarray(made)[within], newer[within], atol=1e-3)
    truth, edge = box(shadow(1.5 * STEP), 0.5), (near() | near(1.5 * STEP)) & ~inside
    guided = difference(made, truth, edge)
    assert guided < 0.3 * difference(newer, truth, edge)
    all_of_it = edge | inside
    without = difference(continued(newer, *jx.shading_flow(newer, older)), truth, all_of_it)
    assert difference(made, truth, all_of_it) < without + 1e-6


@pytest.mark.slow
def test_holes_have_no_weight():
    """What stands in a hole changes nothing outside, and there is no flow in it."""
    newer, older = pair()
    valid = np.ones(SIZE, bool)
    valid[40:60, 76:90] = False
    expected = jx.shading_flow(newer, older, valid=valid)
    hole = ~valid
    spoiled = newer.copy()
    spoiled[hole] = np.random.default_rng(0).uniform(size=(hole.sum(), 3))
    for image in (spoiled, np.where(hole[..., None], np.float32(np.nan), newer)):
        found = jx.shading_flow(image, older, valid=valid)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5)
    assert not np.any(np.asarray(expected[0])[hole])
    assert not np.any(np.asarray(expected[1])[hole])
    missing = jx.shading_flow(np.where(hole[..., None], np.float32(np.inf), newer), older)
    np.testing.assert_allclose(missing[0], expected[0], atol=1e-5)
    none = jx.shading_flow(newer, older, valid=np.zeros(SIZE, bool))
    assert not np.any(none[0])


@pytest.mark.slow
def test_a_flow_back_that_misses_is_not_trusted():
    """A shadow appears: nothing of it was there."""
    newer, older = shadow(STEP), np.full_like(shadow(STEP), 0.65)
    _, loose = jx.shading_flow(newer, older, round_trip=1e3)
    _, tight = jx.shading_flow(newer, older, round_trip=0.1)
    _, never = jx.shading_flow(newer, older)
    np.testing.assert_allclose(loose, never, atol=1e-6)
    assert np.all(np.asarray(tight) <= np.asarray(loose) + 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("finest", [0, 2])
def test_other_resolutions(finest):
    newer, older = pair()
    truth, edge = shadow(1.5 * STEP), near() | near(1.5 * STEP)
    made = continued(newer, *jx.shading_flow(newer, older, finest=finest))
    assert difference(made, truth, edge) < 0.5 * difference(newer, truth, edge)


@pytest.mark.slow
@pytest.mark.parametrize(
    "size", [(1, 1), *(pytest.param(s, marks=pytest.mark.slow) for s in ((5, 7), (1, 7), (6, 1), (33, 17)))]
)
def test_every_size(size):
    rng = np.random.default_rng(0)
    newer, older, guide = (rng.uniform(size=(*size, c)).astype(np.float32) for c in (3, 3, 2))
    flow, confidence = jx.shading_flow(newer, older, guide=guide)
    assert flow.shape == (*size, 2)
    assert confidence.shape == (*size, 1)
    assert np.isfinite(flow).all()
    assert np.isfinite(confidence).all()
    assert (np.asarray(confidence) >= 0).all()
    assert (np.asarray(confidence) <= 1).all()


@pytest.mark.slow
def test_half_precision_is_computed_in_float32():
    newer, older = (jnp.asarray(image[:40, :60]).astype(jnp.bfloat16) for image in pair())
    results = jx.shading_flow(newer, older)
    expected = jx.shading_flow(newer.astype(jnp.float32), older.astype(jnp.float32))
    for a, b in zip(results, expected, strict=True):
        assert a.dtype == jnp.bfloat16
        np.testing.assert_array_equal(a, b.astype(jnp.bfloat16))


@pytest.mark.slow
def test_gradients_are_those_of_differences(x64):
    """In float64, against central differences along a direction: with respect to images, guide and numbers."""
    crop = (slice(20, 44), slice(50, 80))
    rng = np.random.default_rng(1)
    images = [np.float64(image[crop]) + 0.02 * rng.normal(size=(24, 30, 3)) for image in pair()]
    guide, weights = 0.1 * rng.normal(size=(24, 30, 2)), rng.normal(size=(24, 30, 3))

    @jax.jit
    def loss(newer, older, guide, sigma, gain, change):
        flow, confidence = jx.shading_flow(
            newer, older, guide=guide, sigma_guide=sigma, least_gain=gain, least_change=change
        )
        return jnp.sum(jnp.concatenate([flow, confidence], -1) * weights)

    given = [jnp.asarray(a) for a in (*images, guide, 0.2, 0.05, 1e-4)]
    scales = (0.1, 0.1, 0.1, 0.1, 0.01, 1e-5)
    along = [jnp.asarray(s * rng.normal(size=a.shape)) for a, s in zip(given, scales, strict=True)]
    gradient = jax.jit(jax.grad(loss, argnums=tuple(range(6))))(*given)
    step = 1e-7
    ahead, behind = (loss(*(a + s * step * b for a, b in zip(given, along, strict=True))) for s in (1, -1))
    difference = (ahead - behind) / (2 * step)
    assert abs(float(difference)) > 1e-3
    found = sum(jnp.vdot(a, b) for a, b in zip(gradient, along, strict=True))
    np.testing.assert_allclose(found, difference, rtol=1e-3)


@pytest.mark.slow
def test_another_number_compiles_nothing():
    import jax._src.test_util as jtu

    newer, older = (jnp.asarray(image[:20, :20]) for image in pair())
    jx.shading_flow(newer, older, least_gain=0.3)
    with jtu.count_jit_and_pmap_lowerings() as count:
        jx.shading_flow(newer, older, least_gain=0.5, sigma_guide=0.1)
    assert count() == 0


@pytest.mark.parametrize(
    "change, kind, message",
    [
        ({"older": np.zeros((4, 5, 1), np.float32)}, ValueError, "older: expected shape"),
        ({"guide": np.zeros((4, 6, 1), np.float32)}, ValueError, "guide: expected shape"),
        ({"valid": np.zeros((4, 5), np.float32)}, TypeError, "valid: expected a bool array"),
        ({"finest": -1}, ValueError, "finest: expected 0 or more"),
        ({"reach": -1}, ValueError, "reach: expected 0 or more"),
    ],
)
def test_what_does_not_fit_is_named(change, kind, message):
    given = {n: np.zeros((4, 5, 3), np.float32) for n in ("newer", "older")} | change
    with pytest.raises(kind, match=message):
        jx.shading_flow(given.pop("newer"), given.pop("older"), **given)
