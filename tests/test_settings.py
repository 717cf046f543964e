"""JAX's settings of dtypes, as a user's process may have them: 64-bit types, strict promotion of dtypes and ranks.

Traced only, all at once: nothing is promoted then, so that the dtypes are those of each setting alone as well. What is
computed under them has to be what is computed without, in a process that is started with them too.
"""

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_extranet
import synthetic
import test_api
from marks import slow
from toy_task import ToyOptions, ToyTask

import jaxtrapolate as jx
from jaxtrapolate import scenes
from jaxtrapolate.bidirectional import search
from jaxtrapolate.commands.main import main
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.files import write_unreal_frame
from jaxtrapolate.methods.extranet import extranet
from jaxtrapolate.methods.guided_net import guided_net
from jaxtrapolate.methods.interpolator import interpolator
from jaxtrapolate.metrics import image as metrics
from jaxtrapolate.networks import Interpolator, InterpolatorConfig
from jaxtrapolate.networks.extranet import ExtraNetConfig
from jaxtrapolate.ops import causes, fill, grid, guided, holes, radiance
from jaxtrapolate.precision import widest
from jaxtrapolate.records import replace
from jaxtrapolate.scenes.scene import Builder, material, path
from jaxtrapolate.scenes.shading import lamp_levels
from jaxtrapolate.scenes.worlds import common
from jaxtrapolate.training import Config, Optimizer, extrass_losses, losses
from jaxtrapolate.training.step import make_step
from jaxtrapolate.training.tasks import round_key

TESTS = Path(__file__).parent


@contextlib.contextmanager
def all_settings():
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield


def equations(jaxpr):
    """All equations of a jaxpr and of those within."""
    for equation in jaxpr.eqns:
        yield equation
        for value in equation.params.values():
            for part in value if isinstance(value, (tuple, list)) else (value,):
                inner = getattr(part, "jaxpr", part)
                if hasattr(inner, "eqns"):
                    yield from equations(inner)


def kinds(function, *arguments):
    """The dtypes of a function's results under all settings; raises where something is computed in float64.

    Numbers of Python are "weak": they take the dtype of the array that they meet.
    """
    with all_settings():
        traced = jax.make_jaxpr(function)(*arguments)
    given = {leaf.dtype for leaf in jax.tree.leaves(arguments) if hasattr(leaf, "dtype")}
    if np.dtype(np.float64) not in given:
        for equation in equations(traced.jaxpr):
            for out in equation.outvars:
                assert getattr(out.aval, "dtype", None) != np.float64 or out.aval.weak_type, str(equation)[:300]
    return {str(aval.dtype) for aval in traced.out_avals} - {"bool"}


def in_dtype(tree, dtype):
    """Every array of a tree in a dtype; numbers stay numbers."""
    return jax.tree.map(lambda a: np.asarray(a).astype(dtype) if np.ndim(a) else a, tree)


# What the list of `test_api` leaves out.

SIZE = (12, 14)
frames = [synthetic.make_frame(k, SIZE) for k in range(2)]
keyframes = [replace(synthetic.make_keyframe(k, SIZE), time=None) for k in range(3)]
image, motion, buffers = frames[0].color, frames[0].motion, frames[0].gbuffer
depth, stencil = buffers.depth, buffers.stencil
gray = image[..., :1]
eye = np.eye(4, dtype=np.float32)
moved = np.stack([eye] * 2)


def both_flows(first, second, **options):
    return jx.complete_flows(replace(first, backward_flow=None), replace(second, backward_flow=None), **options)


def seen_by(position, matrix, objects, ids, *, function):
    camera = jx.Camera(matrix, matrix)
    return function(position, camera, camera, object_motion=objects, stencil=ids)


