"""Methods: the four that warp, their stages, what they leave out, and what they say when something is missing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import PAN, make_frame

import jaxtrapolate as jx
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.methods.hindsight import plain_share
from jaxtrapolate.methods.stages import chain
from jaxtrapolate.records import replace

NAMES = ("repeat", "warp", "occlusion_warp", "guided_warp")


def window(time=5, **kwargs):
    frames = [make_frame(t, **kwargs) for t in range(time - 3, time + 1)]
    history = (frames[0], hide(frames[1]), frames[2])
    return history, hide(frames[3]), frames[3].color


def db(image, truth):
    return float(jx.psnr(jx.tonemap(jnp.asarray(image)), jx.tonemap(jnp.asarray(truth))))


@pytest.fixture(scope="module")
def methods():
    return {name: jx.load(name) for name in NAMES}


def test_names_are_those_of_the_contract():
    assert set(NAMES) <= set(jx.method_names())


def test_repeat_is_the_newest_frame(methods):
    history, target, _ = window()
    assert np.array_equal(methods["repeat"](history, target), history[-1].color)


def test_warp_is_a_backward_warp(methods):
    history, target, _ = window()
    expected = jx.backward_warp(history[-1].color, target.motion)
    np.testing.assert_allclose(methods["warp"](history, target), expected, rtol=1e-6)


def test_motion_chains_through_frames_without_colour(methods):
    frames = [make_frame(t) for t in range(4)]
    history = (frames[0], hide(frames[1]), hide(frames[2]))
    image = methods["warp"](history, hide(frames[3]))
    motion = frames[3].motion
    for frame in (frames[2], frames[1]):
        motion = jx.chain_motion(motion, frame.motion)
    np.testing.assert_allclose(image, jx.backward_warp(frames[0].color, motion), rtol=1e-5, atol=1e-6)
    inner = np.zeros((32, 48), bool)
    inner[20:28, 30:40] = True  # wall in all frames
    assert np.allclose(np.asarray(motion)[inner], 3 * PAN, atol=1e-5)


def test_each_step_up_is_better(methods):
    history, target, truth = window()
    scores = {name: db(method(history, target), truth) for name, method in methods.items()}
    assert scores["repeat"] < scores["warp"] < scores["occlusion_warp"]
    assert scores["warp"] + 3 < scores["guided_warp"]


def test_holes_are_filled_from_the_wall(methods):
    """Where the box uncovers the wall the warp repeats the box; the others do not."""
    history, target, truth = window()
    masks = jx.hole_masks(target.gbuffer, history[-1].gbuffer, target.motion)
    hole = np.asarray(masks.stencil)
    assert 0 < hole.mean() < 0.2
    error = {n: np.abs(np.asarray(m(history, target)) - truth)[hole[..., 0]].mean() for n, m in methods.items()}
    assert error["guided_warp"] < 0.4 * error["warp"]
    assert error["occlusion_warp"] < 0.8 * error["warp"]


@pytest.mark.parametrize("name", NAMES)
def test_a_rendered_target_is_returned(methods, name):
    history, target, truth = window()
    assert np.array_equal(methods[name](history, replace(target, color=truth)), truth)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_one_frame_of_history_is_enough(methods, name):
    history, target, truth = window()
    assert db(methods[name](history[-1:], target), truth) > 10
    assert "hindsight" not in [s.name for s in methods[name].active(history[-1:], target)]


def test_stages_without_their_buffers_are_left_out(methods):
    history, target, _ = window()
    bare = [replace(f, gbuffer=replace(f.gbuffer, albedo=None)) for f in (*history, target)]
    stages = [s.name for s in methods["guided_warp"].active(tuple(bare[:-1]), bare[-1])]
    assert "demodulate" not in stages
    assert "modulate" not in stages
    assert "hindsight" not in stages
    assert "guided warp" in stages
    assert methods["guided_warp"].missing(tuple(bare[:-1]), bare[-1])["demodulate"] == [
        "history.albedo",
        "target.albedo",
    ]


def test_a_missing_buffer_is_named(methods):
    history, target, _ = window()
    flat = replace(target, gbuffer=replace(target.gbuffer, depth=None))
    with pytest.raises(ValueError, match=r"'occlusion_warp', stage 'occlusion motion': missing target\.depth"):
        methods["occlusion_warp"](history, flat)
    with pytest.raises(ValueError, match=r"missing target\.motion"):
        methods["warp"](history, replace(target, motion=None))


def test_history_without_colour_is_refused(methods):
    history, target, _ = window()
    with pytest.raises(ValueError, match="expected a frame with colour, got 1 frames without"):
        methods["warp"]((hide(history[-1]),), target)
    with pytest.raises(ValueError, match=r"target\.motion: expected shape \[32, 48, 2\]"):
        methods["warp"](history, replace(target, motion=np.zeros((5, 5, 2), np.float32)))


def test_unknown_names_and_weights_are_refused():
    with pytest.raises(ValueError, match="expected one of repeat, warp"):
        jx.load("wrap")
    with pytest.raises(ValueError, match="has none"):
        jx.load("warp", weights="a.npz")


def test_nothing_is_compiled_twice(methods):
    method = jx.load("occlusion_warp")
    for time in (4, 5, 6):
        history, target, _ = window(time)
        method(history, target)
    assert method._jitted._cache_size() == 1


def test_the_pure_function_under_vmap():
    method = jx.load("guided_warp")
    windows = [window(t) for t in (4, 5)]
    batch = jax.tree.map(lambda *a: jnp.stack([jnp.asarray(x) for x in a]), *[w[:2] for w in windows])
    images = jax.jit(jax.vmap(lambda h, t: method.function(method.state, (), h, t)[1]))(*batch)
    single = np.stack([method(h, t) for h, t, _ in windows])
    np.testing.assert_allclose(images, single, atol=2e-5)


@pytest.mark.slow
def test_the_pure_function_under_grad():
    method = jx.load("guided_warp")
    history, target, truth = window(4)

    def loss(motion):
        return jnp.mean(
            jnp.square(method.function(method.state, (), history, replace(target, motion=motion))[1] - truth)
        )

    gradient = jax.jit(jax.grad(loss))(jnp.asarray(target.motion))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0


@pytest.mark.parametrize("name", ["occlusion_warp", "guided_warp"])
def test_hindsight_keeps_fog_from_printing_a_texture(methods, name):
    """Through fog, colour is not albedo times light: demodulating then loses to the plain warp, hindsight sees it."""
    history, target, truth = window(fog=0.8)
    plain = db(methods["warp"](history, target), truth)
    with_hindsight = db(methods[name](history, target), truth)
    assert with_hindsight > plain - 0.05
    stages = tuple(s for s in methods[name].stages if s.name != "hindsight")
    without = dataclasses.replace(methods[name], stages=stages)
    assert db(without(history, target), truth) < with_hindsight


def test_plain_share_is_small_where_demodulation_holds():
    newest, middle, previous = make_frame(4), make_frame(3), make_frame(2)
    motion = chain((previous, middle, newest), 2, 0)
    share = np.asarray(plain_share(newest, previous, motion, by="albedo+specular"))
    assert share.shape == (4, 6, 1)
    assert (share >= 0).all()
    assert (share <= 1).all()
    foggy = [make_frame(t, fog=0.9) for t in (4, 2)]
    assert share.mean() < np.asarray(plain_share(*foggy, motion, by="albedo+specular")).mean()


@pytest.mark.parametrize("name", ["occlusion_warp", "guided_warp"])
def test_what_stands_still_stays_as_it_is(methods, name):
    frame = replace(make_frame(3), motion=np.zeros((32, 48, 2), np.float32))
    assert (np.asarray(plain_share(frame, frame, jnp.zeros((32, 48, 2)), by="albedo")) == 1).all()
    assert np.array_equal(methods[name]((frame, hide(frame), frame), hide(frame)), frame.color)


@pytest.mark.slow
@pytest.mark.parametrize(
    "size", [(1, 1), *(pytest.param(s, marks=pytest.mark.slow) for s in ((1, 7), (13, 11)))], ids=str
)
@pytest.mark.parametrize("name", NAMES)
def test_any_size(methods, name, size):
    frames = [make_frame(t, size) for t in range(4)]
    image = methods[name]((frames[0], hide(frames[1]), frames[2]), hide(frames[3]))
    assert image.shape == (*size, 3)
    assert np.isfinite(image).all()


def test_the_sky_is_taken_where_the_engine_draws_it(methods):
    history, target, _ = window()
    sky = np.zeros((32, 48, 1), np.float32)
    sky[:3] = 1
    drawn = replace(target, gbuffer=replace(target.gbuffer, sky=sky, sky_color=np.full((32, 48, 3), 7, np.float32)))
    assert np.array_equal(methods["warp"](history, drawn)[:3], np.full((3, 48, 3), 7))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least"), [("repeat", 22.8), ("warp", 27.1), ("occlusion_warp", 29.2), ("guided_warp", 30.2)]
)
def test_known_figures_of_a_path_traced_clip(data, name, least):
    from jaxtrapolate.evaluation.windows import arguments, windows
    from jaxtrapolate.files import open_sequence

    sequence = open_sequence(data / "czest1dm")
    method = jx.load(name)
    scores = [db(method(*arguments(method, w)), w.truth.color) for w in windows(sequence, [6, 8, 10, 12], past=3)]
    assert least < np.mean(scores) < least + 1
