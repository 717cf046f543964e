"""ExtraNet as a method: what its network is shown, against loops from the facts; what is left out; its weights."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from flax import nnx
from synthetic import make_frame, make_keyframe

import jaxtrapolate as jx
from jaxtrapolate import weights
from jaxtrapolate.commands.inputs import open_methods
from jaxtrapolate.commands.main import main
from jaxtrapolate.evaluation import arguments, causes_of, hide, score, windows
from jaxtrapolate.files import write_unreal_frame
from jaxtrapolate.methods import extranet as module
from jaxtrapolate.methods.extranet import RELEASE, Preparation, extranet
from jaxtrapolate.networks.extranet import ExtraNet, ExtraNetConfig
from jaxtrapolate.records import replace
from jaxtrapolate.scenes import TEST_SEEDS, SceneSequence

SMALL = ExtraNetConfig(widths=(4, 6))
SIZE = (9, 13)
OURS = Preparation()


def make_window(size=SIZE, *, rendered=3, seed=0, sky=True):
    """Random buffers in centimetres: `rendered` frames with colour in turn with frames without, then the target."""
    height, width = size
    frames = []
    for time in range(2 * rendered):
        rng = np.random.default_rng((seed, time))

        def uniform(channels, low=0.0, high=1.0, rng=rng):
            return rng.uniform(low, high, (height, width, channels)).astype(np.float32)

        albedo = np.where(uniform(3) < 0.15, 0, uniform(3, 0.02)).astype(np.float32)
        infinite = (uniform(1) < 0.15).astype(np.float32) if sky else np.zeros((height, width, 1), np.float32)
        normal = np.float32([0.2, 0.1, 1]) + uniform(3, -0.3, 0.3)
        normal = np.where(infinite > 0.5, 0, normal / np.linalg.norm(normal, axis=-1, keepdims=True))
        buffers = jx.GBuffer(
            albedo=albedo,
            depth=np.where(infinite > 0.5, np.float32(3e6), uniform(1, 200, 5000)),
            normal=normal.astype(np.float32),
            position=uniform(3, 0, 40),
            roughness=uniform(1),
            metallic=uniform(1),
            specular=uniform(1),
            n_dot_v=uniform(1, -1),
            stencil=np.floor(uniform(1, 0, 2.2)),
            sky=infinite,
        )
        color, motion = uniform(3, -0.2, 4), oracles.random_motion(height, width, seed=seed + 10 * time)
        frames.append(jx.Frame(color=color, gbuffer=buffers, motion=motion, time=float(time)))
    *history, target = jax.device_put([frame if k % 2 == 0 else hide(frame) for k, frame in enumerate(frames)])
    return tuple(history), target


# The preparation in float64, one pixel after the other


def divisor(buffers, release):
    albedo = np.float64(buffers.albedo)
    if release:
        return albedo
    total = albedo + 0.08 * np.float64(buffers.specular) * (1 - np.float64(buffers.metallic))
    return np.where(buffers.sky > 0.5, 1.0, np.maximum(total, 1e-2))


def hole(target, source, r, c, x, y, inside, release):
    """Whether what is fetched shows something else, by the pixel nearest to the landing place."""
    if not inside:
        return True
    height, width, _ = target.depth.shape
    j, i = min(max(int(np.floor(y + 0.5)), 0), height - 1), min(max(int(np.floor(x + 0.5)), 0), width - 1)
    if target.stencil[r, c, 0] != source.stencil[j, i, 0]:
        return True
    if target.stencil[r, c, 0] != 0:
        a, b = np.float64(target.normal[r, c]), np.float64(source.normal[j, i])
        if not a.any() and not b.any():
            return False
        return a @ b < 0.98 * np.linalg.norm(a) * np.linalg.norm(b) if a.any() and b.any() else True
    if target.sky[r, c, 0] > 0.5 and source.sky[j, i, 0] > 0.5:
        return False
    apart = np.linalg.norm(np.float64(target.position[r, c]) - np.float64(source.position[j, i]))
    if release:
        facing = abs(float(target.n_dot_v[r, c, 0]))
        limit = 7.5 * facing + 45 * (1 - facing) + 0.005 * float(target.depth[r, c, 0])
    else:
        limit = 2 * footprint(target.position, r, c) + 1e-3 * float(target.depth[r, c, 0])
    return apart > limit


def footprint(position, r, c):
    steps = []
    for axis, place in ((0, r), (1, c)):
        size = position.shape[axis]
        near = [n for n in (place - 1, place + 1) if 0 <= n < size]
        others = [position[(n, c) if axis == 0 else (r, n)] for n in near]
        steps.append(min((np.linalg.norm(np.float64(o) - position[r, c]) for o in others), default=0.0))
    return max(steps)


def encode(image):
    return np.log1p(np.maximum(image, 0))


def expected_inputs(history, target, release):
    frames = [*history, target]
    rendered = [k for k in range(len(history) - 1, -1, -1) if history[k].color is not None]
    outside = "zero" if release else "edge"
    motion, place, warped, valid, first = None, len(history), [], [], None
    for source in rendered:
        for k in range(place, source, -1):
            own = np.float64(frames[k].motion)
            motion = own if motion is None else oracles.chain_motion(motion, own)
        place, buffers = source, frames[source].gbuffer
        below = divisor(buffers, release)
        layer = np.where(below > 0, np.float64(frames[source].color) / np.where(below > 0, below, 1), 0)
        inside = oracles.in_frame(motion)
        holes = np.array(
            [
                hole(target.gbuffer, buffers, r, c, x, y, inside[r, c], release)
                for r, c, x, y, _ in oracles.places(motion)
            ]
        ).reshape(*inside.shape, 1)
        warped.append(encode(oracles.backward_warp(layer, motion, outside=outside)))
        valid.append(1.0 - holes)
        if first is None:
            occluder = oracles.occlusion_motion(motion, np.float64(target.gbuffer.depth))
            composite = oracles.backward_warp(layer, np.where(holes, occluder, motion), outside=outside)
            first = np.concatenate([warped[0], encode(composite)], -1)
    normal = np.where(target.gbuffer.sky > 0.5, -1.0 if release else 0.0, np.float64(target.gbuffer.normal))
    depth = np.float64(target.gbuffer.depth)
    if release:
        scaled = np.where(depth * 1e-4 > 100, 0, depth * 1e-4)
        depth = (scaled - scaled.min()) / (scaled.max() - scaled.min() + 1e-6)
    else:
        solid = target.gbuffer.sky < 0.5
        mean = np.mean(1 / depth[solid]) if solid.any() else 1.0
        depth = np.where(solid, 1 / (1 + mean * depth), 0)
    while len(warped) < 3:
        warped.append(warped[-1])
        valid.append(valid[-1])
    return {
        "x": first,
        "mask": valid[0],
        "features": np.concatenate([normal, depth, target.gbuffer.roughness, target.gbuffer.metallic], -1),
        "history": np.stack([np.concatenate(pair, -1) for pair in zip(warped, valid, strict=True)][::-1]),
    }


def random_model(config):
    """A network with random weights; made from shapes alone, because an initialisation compiles layer by layer."""
    structure, state = nnx.split(nnx.eval_shape(lambda: ExtraNet(config, rngs=nnx.Rngs(0))))
    rng = np.random.default_rng(3)

    def values(path, leaf):
        low, high = (0.5, 1.5) if path[-1].key in ("var", "scale") else (-0.25, 0.25)
        return jnp.asarray(rng.uniform(low, high, leaf.shape), leaf.dtype)

    tree = jax.tree_util.tree_map_with_path(values, nnx.to_pure_dict(state))
    nnx.replace_by_pure_dict(state, tree)
    return nnx.merge(structure, state)


@pytest.fixture(scope="module")
def model():
    return random_model(SMALL)


@pytest.fixture(scope="module")
def methods(model):
    guided = dataclasses.replace(OURS, first_guess="guided")
    return {
        name: extranet(model, preparation=p) for name, p in (("ours", OURS), ("release", RELEASE), ("guided", guided))
    }


def image_of(method, history, target):
    """Stage by stage, so that little is compiled anew."""
    return np.asarray(method.function(method.state, (), history, target)[1])


def inputs(method, history, target):
    return method.values_before("network", method.state, (), history, target)["inputs"]


@pytest.mark.parametrize("name", ["ours", "release"])
@pytest.mark.parametrize("rendered", [1, 2, 3])
def test_the_network_is_shown_what_the_facts_say(methods, name, rendered):
    history, target = make_window(rendered=rendered)
    found = inputs(methods[name], history, target)
    expected = expected_inputs(history, target, name == "release")
    assert {k: v.shape for k, v in found.items()} == {k: v.shape for k, v in expected.items()}
    assert 0.1 < expected["mask"].mean() < 0.9
    for part, value in expected.items():
        np.testing.assert_allclose(found[part], value, rtol=2e-4, atol=2e-4, err_msg=part)


def test_the_release_of_one_pixel(methods):
    history, target = make_window((1, 1))
    for name in ("ours", "release"):
        expected = expected_inputs(history, target, name == "release")
        for part, value in inputs(methods[name], history, target).items():
            np.testing.assert_allclose(value, expected[part], rtol=2e-4, atol=2e-4, err_msg=part)


def test_the_answer_is_decoded_and_modulated(methods):
    history, target = make_window()
    for name in ("ours", "release"):
        method = methods[name]
        answer = np.float64(
            method.network(*(inputs(method, history, target)[k] for k in ("x", "mask", "features", "history")))
        )
        assert answer.shape == (*SIZE, 3)
        expected = np.maximum(np.expm1(answer), 0) * divisor(target.gbuffer, name == "release")
        solid = target.gbuffer.sky[..., 0] < 0.5
        assert expected[solid].max() > 0.1
        np.testing.assert_allclose(image_of(method, history, target)[solid], expected[solid], rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("preparation", [OURS, RELEASE], ids=["ours", "release"])
def test_the_truth_is_encoded_as_the_answer_is_decoded(preparation):
    history, _ = make_window()
    color, buffers = jnp.abs(history[-1].color), history[-1].gbuffer
    found = np.float64(module.encoded_truth(color, buffers, preparation=preparation))
    below = divisor(buffers, preparation is RELEASE)
    np.testing.assert_allclose(np.expm1(found) * below, np.where(below > 0, color, 0), rtol=2e-5, atol=1e-5)
    plain = module.encoded_truth(color, replace(buffers, albedo=None), preparation=preparation)
    np.testing.assert_allclose(plain, np.log1p(color), rtol=1e-6)


def test_the_sky_is_the_engines_or_the_warped_one(methods):
    history, target = make_window()
    sky = target.gbuffer.sky[..., 0] > 0.5
    assert 0.05 < sky.mean() < 0.5
    method = methods["release"]
    motion = np.float64(target.motion)
    occluder = oracles.occlusion_motion(motion, np.float64(target.gbuffer.depth))
    holes = expected_inputs(history, target, True)["mask"] < 0.5
    plain = oracles.backward_warp(history[-1].color, np.where(holes, occluder, motion))
    np.testing.assert_allclose(image_of(method, history, target)[sky], plain[sky], rtol=1e-4, atol=1e-4)
    color = jnp.full((*SIZE, 3), 7.0)
    drawn = replace(target, gbuffer=replace(target.gbuffer, sky_color=color))
    assert (image_of(method, history, drawn)[sky] == 7).all()


def test_the_guided_guess_is_the_guided_warp(methods):
    history, target = make_window()
    found, plain = inputs(methods["guided"], history, target), inputs(methods["ours"], history, target)
    for part in ("mask", "features", "history"):
        assert np.array_equal(found[part], plain[part])
    assert np.array_equal(found["x"][..., 3:], plain["x"][..., 3:])
    newest = history[-1]
    guides = [np.concatenate([f.gbuffer.albedo, f.gbuffer.normal], -1) for f in (target, newest)]
    layer = np.float64(newest.color) / divisor(newest.gbuffer, False)
    expected, gap = oracles.guided_warp(layer, target.motion, *guides)
    clear = gap > 1e-4  # else two taps are as good as tied
    assert clear.mean() > 0.95
    np.testing.assert_allclose(np.asarray(found["x"])[clear][:, :3], encode(expected)[clear], rtol=1e-3, atol=1e-3)
    assert not np.allclose(found["x"][..., :3], plain["x"][..., :3], atol=0.1)


MISSING = {
    "albedo": ({"demodulate", "modulate"}, None),
    "depth": ({"occlusion motion"}, 3),
    "normal": (set(), (0, 1, 2)),
    "roughness": (set(), 4),
    "metallic": (set(), 5),
    "sky": ({"warped sky", "sky"}, None),
    "stencil": (set(), None),
    "position": (set(), None),
}


def without(frames, *names):
    return tuple(replace(f, gbuffer=replace(f.gbuffer, **dict.fromkeys(names))) for f in frames)


@pytest.mark.parametrize("name", sorted(MISSING))
def test_what_a_scene_lacks_is_left_out(methods, name):
    history, target = make_window()
    *bare, goal = without((*history, target), name)
    method = methods["ours"]
    stages, channel = MISSING[name]
    everything = {s.name for s in method.active(history, target)}
    assert everything - {s.name for s in method.active(tuple(bare), goal)} == stages - {"sky"}
    found = inputs(method, tuple(bare), goal)
    if channel is not None:
        assert (np.asarray(found["features"])[..., channel] == 0).all()
    if name == "depth":
        assert np.array_equal(found["x"][..., :3], found["x"][..., 3:])
    if name == "albedo":
        first = encode(oracles.backward_warp(history[-1].color, target.motion))
        np.testing.assert_allclose(found["x"][..., :3], first, atol=1e-5)
    assert all(np.isfinite(v).all() for v in found.values())


def test_colour_and_motion_are_enough(methods):
    history, target = make_window()
    bare = [replace(f, gbuffer=None) for f in (*history, target)]
    for method in methods.values():
        found = inputs(method, tuple(bare[:-1]), bare[-1])
        assert (np.asarray(found["features"]) == 0).all()
        assert np.array_equal(found["mask"][..., 0], jx.in_frame(jnp.asarray(target.motion)))
        assert np.isfinite(image_of(method, tuple(bare[:-1]), bare[-1])).all()


def test_history_reaches_as_far_back_as_motion(methods):
    """Without the vectors of a frame between, what lies behind it cannot be warped: the frame before is repeated."""
    history, target = make_window()
    cut = tuple(replace(f, motion=None) if k == 2 else f for k, f in enumerate(history))
    found = inputs(methods["ours"], cut, target)
    expected = inputs(methods["ours"], history[2:], target)
    assert np.array_equal(found["history"], expected["history"])
    assert np.array_equal(found["history"][0], found["history"][1])
    with pytest.raises(ValueError, match=r"missing target\.motion"):
        methods["ours"](history, replace(target, motion=None))


def test_pixels_that_are_not_finite_reach_no_network(methods):
    history, target = make_window()
    color = history[-1].color.at[3, 4].set(jnp.nan).at[5, 6].set(jnp.inf)
    for method in methods.values():
        image = image_of(method, (*history[:-1], replace(history[-1], color=color)), target)
        solid = target.gbuffer.sky[..., 0] < 0.5
        assert np.isfinite(image[solid]).all()


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (14, 5)])
def test_any_size(methods, size):
    history, target = make_window(size)
    image = image_of(methods["release"], history, target)
    assert image.shape == (*size, 3)
    assert np.isfinite(image).all()


def test_a_window_of_nothing_but_sky(methods):
    history, target = make_window()
    frames = [replace(f, gbuffer=replace(f.gbuffer, sky=jnp.ones((*SIZE, 1)))) for f in (*history, target)]
    for method in methods.values():
        assert np.isfinite(image_of(method, tuple(frames[:-1]), frames[-1])).all()


@pytest.mark.slow
def test_eager_is_jit_is_vmap(methods):
    windows = [make_window(seed=s) for s in (0, 1)]
    batch = jax.tree.map(lambda *a: jnp.stack([jnp.asarray(x) for x in a]), *windows)
    method = methods["ours"]
    images = jax.jit(jax.vmap(lambda h, t: method.function(method.state, (), h, t)[1]))(*batch)
    prepared = jax.jit(jax.vmap(lambda h, t: inputs(method, h, t)))(*batch)
    for k, (history, target) in enumerate(windows):
        jitted = method(history, target)
        np.testing.assert_allclose(jitted, image_of(method, history, target), rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(images[k], jitted, rtol=1e-4, atol=1e-4)
        one = inputs(method, history, target)
        for part, value in one.items():
            np.testing.assert_allclose(prepared[part][k], value, rtol=1e-4, atol=1e-4, err_msg=part)


@pytest.mark.slow
def test_gradients(methods):
    """To weights, colour and motion: finite, in holes and outside too, and not 0."""
    method, (history, target) = methods["release"], make_window()

    def loss(state, color, motion):
        frames = (*history[:-1], replace(history[-1], color=color))
        return jnp.mean(jnp.square(method.function(state, (), frames, replace(target, motion=motion))[1]))

    given = method.state, jnp.asarray(history[-1].color), jnp.asarray(target.motion)
    gradients = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(*given)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradients[1:]))
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(gradients[0])) > 0


def test_relative_depth():
    depth = oracles.random(*SIZE, 1, low=1, high=50)
    sky = (oracles.random(*SIZE, 1, seed=4) < 0.2).astype(np.float32)
    found = np.asarray(module.relative_depth(jnp.asarray(depth), jnp.asarray(sky)))
    assert (found[sky > 0.5] == 0).all()
    assert ((found > 0) == (sky < 0.5)).all()
    np.testing.assert_allclose(module.relative_depth(jnp.asarray(1e4 * depth), jnp.asarray(sky)), found, rtol=1e-5)
    order = np.argsort(depth[sky < 0.5])
    assert (np.diff(found[sky < 0.5][order]) <= 0).all()
    flat = jnp.full((3, 4, 1), 7.0)
    np.testing.assert_allclose(module.relative_depth(flat, None), 0.5, rtol=1e-6)
    bad = jnp.asarray([[[0.0], [jnp.inf], [jnp.nan], [-1.0]]])
    assert (np.asarray(module.relative_depth(bad, None)) == 0).all()
    gradient = jax.grad(lambda d: jnp.sum(module.relative_depth(d, None)[0, :1]))(
        bad.at[0, 0].set(2.0).at[0, 1].set(3.0)
    )
    assert np.isfinite(gradient).all()


def test_ablations_of_the_paper_are_shown_less():
    """Without the occlusion composite, the features or the histories (Table 7)."""
    history, target = make_window()
    config = ExtraNetConfig(widths=(4, 4), warps=1, features=0, histories=0)
    method = extranet(random_model(config))
    found = inputs(method, history, target)
    assert found["x"].shape == (*SIZE, 3)
    assert found["features"] is None
    assert found["history"] is None
    assert method.past == 1
    assert np.isfinite(image_of(method, history, target)).all()
    for wrong in ({"features": 3}, {"warps": 3}):
        with pytest.raises(ValueError, match="expected 6 features or none"):
            extranet(random_model(ExtraNetConfig(widths=(4, 4), **wrong)))


def test_preparations_are_checked():
    for wrong, message in (
        ({"first_guess": "flow"}, "first_guess: expected one of 'warp', 'guided', got 'flow'"),
        ({"by": "light"}, "by: expected one of"),
        ({"outside": 0}, "outside: expected one of"),
        ({"taps": "all"}, "taps: expected one of"),
        ({"depth": "log"}, "depth: expected one of"),
        ({"floor": -1.0}, "floor: expected 0 or more"),
    ):
        with pytest.raises(ValueError, match=message):
            Preparation(**wrong)


# The mechanism


def test_methods_without_networks_say_so():
    with pytest.raises(ValueError, match="method 'warp': expected one network, it has none"):
        _ = jx.load("warp").network


def test_stages_before_are_named(methods):
    history, target = make_window()
    with pytest.raises(ValueError, match="expected one of the stages reproject, occlusion motion, holes"):
        methods["ours"].values_before("networks", methods["ours"].state, (), history, target)


@pytest.mark.parametrize("rendered", [1, 3])
def test_what_stands_still_is_returned(model, rendered):
    """Three equal rendered frames and no motion: the newest, exactly; of one alone nothing is known."""
    history, target = make_window(rendered=rendered)
    first = history[0]
    motion = jnp.zeros_like(target.motion)
    still = tuple(replace(first, motion=motion, color=None if f.color is None else first.color) for f in history)
    image = extranet(model)(still, replace(target, gbuffer=first.gbuffer, motion=motion))
    known = np.maximum(np.asarray(first.color), 0)
    if rendered == 3:
        np.testing.assert_allclose(image, first.color, rtol=1e-5, atol=1e-6)
    else:
        assert np.abs(np.asarray(image) - known).max() > 1e-3


# Weights


def test_default_weights_are_of_the_public_layout():
    """The bare network takes x, mask, features and history as the authors' does; a file tells what it is."""
    method = jx.load("extranet")
    x, mask, features, history = (
        jnp.asarray(oracles.random(*shape, seed=k))
        for k, shape in enumerate(((9, 13, 6), (9, 13, 1), (9, 13, 6), (3, 9, 13, 4)))
    )
    answer = method.network(x, mask, features, history)
    assert answer.shape == (9, 13, 3)
    assert np.isfinite(answer).all()
    path = weights.default_weights("extranet")
    assert path.stat().st_size <= weights.files.LARGEST
    assert len(weights.load_weights(path).note) > 20