MORE = {
    "in_frame": (jx.in_frame, motion),
    "camera_motion-objects": (
        lambda *a: seen_by(*a, function=jx.camera_motion),
        *(buffers.position, eye, moved, stencil),
    ),
    "camera_flow-objects": (lambda *a: seen_by(*a, function=jx.camera_flow), buffers.position, eye, moved, stencil),
    "complete_flows": (both_flows, *keyframes[:2]),
    "complete_flows-flat": (
        lambda a, b: both_flows(replace(a, forward_flow=a.forward_flow[..., :2]), b),
        *keyframes[:2],
    ),
    "forecast": (lambda f: jx.forecast(f, 0.5), frames[0]),
    "cause_map": (lambda a, b: jx.cause_map(a, b, a.motion), frames[1], frames[0]),
    "edges": (lambda g: causes.edges(g, metric_depth=True), buffers),
    "disoccluded": (jx.disoccluded, keyframes[1], keyframes[0]),
    "hole_masks": (jx.hole_masks, frames[1].gbuffer, buffers, motion),
    "hole_masks-release": (
        lambda a, b, m: jx.hole_masks(a, b, m, taps="release", softness=0.3, position_threshold=(7.5, 45.0, 0.005)),
        *(frames[1].gbuffer, buffers, motion),
    ),
    "hole_masks-soft": (
        lambda a, b, m: jx.hole_masks(a, b, m, taps="weighted", softness=0.3),
        *(frames[1].gbuffer, buffers, motion),
    ),
    "dual_start": (lambda f: jx.dual_start(f, 0.4), keyframes[0].forward_flow),
    "latest_start": (lambda o, d: jx.latest_start(o, 0.4, depth=d), motion, depth),
    "iterative_search-newton": (
        lambda f, s: jx.iterative_search(f, 0.4, start=s, solver="newton", filter="bilinear"),
        *(keyframes[0].forward_flow, motion),
    ),
    "interpolate_bidirectional-ids": (
        lambda a, b, t: jx.interpolate_bidirectional(a, b, 0.4, target=t, stencil_ids=(1,)),
        *(keyframes[0], keyframes[2], keyframes[1]),
    ),
    "interpolate_image_based": (lambda a, b: jx.interpolate_image_based(a, b, 0.4), *keyframes[:2]),
    "interpolate_run": (lambda a, b: jx.interpolate_run(a, b, factor=3), *keyframes[:2]),
    "motion_blur": (lambda a, b, c: jx.motion_blur(a, b, c, samples=1), *keyframes),
    "overlay": (
        lambda a, b, c, d: jx.overlay(jx.interpolate_assisted(a, b, b, 0.4), c, d, d[..., 0] > 5),
        *(*keyframes[:2], image, depth),
    ),
    "farneback_flow": (jx.farneback_flow, gray, gray[::-1]),
    "dis_flow": (jx.dis_flow, gray, gray[::-1]),
    "shading_flow": (lambda a, b, g: jx.shading_flow(a, b, guide=g, round_trip=1.0), image, image[::-1], image),
    "fill_pyramid": (lambda i: fill.fill_pyramid(i, i[..., 0] > 0.5), image),
    "fill_around": (lambda i, d: fill.fill_around(i, i[..., 0] > 0.5, depth=d), image, depth),
    "grid_warp": (lambda i, f, d: grid.grid_warp(i, f, d, 0.5), image, motion, depth),
    "far_motion": (lambda m, t, s: guided.far_motion(m, t, s, m[..., :1] > 0, step=2), motion, image, image),
    "guided_warp-packed": (
        lambda i, m, t: jx.guided_warp(i, m, t, t, strides=(1,), keep=1, guides="packed"),
        *(image, motion, image),
    ),
    "demodulate-all": (radiance.demodulate, image, buffers),
    "demodulation_divisor-none": (lambda g: radiance.demodulation_divisor(g, by="none"), buffers),
    "psnr-mask": (lambda a, b, m: metrics.psnr(a, b, mask=m > 0), image, image, stencil),
    "ssim-mask": (lambda a, b, m: metrics.ssim(a, b, mask=m > 0), image, image, stencil),
    "l1_loss": (losses.l1_loss, image, image),
    "charbonnier_loss": (losses.charbonnier_loss, image, image),
    "extranet_loss": (jax.grad(lambda *a: losses.extranet_loss(*a)[0]), image, image, stencil),
    "extranet_loss-paper": (lambda *a: losses.extranet_loss(*a, shade="paper"), image, image, stencil),
    "relative_loss": (losses.relative_loss, image, image, image),
    "census_loss": (lambda a, b: extrass_losses.census_loss(a, b, size=3), image, image),
    "feature_census_loss": (lambda a, b: extrass_losses.feature_census_loss([a], [b]), image, image[::-1]),
    "feature_difference_loss": (lambda a, b: extrass_losses.feature_difference_loss([a], [b]), image, image[::-1]),
    "slope_loss": (extrass_losses.slope_loss, image, image),
    "temporal_loss": (extrass_losses.temporal_loss, image, image, stencil),
    "splat_nearest-one": (lambda v, m, d: jx.splat_nearest(v, m, d, footprint=1), image, motion, depth),
    "backward_warp-zero": (lambda i, m: jx.backward_warp(i, m, outside="zero"), image, motion),
}

