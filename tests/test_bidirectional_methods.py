"""The methods "bidirectional", "bidirectional_image" and "bidirectional_guided" on a sequence of exact motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import SyntheticSequence, make_frame

import jaxtrapolate as jx
from jaxtrapolate.evaluation.windows import arguments, hide, windows
from jaxtrapolate.records import GBuffer, replace

NAMES = ("bidirectional", "bidirectional_image", "bidirectional_guided")


@pytest.fixture(scope="module")
def methods():
    return {name: jx.load(name) for name in (*NAMES, "blend", "warp")}


def window(number=3, *, size=(32, 48), fog=0.0, method):
    found = next(iter(windows(SyntheticSequence(size=size, fog=fog), [number], past=1, future=1)))
    return (*arguments(method, found), found.truth.color)


def db(image, truth):
    return -10 * np.log10(np.mean(np.square(np.asarray(image, np.float64) - np.asarray(truth, np.float64))))


@pytest.mark.slow
def test_better_than_its_inputs(methods):
    scores = {}
    for name, method in methods.items():
        history, target, future, truth = window(method=method)
        scores[name] = db(method(history, target, future), truth)
    assert scores["bidirectional_image"] > scores["blend"] + 3
    assert scores["bidirectional"] > max(scores["bidirectional_image"], scores["warp"])
    assert scores["bidirectional_guided"] > scores["warp"]


def test_the_inside_of_both_layers_is_exact(methods):
    """Light is nearly the same in both frames and albedo is the target's: away from silhouettes nothing is left."""
    method = methods["bidirectional"]
    history, target, future, truth = window(method=method)
    image = np.asarray(method(history, target, future))
    stencil = target.gbuffer.stencil[..., 0]
    inner = np.zeros(stencil.shape, bool)
    inner[4:-4, 4:-4] = True
    for shift in ((0, 3), (3, 0), (0, -3), (-3, 0)):
        inner &= np.roll(stencil, shift, (0, 1)) == stencil
    assert inner.sum() > 300
    np.testing.assert_allclose(image[inner], truth[inner], atol=4e-3)


@pytest.mark.parametrize("name", NAMES)
def test_a_rendered_target_is_returned(methods, name):
    history, target, future, truth = window(method=methods[name])
    rendered = replace(target, color=truth)
    np.testing.assert_array_equal(methods[name](history, rendered, future), truth)


@pytest.mark.slow
def test_the_target_is_not_looked_at_by_the_image_based_one(methods):
    method = methods["bidirectional_image"]
    history, target, future, _ = window(method=method)
    bare = replace(target, gbuffer=None)
    strange = replace(
        bare, gbuffer=replace(target.gbuffer, albedo=target.gbuffer.albedo * 0, depth=target.gbuffer.depth * 3)
    )
    image = method(history, bare, future)
    assert np.isfinite(image).all()
    np.testing.assert_array_equal(image, method(history, strange, future))


@pytest.mark.slow
def test_with_nothing_drawn_of_the_target_points_are_searched(methods):
    history, target, future, _ = window(method=methods["bidirectional"])
    to_previous = replace(future[0], motion=future[0].motion * 2)  # over both steps, as an engine at half rate writes
    bare = replace(target, gbuffer=None, motion=None)
    image = methods["bidirectional"](history, bare, (to_previous,))
    np.testing.assert_array_equal(image, methods["bidirectional_image"](history, bare, (to_previous,)))
    names = [stage.name for stage in methods["bidirectional"].active(history, bare, (to_previous,))]
    assert "search" in names
    assert "reproject to both" not in names
    with pytest.raises(ValueError, match="target"):
        methods["bidirectional_guided"](history, bare, (to_previous,))


def test_missing_input_is_named(methods):
    history, target, future, _ = window(method=methods["bidirectional"])
    with pytest.raises(ValueError, match=r"future\.color"):
        methods["bidirectional"](history, target, ())
    with pytest.raises(ValueError, match=r"future\.motion"):
        methods["bidirectional_image"](history, target, (replace(future[0], motion=None),))


