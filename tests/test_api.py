"""Rules that hold for every public operation: signatures, docstrings, and that all transformations agree."""

import inspect
import re
import typing

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marks import slow
from oracles import look, perspective, random, random_motion

import jaxtrapolate as jx
from jaxtrapolate.metrics import image as metrics
from jaxtrapolate.ops import holes, radiance

PUBLIC = {
    name: value
    for name, value in ((name, getattr(jx, name)) for name in jx.__all__)
    if callable(value) and value.__module__.startswith("jaxtrapolate")
}
PUBLIC |= {
    f"{module.__name__.split('.')[-1]}.{name}": value
    for module in (radiance, metrics, holes)
    for name, value in vars(module).items()
    if not name.startswith("_") and callable(value) and value.__module__ == module.__name__ and name not in PUBLIC
}
FUNCTIONS = {name: value for name, value in PUBLIC.items() if not inspect.isclass(value)}


def test_the_contract_names_are_there():
    expected = {
        *("Camera", "GBuffer", "Frame", "Keyframe", "backward_warp", "in_frame", "chain_motion", "convert_motion"),
        *("camera_motion", "splat_nearest", "splat", "occlusion_motion", "guided_warp", "__version__"),
        *("iterative_search", "interpolate_bidirectional", "interpolate_run", "motion_blur", "complete_flows"),
        "camera_flow",
    }
    assert all(hasattr(jx, name) for name in expected)


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_options_are_keyword_only(name):
    """By position come arrays, records and names of things; all that has a default needs its keyword."""
    for parameter in inspect.signature(FUNCTIONS[name]).parameters.values():
        if parameter.kind is not parameter.KEYWORD_ONLY:
            optional_record = parameter.annotation in (tuple[jx.Frame, ...],)
            assert parameter.default is inspect.Parameter.empty or optional_record, parameter
            assert parameter.annotation not in (bool, int, float), parameter
            assert typing.get_origin(parameter.annotation) is not typing.Literal, parameter


def described(text):
    """The arguments of a docstring's section Args, which has one a line."""
    section = text.partition("Args:\n")[2].partition("\n\n")[0]
    return re.findall(r"^ {4}(\w+): ", section, re.MULTILINE)


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_docstrings(name):
    """A line for all; what has options or several arguments describes them, and what it raises; a map of one array
    says what it does in that line."""
    text = inspect.getdoc(PUBLIC[name])
    assert text, "no docstring"
    assert len(text.splitlines()[0]) <= 120
    parameters = {} if inspect.isclass(PUBLIC[name]) else dict(inspect.signature(PUBLIC[name]).parameters)
    parameters = {k: p for k, p in parameters.items() if p.kind is not p.VAR_KEYWORD}
    arrays = [p for p in parameters.values() if p.kind is not p.KEYWORD_ONLY]
    if len(arrays) > 1 or "Args:" in text:
        assert set(parameters) <= set(described(text)), "an argument has no line of its own"
        for section in ("Args:", "Raises:"):
            assert section in text, f"no section {section}"


# Every operation, in all transformations. Arguments are away from kinks; weights and strides small for short compiles.

H, W = 5, 7


def gbuffer(albedo, normal, position):
    ids = jnp.zeros((H, W, 1), albedo.dtype)
    return jx.GBuffer(albedo=albedo, normal=normal, position=position, stencil=ids)


def camera(view):
    return jx.Camera(view, jnp.asarray(perspective(H, W), view.dtype))


image, motion, depth = random(H, W, 2), random_motion(H, W), random(H, W, 1, seed=8)
color, other = random(H, W, 3, seed=3, low=0.1), random(H, W, 3, seed=4, low=0.1)
large, larger = random(12, 13, 2, seed=5), random(12, 13, 2, seed=6)
normal, second = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (color, other))
views = [look(a).astype(np.float32) for a in (0.1, -0.1)]
far = (random(H, W, 3, seed=7, low=-1) - np.float32([0, 0, 5])).astype(np.float32)
smooth = np.float32([0.4, -0.3, 0.01]) + np.float32(0.1) * random(H, W, 3, seed=9)
CONVENTION = {"sign": "current_minus_previous", "units": "uv", "y_axis": "up"}