ALL = test_api.OPERATIONS | MORE
HALF = sorted(set(ALL) - {"hole_masks", "extranet_loss"})  # what closes over float32, and what sums up a gradient


def test_the_list_has_every_public_function():
    names = {name.split("-")[0] for name in ALL} | {
        "load",
        "open_sequence",
        "evaluate",
        "method_names",
        "keep_memory",
        "replace",
    }
    assert {name for name in test_api.FUNCTIONS if "." not in name} <= names
    for module in (radiance, metrics, losses, extrass_losses, fill):
        public = {n for n, v in vars(module).items() if callable(v) and getattr(v, "__module__", "") == module.__name__}
        named = {
            "check_mask",
            "check_pair",
            "counted",
            "covered_around",
            "extranet_loss",
            "hole_loss",
            "perceptual_loss",
            "shading_loss",
            "ssim_map",
            "Metric",
            "metric_names",
        }
        assert {n for n in public if not n.startswith("_")} <= names | named


@pytest.mark.parametrize("name", sorted(ALL))
def test_float32_stays_float32(unchecked, name):
    function, *arguments = ALL[name]
    assert kinds(function, *arguments) <= {"float32", "int32"}


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "bfloat16", "float16"])
@pytest.mark.parametrize("name", HALF)
def test_other_precisions_are_what_they_are_without(unchecked, name, dtype):
    """Half precision gives what it gives by default, float64 gives float64."""
    function, *arguments = ALL[name]
    arguments = in_dtype(arguments, jnp.dtype(dtype))
    expected = {"float64", "int32"}
    if dtype != "float64":
        results = jax.tree.leaves(jax.eval_shape(function, *arguments))
        expected = {str(leaf.dtype) for leaf in results}
    assert kinds(function, *arguments) <= expected


STRONG = np.float64(0.4)
"""A float to Python, and not a number of Python to JAX."""

NUMBERS = {
    "backward_warp": lambda: jx.backward_warp(image, motion, outside=STRONG),
    "guided_warp": lambda: jx.guided_warp(
        image, motion, image, image, strides=(1,), keep=1, sigma_guide=STRONG, sigma_space=STRONG
    ),
    "far_motion": lambda: guided.far_motion(motion, image, image, stencil > 0, step=2, unlike=STRONG),
    "demodulate": lambda: radiance.demodulate(image, buffers, floor=STRONG),
    "tonemap": lambda: radiance.tonemap(image, gamma=STRONG),
    "shading_flow": lambda: jx.shading_flow(
        *(image, image), sigma_guide=STRONG, least_gain=STRONG, least_change=STRONG, round_trip=STRONG
    ),
    "psnr": lambda: metrics.psnr(image, image, peak=STRONG),
    "ssim": lambda: metrics.ssim(image, image, peak=STRONG),
    "hole_masks": lambda: holes.hole_masks(
        *(frames[1].gbuffer, buffers, motion), softness=STRONG, position_threshold=STRONG, normal_threshold=STRONG
    ),
    "hole_masks-release": lambda: holes.hole_masks(
        *(frames[1].gbuffer, buffers, motion), softness=STRONG, taps="release", position_threshold=(STRONG,) * 3
    ),
    "forecast": lambda: jx.forecast(frames[0], STRONG),
    "iterative_search": lambda: jx.iterative_search(keyframes[0].forward_flow, STRONG),
    "latest_start": lambda: jx.latest_start(motion, STRONG, depth=depth),
    "interpolate_bidirectional": lambda: jx.interpolate_bidirectional(
        *keyframes[:2],
        STRONG,
        search=jx.SearchOptions(epsilon=STRONG),
        visibility=jx.VisibilityOptions(epsilon_depth=STRONG, epsilon_trip=STRONG),
    ),
    "interpolate_assisted": lambda: jx.interpolate_assisted(
        keyframes[0], keyframes[2], keyframes[1], STRONG, epsilon_depth=STRONG
    ),
    "motion_blur": lambda: jx.motion_blur(*keyframes, samples=1, shutter=STRONG),
    "grid_warp": lambda: grid.grid_warp(image, motion, depth, STRONG, tear=STRONG),
    "extranet_loss": lambda: losses.extranet_loss(
        image, image, stencil, hole_weight=STRONG, shade_weight=STRONG, fraction=STRONG
    ),
    "relative_loss": lambda: losses.relative_loss(image, image, image, epsilon=STRONG),
    "charbonnier_loss": lambda: losses.charbonnier_loss(image, image, epsilon=STRONG),
}