@pytest.mark.slow
@pytest.mark.parametrize("name", ["walkers", "interior", "terrain"])
def test_default_weights_are_ahead_of_their_inputs(name):
    """On test seeds, by at least a decibel over the warp and the occlusion composite, and ahead of the guided warp."""
    sequence = SceneSequence(name, TEST_SEEDS[1], frames=10, size=(90, 160))
    methods = {m: jx.load(m) for m in ("occlusion_warp", "guided_warp", "extranet")}
    decibels = {m: [] for m in methods}
    for window in windows(sequence, [7, 9], past=3):
        causes = causes_of(sequence, window)
        for m, method in methods.items():
            image = method(*arguments(method, window))
            decibels[m].append(score(image, window, causes, None, hdr=True)["psnr"])
    mean = {m: np.mean(values) for m, values in decibels.items()}
    assert mean["extranet"] > mean["occlusion_warp"] + 1
    assert mean["extranet"] > mean["guided_warp"]


@pytest.fixture(scope="module")
def saved(model, tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    preparation = dataclasses.replace(RELEASE, first_guess="guided")
    config = module.extranet_config(model.config, preparation)
    return weights.save_weights(folder, "extranet", nnx.to_pure_dict(nnx.state(model)), config=config, note="random")


def test_weights_state_their_preparation(model, saved):
    history, target = make_window()
    method = jx.load("extranet", weights=saved)
    expected = extranet(model, preparation=dataclasses.replace(RELEASE, first_guess="guided"))
    assert np.array_equal(image_of(method, history, target), image_of(expected, history, target))
    stated = weights.load_weights(saved).config
    assert stated["network"]["widths"] == [4, 6]
    assert stated["preparation"] == json.loads(json.dumps(dataclasses.asdict(expected_preparation())))


def expected_preparation():
    return dataclasses.replace(RELEASE, first_guess="guided")


def test_default_weights_are_loaded_where_they_are_shipped(saved, monkeypatch):
    from jaxtrapolate.weights import files

    monkeypatch.setattr(files, "_SHIPPED", saved.parent)
    assert jx.load("extranet").past == 3


def test_orbax_checkpoints_are_loaded(model, tmp_path):
    import orbax.checkpoint as ocp

    config = module.extranet_config(model.config, OURS)
    metadata = {"method": "extranet", "config": json.loads(json.dumps(config)), "note": ""}
    with ocp.CheckpointManager(tmp_path / "work") as manager:
        items = {"weights": ocp.args.StandardSave(nnx.to_pure_dict(nnx.state(model)))}
        manager.save(7, args=ocp.args.Composite(metadata=ocp.args.JsonSave(metadata), **items))
        manager.wait_until_finished()
    history, target = make_window()
    image = image_of(jx.load("extranet", weights=tmp_path / "work"), history, target)
    assert np.array_equal(image, image_of(extranet(model, preparation=OURS), history, target))


def test_weights_that_do_not_fit_are_refused(model, saved, tmp_path):
    given = weights.load_weights(saved)
    config = dict(given.config)

    def refused(message, tree=given.tree, method="extranet", **changes):
        path = weights.save_weights(tmp_path, method, tree, config={**config, **changes}, note="")
        with pytest.raises(ValueError, match=message) as caught:
            jx.load("extranet", weights=path)
        assert "\n" not in str(caught.value)
        assert str(caught.value).startswith(str(path))

    refused("weights of method 'patchex', expected 'extranet'", method="patchex")
    refused(r"do not fit: decoder/0/layers/0/feature/bias is \[8\], expected \[9\]", network={"widths": [6, 6]})
    refused("missing merge/feature/bias", tree={k: v for k, v in given.tree.items() if k != "merge"})
    refused("ExtraNetConfig has no depth", network={"depth": 4})
    refused("Preparation: by: expected one of", preparation={"by": "colour"})
    path = tmp_path / "a.pth.tar"
    path.write_bytes(b"hello")
    with pytest.raises(ValueError, match="not a PyTorch checkpoint"):
        jx.load("extranet", weights=path)


# The command line


@pytest.fixture(scope="module")
def dump(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dump")
    for time in range(9):
        write_unreal_frame(folder, "Wall", time, make_frame(time), keyframe=make_keyframe(time))
    return folder


def run(capsys, *arguments):
    code = main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return code, out, err


def test_commands_without_weights_say_so(capsys, dump, tmp_path, monkeypatch):
    monkeypatch.setattr(weights.files, "_SHIPPED", tmp_path)
    reason = "no default weights come with this version"
    code, out, _ = run(capsys, "check", dump)
    assert code == 0
    (row,) = [line for line in out.splitlines() if "extranet" in line]
    assert " no " in row
    assert reason in " ".join(out.replace("│", " ").split())
    code, _, err = run(capsys, "evaluate", dump, "--methods", "extranet", "--output", tmp_path / "a")
    assert (code, err.count("\n")) == (2, 1)
    assert reason in err
    arguments = ("--output", tmp_path / "b", "--frames", "5", "--pictures", 0)
    code, out, _ = run(capsys, "evaluate", dump, "--methods", "repeat,extranet", *arguments)
    assert code == 0
    assert f"extranet: left out: method 'extranet': {reason}" in out
    results = json.loads((tmp_path / "b" / "results.json").read_text())
    assert list(results["methods"]) == ["repeat"]
    assert reason in results["skipped"]["extranet"]
    code, _, err = run(capsys, "generate", dump, "--method", "extranet", "--output", tmp_path / "c")
    assert (code, err.count("\n")) == (2, 1)
    assert reason in err


@pytest.mark.slow
def test_commands_take_weights(capsys, dump, saved, tmp_path):
    arguments = ("--methods", "repeat,extranet", "--output", tmp_path / "a", "--frames", "5,7", "--pictures", 0)
    code, _, _ = run(capsys, "evaluate", dump, *arguments, "--weights", f"extranet={saved}")
    assert code == 0
    results = json.loads((tmp_path / "a" / "results.json").read_text())
    assert set(results["methods"]) == {"repeat", "extranet"}
    assert set(results["settings"]["weights"]) == {"extranet"}
    assert "network" in results["methods"]["extranet"]["stages"]
    folder = tmp_path / "made"
    code, _, err = run(
        capsys, "generate", dump, "--method", "extranet", "--weights", f"extranet={saved}", "--output", folder
    )
    assert code == 0, err
    assert list(folder.glob("*.exr"))


def test_weights_are_opened_by_name(saved):
    found, unavailable = open_methods("extranet, repeat", weights=[f"extranet={saved}"])
    assert list(found) == ["extranet", "repeat"]
    assert unavailable == {}
    assert weights.fingerprint(found["extranet"].state) == weights.fingerprint(jx.load("extranet", weights=saved).state)


def test_weights_that_cannot_be_used_end_in_one_line(capsys, dump, saved, tmp_path):
    other = tmp_path / "extranet-00000000.npz"
    other.write_bytes(saved.read_bytes())
    for methods, given, message in (
        ("extranet", "extranet", "expected NAME=FILE"),
        ("extranet", "extrenat=a.npz", "expected NAME=FILE"),
        ("extranet", f"extranet={tmp_path / 'none-12345678.npz'}", "does not exist"),
        ("extranet", f"extranet={other}", "damaged or changed"),
        ("extranet", f"extranet={tmp_path}", "no Orbax checkpoint"),
        ("repeat", f"extranet={saved}", "extranet is not among the methods of --methods"),
        ("repeat", f"repeat={saved}", "method 'repeat' has none"),
    ):
        code, _, err = run(
            capsys, "evaluate", dump, "--methods", methods, "--weights", given, "--output", tmp_path / "a"
        )
        assert (code, err.count("\n")) == (2, 1), err
        assert message in err


def test_import_weights(capsys, saved, tmp_path):
    """Of what `load` takes; the same weights give the same file."""
    code, out, _ = run(capsys, "import-weights", saved, "--output", tmp_path / "mine.npz")
    assert code == 0
    (path,) = tmp_path.glob("mine-*.npz")
    assert str(path) in out
    before, found = weights.load_weights(saved), weights.load_weights(path)
    assert weights.fingerprint(found.tree) == weights.fingerprint(before.tree)
    assert found.config == before.config
    assert found.note == f"imported from {saved.name}"
    for given, message in (
        ((tmp_path / "none.pth.tar",), "does not exist"),
        ((saved, "--output", tmp_path / "a.tar"), "ends in .npz"),
        ((saved, "--output", tmp_path / "none" / "a.npz"), "its folder does not exist"),
    ):
        code, _, err = run(capsys, "import-weights", *given)
        assert (code, err.count("\n")) == (2, 1)
        assert message in err


# The authors' weights


@pytest.fixture(scope="module")
def official(data):
    return data / "extranet_medieval.pth.tar"


@pytest.mark.slow
def test_the_authors_network_gives_the_authors_answers(official, data):
    method = jx.load("extranet", weights=official)
    with np.load(data / "extranet_vectors.npz") as vectors:
        for k in (0, 1):
            given = (jnp.asarray(vectors[f"{k}_{name}"]) for name in ("x", "mask", "features", "history"))
            np.testing.assert_allclose(method.network(*given), vectors[f"{k}_output"], atol=1e-5)


@pytest.mark.slow
def test_imported_weights_are_the_authors(capsys, official, tmp_path):
    code, _, _ = run(capsys, "import-weights", official, "--output", tmp_path / "medieval.npz")
    assert code == 0
    (path,) = tmp_path.glob("medieval-*.npz")
    assert path.stat().st_size < 1_150_000
    history, target = make_window()
    images = [jx.load("extranet", weights=p)(history, target) for p in (official, path)]
    np.testing.assert_allclose(*images, rtol=1e-5)


@pytest.mark.slow
def test_known_figures_of_a_path_traced_clip(official, data):
    """The authors' weights, trained on another scene: 28.7 dB, 19.4 in exact disocclusion."""
    from jaxtrapolate.causes import disoccluded
    from jaxtrapolate.evaluation import arguments, windows
    from jaxtrapolate.files import open_sequence

    sequence, method = open_sequence(data / "czest1dm"), jx.load("extranet", weights=official)
    whole, holes = [], []
    for window in windows(sequence, [6, 8, 10, 12], past=3):
        made, truth = (jx.tonemap(jnp.asarray(a)) for a in (method(*arguments(method, window)), window.truth.color))
        pair = (replace(sequence.keyframe(n), color=None) for n in (window.number, window.number - 1))
        hidden = jnp.reshape(disoccluded(*pair), (*truth.shape[:2], 1))
        whole.append(float(jx.psnr(made, truth)))
        holes.append(float(jx.psnr(made, truth, mask=hidden)))
    assert 28.7 < np.mean(whole) < 28.9
    assert 19.4 < np.mean(holes) < 19.8