@pytest.mark.slow
def test_without_albedo_colours_are_blended(methods):
    method = methods["bidirectional"]
    history, target, future, truth = window(method=method)
    strip = lambda frame: replace(frame, gbuffer=replace(frame.gbuffer, albedo=None))  # noqa: E731
    given = tuple(map(strip, history)), strip(target), tuple(map(strip, future))
    assert "relight" not in [stage.name for stage in method.active(*given)]
    assert 20 < db(method(*given), truth) < db(method(history, target, future), truth)


@pytest.mark.slow
def test_fog_does_not_print_a_texture(methods):
    """Where colour is not albedo times light the two frames agree better as they are."""
    method = methods["bidirectional"]
    history, target, future, truth = window(fog=0.8, method=method)
    strip = lambda frame: replace(frame, gbuffer=replace(frame.gbuffer, albedo=None))  # noqa: E731
    plain = method(tuple(map(strip, history)), strip(target), tuple(map(strip, future)))
    assert db(method(history, target, future), truth) > db(plain, truth) - 0.5


@pytest.mark.parametrize(
    "name", ["bidirectional", pytest.param("bidirectional_guided", marks=pytest.mark.slow), "bidirectional_image"]
)
def test_what_stands_still_stays_as_it_is(methods, name):
    frame = make_frame(0)
    still = jax.tree.map(jnp.asarray, replace(frame, motion=np.zeros_like(frame.motion)))
    frames = [replace(still, time=float(k)) for k in range(3)]
    image = methods[name]((frames[0],), hide(frames[1]), (frames[2],))
    if name == "bidirectional_guided":  # beside silhouettes the way to the next frame is not known: like pixels' mean
        np.testing.assert_allclose(image, frame.color, atol=1e-3)
    else:
        np.testing.assert_array_equal(image, frame.color)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 1), pytest.param((1, 7), marks=pytest.mark.slow), (13, 11)])
@pytest.mark.parametrize("name", ["bidirectional", *(pytest.param(n, marks=pytest.mark.slow) for n in NAMES[1:])])
def test_any_size(methods, name, size):
    history, target, future, truth = window(size=size, method=methods[name])
    image = methods[name](history, target, future)
    assert image.shape == truth.shape
    assert np.isfinite(image).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_finite(methods, name):
    method = methods[name]
    history, target, future, _ = window(size=(9, 12), method=method)

    def loss(color, motion):
        given = (*history[:-1], replace(history[-1], color=color)), replace(target, motion=motion)
        return jnp.sum(method.function(method.state, (), *given, future)[1])

    found = jax.grad(loss, argnums=(0, 1))(jnp.asarray(history[-1].color), jnp.asarray(target.motion))
    assert all(np.isfinite(g).all() for g in found)
    assert np.abs(found[0]).sum() > 0


@pytest.mark.slow
def test_buffers_of_one_frame_alone_do_not_break_it(methods):
    """A rendered frame without G-buffer: no depth test, no light; the target's motion still leads to both."""
    history, target, future, truth = window(method=methods["bidirectional"])
    bare = replace(future[0], gbuffer=GBuffer())
    image = methods["bidirectional"](history, target, (bare,))
    assert image.shape == truth.shape
    assert np.isfinite(image).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "numbers", "name", "least"),
    [
        ("czest1dm", [6, 8, 10], "bidirectional", 31.2),
        ("czest1dm", [6, 8, 10], "bidirectional_guided", 32.9),
        ("bunker", [3, 9, 15], "bidirectional_image", 28.9),
        ("bunker", [3, 9, 15], "bidirectional", 29.5),
    ],
)
def test_known_figures(data, folder, numbers, name, least):
    from jaxtrapolate.evaluation.score import causes_of, score
    from jaxtrapolate.files import open_sequence

    sequence, method = open_sequence(data / folder), jx.load(name)
    found = [
        score(method(*arguments(method, w)), w, causes_of(sequence, w), None, hdr=sequence.hdr).psnr
        for w in windows(sequence, numbers, past=1, future=1)
    ]
    assert np.mean(found) > least