@pytest.mark.parametrize("name", sorted(NUMBERS))
def test_an_option_in_float64_widens_nothing(unchecked, name):
    """Numbers out of NumPy, as of a loop over `np.linspace`."""
    with all_settings():
        results = jax.tree.leaves(jax.eval_shape(NUMBERS[name]))
    assert {str(leaf.dtype) for leaf in results} <= {"float32", "int32", "bool"}


def test_the_widest_dtype():
    double, single, half, brain = (np.zeros(2, dtype) for dtype in (np.float64, np.float32, np.float16, jnp.bfloat16))
    assert widest(brain) == widest(half, single) == np.float32
    assert widest(double) == np.float32  # there is no other without 64-bit types
    with all_settings():
        assert widest(brain, half) == np.float32
        assert widest(half, double) == np.float64


# Methods


def method(name):
    """Networks are small ones with random weights."""
    if name in ("guided_net", "extranet"):
        config = ExtraNetConfig(widths=(4, 6), warps=2, features=6, histories=3)
        return {"guided_net": guided_net, "extranet": extranet}[name](small_extranet.random_model(config))
    if name == "interpolator":
        return interpolator(small_extranet.random_model(InterpolatorConfig(widths=(4, 6)), Interpolator))
    return small_extranet.load(name)


def given(found, *, times=float, dtype=np.float32):
    """What a method sees of a sequence with every buffer, its times numbers of Python or of NumPy."""
    camera, sequence = jx.Camera(eye, eye), []
    past, future = 2 * found.past - 1, max(0, 2 * found.future - 1)
    place = max(5, past)
    for k in range(place + 4):
        frame = synthetic.make_frame(k, (24, 30))
        sky = np.zeros_like(frame.gbuffer.depth)
        full = replace(frame.gbuffer, sky=sky, sky_color=frame.color)
        frame = in_dtype(replace(frame, gbuffer=full, camera=camera), dtype)
        sequence.append(replace(frame if k % 2 == 0 else hide(frame), time=times(k)))
    return tuple(sequence[place - past : place]), sequence[place], tuple(sequence[place + 1 : place + 1 + future])


@pytest.mark.slow
@pytest.mark.parametrize("name", jx.method_names())
def test_methods_keep_float32(unchecked, name):
    """Also with times in float64."""
    found = method(name)
    arguments = given(found, times=np.float64)

    def function(state, history, target, future):
        return found.function(state, found.init(history, target), history, target, future)[1]

    with all_settings():
        result = jax.eval_shape(function, found.state, *arguments)
    assert result.dtype == np.float32
    assert kinds(function, found.state, *given(found)) == {"float32"}


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "bfloat16", "float16"])
@pytest.mark.parametrize("name", jx.method_names())
def test_methods_in_other_precisions(unchecked, name, dtype):
    """A network answers in at least float32, all else in the precision of the frames."""
    found = method(name)
    arguments = given(found, dtype=jnp.dtype(dtype))

    def function(state, history, target, future):
        return found.function(state, found.init(history, target), history, target, future)[1]

    result = kinds(function, found.state, *arguments)
    assert result == {"float32" if name in ("guided_net", "extranet", "extrass") and dtype != "float64" else dtype}