OPERATIONS = {
    "backward_warp": (lambda i, m, v: jx.backward_warp(i, m, outside=v), image, motion, np.float32(0.5)),
    "backward_warp-nearest": (lambda i, m: jx.backward_warp(i, m, filter="nearest"), image, motion),
    "backward_warp-bicubic": (lambda i, m: jx.backward_warp(i, m, filter="bicubic"), image, motion),
    "chain_motion": (jx.chain_motion, motion, random_motion(H, W, seed=2)),
    "convert_motion": (lambda m: jx.convert_motion(m, **CONVENTION), motion),
    "camera_motion": (lambda p, a, b: jx.camera_motion(p, camera(a), camera(b)), far, *views),
    "splat_nearest": (lambda v, m, d: jx.splat_nearest(v, m, d)[0], image, motion, depth),
    "splat": (jx.splat, image, motion),
    "splat-linear": (lambda v, m, w: jx.splat(v, m, weights=w, mode="linear"), image, motion, depth + 0.1),
    "splat-softmax": (lambda v, m, w: jx.splat(v, m, weights=w, mode="softmax"), image, motion, depth),
    "occlusion_motion": (jx.occlusion_motion, motion, depth),
    "dilate_motion": (jx.dilate_motion, motion, depth),
    "guided_warp": (
        lambda i, m, t, s, a, b: jx.guided_warp(i, m, t, s, strides=(1,), keep=2, sigma_guide=a, sigma_space=b),
        *(image, motion, color, other, np.float32(0.5), np.float32(1.5)),
    ),
    "camera_flow": (lambda p, a, b: jx.camera_flow(p, camera(a), camera(b)), far, *views),
    "iterative_search": (lambda f, a: jx.iterative_search(f, a).position, smooth, np.float32(0.4)),
    "interpolate_bidirectional": (
        lambda a, b, f, g, d: (
            jx.interpolate_bidirectional(
                jx.Keyframe(color=a, depth=d, forward_flow=f), jx.Keyframe(color=b, depth=d, backward_flow=g), 0.4
            ).color
        ),
        *(color, other, smooth, -smooth, depth + np.float32(1)),
    ),
    "interpolate_assisted": (
        lambda a, b, d, t: (
            jx.interpolate_bidirectional(
                *(jx.Keyframe(color=c, depth=d) for c in (a, b)),
                0.4,
                target=jx.Keyframe(depth=d, forward_flow=t, backward_flow=-t),
            ).color
        ),
        *(color, other, depth + np.float32(1), smooth),
    ),
    "hole_masks": (
        lambda n, p, q, m, s: holes.hole_masks(gbuffer(p, n, p), gbuffer(p, second, q), m, softness=s).any,
        *(normal, far, far + np.float32(0.5), motion, np.float32(0.5)),
    ),
    "demodulate": (
        lambda c, a, f: radiance.demodulate(c, jx.GBuffer(albedo=a), floor=f),
        color,
        other,
        np.float32(0.2),
    ),
    "modulate": (lambda c, a, f: radiance.modulate(c, jx.GBuffer(albedo=a), floor=f), color, other, np.float32(0.2)),
    "log_encode": (radiance.log_encode, color),
    "log_decode": (radiance.log_decode, color),
    "tonemap": (lambda c, g: radiance.tonemap(c, gamma=g), color, np.float32(2.2)),
    "tonemap_inverse": (lambda c, g: radiance.tonemap_inverse(c, gamma=g), color * np.float32(0.8), np.float32(2.2)),
    "compress": (radiance.compress, color),
    "expand": (radiance.expand, color * np.float32(0.8)),
    "srgb_encode": (radiance.srgb_encode, color),
    "srgb_decode": (radiance.srgb_decode, color),
    "mse": (metrics.mse, large, larger),
    "psnr": (lambda a, b, p: metrics.psnr(a, b, peak=p), large, larger, np.float32(1)),
    "ssim": (lambda a, b, p: metrics.ssim(a, b, peak=p), large, larger, np.float32(1)),
}


BETWEEN = ("interpolate_bidirectional", "interpolate_assisted")


def cases(*slow):
    return [pytest.param(name, marks=pytest.mark.slow) if name in slow else name for name in OPERATIONS]


def batch(arrays):
    """Two different sets of arguments."""
    return [jnp.stack([jnp.asarray(a), jnp.asarray(a) * 0.95]) for a in arrays]


