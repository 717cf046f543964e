"""Options of methods: what there is, what they may be, that they count, and what is compiled anew."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_extranet
from marks import slow_rows
from synthetic import make_frame

import jaxtrapolate as jx
from jaxtrapolate.commands.inputs import open_methods
from jaxtrapolate.commands.main import main
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.methods.options import options_of, parsed, written
from jaxtrapolate.records import replace

SIZE = (16, 24)

NETWORKS = ("guided_net", "extranet", "extrass_refine", "extrass", "interpolator")


def window(size=SIZE):
    frames = [jax.tree.map(jnp.asarray, make_frame(time, size)) for time in range(2, 6)]
    return (frames[0], hide(frames[1]), frames[2]), hide(frames[3]), frames[3].color


def between(size=SIZE):
    frames = [jax.tree.map(jnp.asarray, make_frame(time, size)) for time in range(3, 6)]
    return (frames[0],), hide(frames[1]), (frames[2],)


def test_every_option_is_described():
    for name in jx.method_names():
        method = small_extranet.load(name)
        assert method.options == options_of(method.settings)
        for option in method.options:
            assert option.doc
            assert option.value == option.default
            assert option.checked(option.value) == option.value
            assert option.checked(option.parsed(written(option.value))) == option.value
            assert option.static == (not isinstance(option.default, float))


def test_what_an_option_says():
    options = {o.name: o for o in jx.load("guided_warp", keep=2, rows=None).options}
    assert (options["keep"].value, options["keep"].default) == (2, 4)
    assert options["keep"].allowed == "integer from 1 to 33"
    assert options["rows"].allowed == "integer from 1 to 65536, or none"
    assert options["sigma_guide"].allowed == "number from 0 on"
    assert options["strides"].allowed == "several of: integer from 1 to 64"
    assert options["by"].allowed == "albedo+specular or albedo or none"
    assert options["sky"].allowed == "true or false"
    assert not options["sigma_guide"].static
    assert jx.load("repeat").options == ()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kep": 1}, r"method 'guided_warp': no option 'kep'; its options: by=albedo\+specular \("),
        ({"keep": 0}, r"method 'guided_warp', keep: expected integer from 1 to 33, got 0; its options: "),
        ({"keep": 1.0}, "keep: expected integer"),
        ({"keep": True}, "keep: expected integer"),
        ({"sky": 1}, "sky: expected true or false, got 1"),
        ({"strides": 3}, "strides: expected several of"),
        ({"strides": ()}, "strides: expected several of"),
        ({"strides": (1, 99)}, "strides: expected several of"),
        ({"by": "depth"}, "by: expected albedo"),
        ({"floor": 2.0}, "floor: expected number from 0 to 1, got 2.0"),
        ({"floor": "1"}, "floor: expected number"),
        ({"floor": float("nan")}, "floor: expected number"),
        ({"sigma_guide": float("inf")}, "sigma_guide: expected number"),
        ({"sigma_guide": np.ones(2)}, "sigma_guide: expected number"),
        ({"sigma_guide": jnp.float32(-1)}, "sigma_guide: expected number"),
    ],
)
def test_what_an_option_cannot_be(unchecked, options, message):
    with pytest.raises(ValueError, match=message) as raised:
        jx.load("guided_warp", **options)
    assert "\n" not in str(raised.value)
    with pytest.raises(ValueError, match="no option 'keep'; it has no options"):
        jx.load("repeat", keep=1)
    with pytest.raises(ValueError, match="dtype: expected one of 'float32'"):
        jx.load("warp", dtype="int8")


def test_values_are_held_as_the_field_has_them():
    method = jx.load("guided_warp", floor=np.float32(0.5), sigma_space=1, strides=[1, np.int64(2)])
    values = {o.name: o.value for o in method.options}
    assert (values["floor"], values["sigma_space"], values["strides"]) == (0.5, 1.0, (1, 2))
    assert [type(values[n]) for n in ("floor", "sigma_space")] == [float, float]


@pytest.mark.slow
def test_numbers_change_without_compiling_anew():
    method, traces = jx.load("occlusion_warp"), []
    first, *rest = method.stages

    def counted(state, values):
        traces.append(first.name)
        return first(state, values)

    counting = dataclasses.replace(method, stages=(dataclasses.replace(first, function=counted), *rest))
    history, target, _ = window()
    images = [counting.replace(floor=floor)(history, target) for floor in (0.01, 0.1, 1.0)]
    assert len(traces) == 1
    assert not np.array_equal(images[0], images[2])
    np.testing.assert_array_equal(counting(history, target), images[0])
    plain = counting.replace(by="none")
    first_of_plain = plain(history, target)
    assert len(traces) == 2
    assert not np.array_equal(first_of_plain, images[0])
    plain.replace(floor=0.5).replace(margin=1.0)(history, target)
    assert len(traces) == 2


@pytest.mark.slow
def test_options_are_swept_and_fitted():
    method = jx.load("guided_warp")
    history, target, truth = window()

    def error(sigma):
        state = method.replace(sigma_space=sigma).state
        return jnp.mean(jnp.square(method.function(state, (), history, target)[1] - truth))

    sigmas = jnp.asarray([0.2, 0.5, 2.0])
    errors = jax.jit(jax.vmap(error))(sigmas)
    for sigma, found in zip((0.2, 0.5, 2.0), errors, strict=True):
        image = method.replace(sigma_space=sigma)(history, target)
        np.testing.assert_allclose(found, np.mean(np.square(image - truth)), rtol=1e-4)
    slope = jax.jit(jax.grad(error))(0.5)
    assert np.isfinite(slope)
    assert slope != 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("warp", {"filter": "nearest"}),
        ("occlusion_warp", {"by": "none"}),
        pytest.param("occlusion_warp", {"floor": 0.9}, marks=pytest.mark.slow),
        ("occlusion_warp", {"margin": 50.0}),
        ("guided_warp", {"strides": (1, 2)}),
        ("guided_warp", {"sigma_guide": 1.0}),
        ("warp_3d", {"epsilon": 10.0}),
        pytest.param("grid_extrapolate", {"cell": 16}, marks=pytest.mark.slow),
        ("grid_extrapolate", {"tear": 100.0}),
        ("softmax_splat", {"by_depth": 0.0}),
        pytest.param("grid_warp", {"cell": 16}, marks=pytest.mark.slow),
        ("bidirectional_image", {"iterations": 0, "starts": ("default",)}),
        pytest.param("bidirectional_image", {"visibility": "inside"}, marks=pytest.mark.slow),
        pytest.param("bidirectional_guided", {"keep": 1}, marks=pytest.mark.slow),
        pytest.param("dis", {"preset": "ultrafast"}, marks=pytest.mark.slow),
        ("warp", {"space": "tone"}),
        pytest.param("dis", {"space": "log"}, marks=pytest.mark.slow),
        pytest.param("warp_3d", {"space": "linear"}, marks=pytest.mark.slow),
        pytest.param("bidirectional_guided", {"space": "linear"}, marks=pytest.mark.slow),
    ],
)
def test_options_count(name, options):
    method = loaded(name)
    if method.future:
        history, target, future = between()
    else:
        (history, target, _), future = window(), ()
    other = method.replace(**options)(history, target, future)
    assert np.isfinite(other).all()
    assert not np.array_equal(method(history, target, future), other)


@functools.cache
def loaded(name):
    """The method, compiled once for all tests."""
    return jx.load(name)


# Precision


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "dtype", "least"),
    [
        ("warp", "float16", 60),
        ("warp", "float32", 100),
        ("guided_warp", "float32", 100),
        *slow_rows(("warp", "bfloat16", 38), ("guided_warp", "float16", 60), ("guided_warp", "bfloat16", 38)),
    ],
)
def test_a_method_in_another_precision(name, dtype, least):
    """The error is that of the colours' own digits, once or twice; the image has the colours' dtype."""
    history, target, _ = window((32, 48))
    exact = jx.load(name)(history, target)
    image = jx.load(name, dtype=dtype)(history, target)
    assert image.dtype == np.float32
    assert jx.psnr(jx.tonemap(image), jx.tonemap(exact)) > least
    doubled = jax.tree.map(lambda a: jnp.asarray(a, jnp.bfloat16), history)
    assert jx.load(name, dtype="float32")(doubled, target).dtype == jnp.bfloat16


def test_what_is_cast():
    seen = {}

    def look(state, values):
        seen.update(values)
        return {"image": values["history"][-1].color}

    history, target, truth = window()
    method = jx.Method(
        "look", (jx.Stage("look", look, ("carry", "history", "target", "future"), ("image",)),), dtype="bfloat16"
    )
    np.testing.assert_array_equal(method((), replace(target, color=truth)), truth)  # rendered: as it is
    assert method(history, target).dtype == np.float32
    newest = seen["history"][-1]
    wide = ("depth", "position", "stencil")
    for name in ("albedo", "normal", "roughness", *wide):
        assert getattr(newest.gbuffer, name).dtype == (np.float32 if name in wide else jnp.bfloat16)
    assert newest.color.dtype == jnp.bfloat16
    assert newest.motion.dtype == np.float32


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in jx.method_names() if n not in NETWORKS])
def test_every_method_in_bfloat16(unchecked, name, strict):
    """No buffer of one dtype meets one of another unawares."""
    method = jx.load(name, dtype="bfloat16")
    if method.future:
        history, target, future = between()
    else:
        (history, target, _), future = window(), ()
    carry = method.init(history, target)
    image = jax.eval_shape(lambda state: method.function(state, carry, history, target, future)[1], method.state)
    assert image.dtype == np.float32


# On the command line


def test_methods_with_options_stand_side_by_side():
    found, unavailable = open_methods(
        "guided_warp, guided_warp:keep=1:sigma_guide=0.05,guided_warp:strides=1-3:rows=none"
    )
    assert not unavailable
    assert list(found) == ["guided_warp", "guided_warp:keep=1:sigma_guide=0.05", "guided_warp:strides=1-3:rows=none"]
    values = [{o.name: o.value for o in method.options} for method in found.values()]
    assert [v["keep"] for v in values] == [4, 1, 4]
    assert [v["sigma_guide"] for v in values] == [0.03, 0.05, 0.03]
    assert (values[2]["strides"], values[2]["rows"]) == ((1, 3), None)
    assert len({id(method._jitted) for method in found.values()}) == 1


def test_texts_are_read_by_kind():
    given = {"sky": "false", "keep": "7", "floor": "1e-3", "strides": "2", "by": "albedo", "rows": "none"}
    assert parsed("m", jx.load("guided_warp").settings, given) == {
        "sky": False,
        "keep": 7,
        "floor": 0.001,
        "strides": (2,),
        "by": "albedo",
        "rows": None,
    }
    assert parsed("m", jx.load("bidirectional").settings, {"starts": "default-dual"}) == {"starts": ("default", "dual")}


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ("guided_warp:keep", "expected NAME:OPTION=VALUE"),
        ("guided_warp:keep=", "expected NAME:OPTION=VALUE"),
        ("guided_warp:keep=1:keep=2", "each option once"),
        ("guided_warp:keep=x", "keep: expected integer from 1 to 33, got 'x'; its options"),
        ("guided_warp:keep=1.5", "keep: expected integer from 1 to 33, got '1.5'"),
        ("guided_warp:sky=yes", "sky: expected true or false, got 'yes'"),
        ("guided_warp:sigma=1", "no option 'sigma'"),
        ("guided_wrap:keep=1", "no method 'guided_wrap'"),
        ("repeat:keep=1", "no option 'keep'; it has no options"),
    ],
)
def test_what_cannot_be_named(names, message):
    with pytest.raises(InputError, match=f"--methods: .*{message}"):
        open_methods(names)


def test_options_are_listed(capsys):
    assert main(["methods", "guided_warp"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    for text in (
        "options, as in guided_warp:by=albedo+specular",
        "keep",
        "1-3-5-9",
        "1 to 33",
        "compiled",
    ):
        assert text in out