# Scenes


@pytest.mark.parametrize(
    "name",
    [n if n == "terrain" else pytest.param(n, marks=pytest.mark.slow) for n in scenes.scene_names()],
)
def test_scenes_are_drawn_in_float32(name):
    """terrain has a height field and objects that move."""
    world = scenes.scene(name, 1)
    with all_settings():
        again = scenes.scene(name, 1)
    for leaf, other in zip(jax.tree.leaves(world), jax.tree.leaves(again), strict=True):
        assert leaf.dtype == other.dtype == np.float32
        np.testing.assert_array_equal(leaf, other)
    time, samples = np.float64(7.25), 1 if name == "terrain" else 2
    assert kinds(lambda w: scenes.render(w, time, size=(6, 8), samples=samples), world) == {"float32"}
    assert kinds(lambda w: scenes.flow(w, time, time + 2, size=(6, 8)), world) == {"float32"}
    assert kinds(lambda w: scenes.visible(w, time, time + 2, size=(6, 8)), world) == set()


def test_lamps_flicker_in_float32():
    lights = scenes.scene("street", 1).lights
    expected = lamp_levels(lights, jnp.float32(7))
    assert kinds(lamp_levels, lights, np.float32(7)) == {"float32"}
    with all_settings():
        np.testing.assert_array_equal(lamp_levels(lights, jnp.float32(7)), expected)


# Values


SMALL = ("backward_warp", "convert_motion", "demodulate", "log_encode", "tonemap")
VALUES = (*SMALL, "camera_motion", "psnr", "splat", "splat_nearest", "iterative_search", "occlusion_motion")


LONG = ("dis_flow", "shading_flow")  # hundreds of steps that build on each other: compared in float64


def same(name, context, dtype=None):
    """Whether an operation gives what it gives by default; real arguments in a dtype."""
    function, *arguments = ALL[name]

    def given(leaf):
        leaf = jnp.asarray(leaf)
        return leaf.astype(dtype) if dtype is not None and jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    arguments = jax.tree.map(given, arguments)
    expected = jax.tree.leaves(function(*arguments))
    with context():
        found = jax.tree.leaves(function(*arguments))
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=5e-6)


@pytest.mark.parametrize("name", VALUES)
def test_values_do_not_depend_on_the_settings(unchecked, name):
    same(name, all_settings)


@pytest.mark.parametrize("name", [n if n in SMALL else pytest.param(n, marks=pytest.mark.slow) for n in sorted(ALL)])
def test_values_without_compilation(unchecked, name):
    with jax.enable_x64(name in LONG):
        same(name, jax.disable_jit, dtype=np.float64 if name in LONG else None)


@pytest.mark.parametrize("name", [n if n in SMALL else pytest.param(n, marks=pytest.mark.slow) for n in sorted(ALL)])
def test_nothing_but_what_is_said_to_be_is_nan(unchecked, name):
    """In the highest precision of matrix products, too."""

    @contextlib.contextmanager
    def watched():
        with jax.debug_nans(True), jax.default_matmul_precision("highest"):
            yield

    same(name, watched)


def test_a_search_of_no_steps_without_compilation():
    """It ends where it starts: at the pixels."""
    flow = jnp.ones((2, 3, 2), jnp.float32)
    with jax.disable_jit():
        at = search.advance(search.leads(flow, jnp.float32(0.5)), None, 0, 2, 0, "fixed_point", "nearest")
    np.testing.assert_array_equal(at, np.arange(3) + 1j * np.arange(2)[:, None])


# A process that is started with them

VARIABLES = {
    "JAX_ENABLE_X64": "1",
    "JAX_NUMPY_DTYPE_PROMOTION": "strict",
    "JAX_NUMPY_RANK_PROMOTION": "raise",
}