@pytest.mark.parametrize(
    "name", cases("backward_warp-bicubic", "guided_warp", "hole_masks", "splat-linear", "splat-softmax", *BETWEEN)
)
def test_eager_is_jit_is_vmap(name):
    function, *arrays = OPERATIONS[name]
    pair = batch(arrays)
    mapped = jax.jit(jax.vmap(function))(*pair)
    jitted = jax.jit(function)
    for k in (0, 1):
        given = [a[k] for a in pair]
        eager = function(*given)
        np.testing.assert_allclose(jitted(*given), eager, rtol=2e-5, atol=2e-6)
        np.testing.assert_allclose(mapped[k], eager, rtol=2e-5, atol=2e-6)


def derivatives(function, *arrays):
    """Forward and reverse derivative along one direction, and the forward derivative of the gradient along it."""
    along = [jnp.cos(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape) for a in arrays]

    def loss(*arrays):
        return jnp.sum(jnp.square(function(*arrays)))

    gradient = jax.grad(loss, argnums=tuple(range(len(arrays))))
    (found, curved) = jax.jvp(gradient, tuple(arrays), tuple(along))
    _, forward = jax.jvp(loss, tuple(arrays), tuple(along))
    return forward, sum(jnp.vdot(a, g) for a, g in zip(along, found, strict=True)), found, curved


HEAVY = [
    "backward_warp-bicubic",
    "guided_warp",
    "hole_masks",
    "ssim",
    "splat",
    "splat-linear",
    "splat-softmax",
    *BETWEEN,
]
HEAVY += ["camera_flow", "chain_motion", "iterative_search"]


@pytest.mark.parametrize("name", cases(*HEAVY))
def test_forward_and_reverse_derivatives_agree(name):
    """Mapped over two sets of arguments and compiled; for one operation against the unmapped gradient."""
    function, *arrays = OPERATIONS[name]
    pair = batch(arrays)
    forward, reverse, gradients, curved = jax.jit(jax.vmap(lambda *a: derivatives(function, *a)))(*pair)
    np.testing.assert_allclose(forward, reverse, rtol=1e-3, atol=1e-4)
    assert all(np.isfinite(g).all() for g in (*gradients, *curved))
    if name == "backward_warp":
        loss = jax.jit(jax.grad(lambda *a: jnp.sum(jnp.square(function(*a))), argnums=tuple(range(len(arrays)))))
        for one, mapped in zip(loss(*(a[0] for a in pair)), gradients, strict=True):
            np.testing.assert_allclose(mapped[0], one, rtol=1e-3, atol=1e-5)


OPTIONS = {
    "backward_warp": lambda v: jx.backward_warp(jnp.asarray(image), jnp.asarray(motion), outside=v),
    "demodulate": lambda v: radiance.demodulate(jnp.asarray(color), jx.GBuffer(albedo=jnp.asarray(other)), floor=v),
    "tonemap": lambda v: radiance.tonemap(jnp.asarray(color), gamma=v),
    "psnr": lambda v: metrics.psnr(jnp.asarray(large), jnp.asarray(larger), peak=v),
    "ssim": lambda v: metrics.ssim(jnp.asarray(large), jnp.asarray(larger), peak=v),
    "hole_masks": lambda v: holes.hole_masks(jx.GBuffer(), jx.GBuffer(), jnp.asarray(motion), position_threshold=v),
}


@pytest.mark.parametrize("name", sorted(OPTIONS))
def test_another_value_of_an_option_traces_nothing(name):
    import jax._src.test_util as jtu

    OPTIONS[name](0.25)
    with jtu.count_jit_and_pmap_lowerings() as count:
        for value in (0.5, 0.75, 3.0):
            OPTIONS[name](value)
    assert count() == 0


FLOWS = {
    "farneback": lambda a, b: jx.farneback_flow(a, b),
    "dis": lambda a, b: jx.dis_flow(a, b),
    "shading": lambda a, b: jx.shading_flow(a, b, guide=a)[0],
}


@pytest.mark.parametrize("name", ["farneback", *slow("dis", "shading")])
def test_annotations_of_flows_hold(name):
    """Traced alone, with the checks that the tests of their values do without."""
    image = jnp.zeros((40, 48, 1), jnp.float32)
    assert jax.eval_shape(FLOWS[name], image, image).shape == (40, 48, 2)