def draw():
    """A ball on a plane: where the ground is seen, by the camera's matrices in float64."""
    b = Builder()
    b.add("plane", (0, 0, 0), (1, 1, 1), material((0.4, 0.4, 0.4), color_b=(0.1, 0.1, 0.1), frequency=(0.5, 0.5, 0)))
    b.add("sphere", (0, 0, 0.8), (0.8, 0.8, 0.8), material((0.8, 0.3, 0.2)))
    camera = common.camera(common.circle(5.0, 300.0, 0.6, centre=(0, 0, 1.8)), path((0, 0, 0.7)))
    sky = common.daylight(np.random.default_rng(0))
    up = {"sun_direction": (0, 0, 1), "sun_color": 2.0}
    frame = scenes.render(b.build(camera=camera, sky=sky, bounce=False, **up), 7.25, size=(9, 16))
    assert {str(leaf.dtype) for leaf in jax.tree.leaves(frame)} == {"float32"}
    assert np.isfinite(frame.color).all()
    position, view, projection = (
        np.float64(a) for a in (frame.gbuffer.position, frame.camera.view, frame.camera.projection)
    )
    points = np.concatenate([position, np.ones((9, 16, 1))], -1)
    clip = points @ (projection @ view).T
    pixels = (clip[..., :2] / clip[..., 3:] * [0.5, -0.5] + 0.5) * [16, 9] - 0.5
    rows, columns = np.mgrid[:9, :16]
    np.testing.assert_allclose(pixels, np.stack([columns, rows], -1), atol=1e-3)
    ground = (position[..., 2] < 0.01) & (frame.gbuffer.sky[..., 0] < 0.5)
    assert ground.sum() > 20
    np.testing.assert_allclose(position[ground][:, 2], 0, atol=1e-4)


def train(folder):
    """Three steps of training."""
    found = {}
    options, optimizer = ToyOptions(wobble=0.1), Optimizer(peak_learning_rate=0.03, warmup=2, clip=1.0)
    task = ToyTask(options)
    config = Config(task="toy", options=options, steps=3, batch=4, pool=8, ema_decay=0.9, optimizer=optimizer)
    step, pool = make_step(task, config), task.pool(round_key(0, 0), range(8))
    state = step.create()
    for _ in range(3):
        state, measured = step.take(state, pool)
    assert not {str(leaf.dtype) for leaf in jax.tree.leaves((state, measured, pool))} & {"float64", "int64"}
    found |= measured
    np.savez(Path(folder) / "found.npz", **{name: np.asarray(value) for name, value in found.items()})


def evaluate(folder):
    """An evaluation of a dump."""
    folder = Path(folder)
    dump = folder / "dump"
    dump.mkdir()
    for k in range(4):
        write_unreal_frame(
            dump, "Wall", k, synthetic.make_frame(k, (16, 24)), keyframe=synthetic.make_keyframe(k, (16, 24))
        )
    assert main(["evaluate", str(dump), "--methods", "repeat,warp", "--output", str(folder / "results")]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("steps", ["evaluate", *slow("train, evaluate", "draw, train, evaluate")])
def test_a_process_with_all_settings(tmp_path, steps):
    """By environment variables, as users set them; against a process without."""
    there, here = tmp_path / "there", tmp_path / "here"
    there.mkdir()
    here.mkdir()
    calls = {"evaluate": "evaluate({})", "train": "train({})", "draw": "draw()"}
    code = "; ".join(f"test_settings.{calls[step].format(repr(str(there)))}" for step in steps.split(", "))
    folders = os.pathsep.join([str(TESTS), str(Path(jx.__file__).parents[1])])
    environment = os.environ | VARIABLES | {"PYTHONPATH": folders}
    command = [sys.executable, "-c", f"import test_settings; {code}"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    evaluate(here)
    if "train" in steps:
        train(here)
        ours, theirs = (np.load(folder / "found.npz") for folder in (here, there))
        assert set(ours) == set(theirs)
        for name in ours:
            assert ours[name].dtype == theirs[name].dtype == np.float32
            np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-4, err_msg=name)
    scores = [json.loads((folder / "results" / "results.json").read_text())["methods"] for folder in (here, there)]
    assert scores[0].keys() == scores[1].keys() == {"repeat", "warp"}
    for name, score in scores[0].items():
        for metric in ("psnr", "ssim"):
            assert scores[1][name][metric] == pytest.approx(score[metric], rel=1e-4)
