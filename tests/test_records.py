"""Records: pytrees whose absent fields are structure, unchecked when built, checked where a function receives them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxtrapolate as jx
from jaxtrapolate.checks import check_array, check_choice, check_image, check_present
from jaxtrapolate.records import CHANNELS, check_camera, check_frame, check_gbuffer, replace

RECORDS = [jx.Camera, jx.GBuffer, jx.Frame, jx.Keyframe]
NAMES = [cls.__name__ for cls in RECORDS]


def frame(height=2, width=3):
    buffers = {name: jnp.ones((height, width, channels)) for name, channels in CHANNELS.items()}
    return jx.Frame(
        color=jnp.ones((height, width, 3)),
        gbuffer=jx.GBuffer(**buffers),
        motion=jnp.zeros((height, width, 2)),
        camera=jx.Camera(jnp.eye(4), jnp.eye(4)),
        jitter=jnp.zeros(2),
        time=jnp.float32(3),
    )


@pytest.mark.parametrize("cls", RECORDS, ids=NAMES)
def test_all_fields_are_absent_by_default(cls):
    record = cls()
    assert all(getattr(record, field.name) is None for field in dataclasses.fields(cls))
    assert jax.tree.leaves(record) == []


@pytest.mark.parametrize("cls", RECORDS, ids=NAMES)
def test_records_are_immutable(cls):
    record = cls()
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(record, dataclasses.fields(cls)[0].name, 1)


@pytest.mark.parametrize("cls", RECORDS, ids=NAMES)
def test_fields_are_the_leaves_in_order(cls):
    fields = [field.name for field in dataclasses.fields(cls)]
    record = cls(**{name: float(k) for k, name in enumerate(fields)})
    paths, _ = jax.tree_util.tree_flatten_with_path(record)
    assert [(jax.tree_util.keystr(path), leaf) for path, leaf in paths] == [
        (f".{name}", float(k)) for k, name in enumerate(fields)
    ]


def test_absence_is_structure():
    full, bare = frame(), replace(frame(), camera=None)
    assert jax.tree.structure(full) != jax.tree.structure(bare)
    assert jax.tree.structure(bare) == jax.tree.structure(replace(bare, time=jnp.float32(4)))


def test_replace_leaves_the_original():
    first = frame()
    second = replace(first, motion=None, time=5.0)
    assert second.motion is None
    assert second.time == 5.0
    assert first.motion is not None
    assert second.color is first.color


def test_transformations_put_any_leaf_into_a_record():
    value = frame()
    shapes = jax.tree.map(jnp.shape, value)
    assert shapes.color == (2, 3, 3)
    assert shapes.gbuffer.depth == (2, 3, 1)
    assert jax.tree.map(lambda _: 0, value).camera.view == 0
    assert jax.eval_shape(lambda f: f, value).motion.shape == (2, 3, 2)
    batch = jax.tree.map(lambda a: jnp.stack([a, 2 * a]), value)
    assert batch.color.shape == (2, 2, 3, 3)
    axes = jax.tree.map(lambda _: 0, value)
    doubled = jax.jit(jax.vmap(lambda f: replace(f, color=f.color * 2), in_axes=(axes,)))(batch)
    np.testing.assert_array_equal(doubled.color[1], 4 * np.ones((2, 3, 3)))
    grad = jax.grad(lambda f: jnp.sum(f.color * f.gbuffer.albedo) + f.time)(value)
    np.testing.assert_array_equal(grad.color, np.ones((2, 3, 3)))
    np.testing.assert_array_equal(grad.gbuffer.normal, np.zeros((2, 3, 3)))
    _, stacked = jax.lax.scan(lambda carry, f: (carry, f.gbuffer), 0, batch)
    assert isinstance(stacked, jx.GBuffer)
    assert stacked.depth.shape == (2, 2, 3, 1)


def test_checks_return_the_common_size():
    value = frame()
    assert check_frame("target", value) == (2, 3)
    assert check_frame("target", jx.Frame()) is None
    assert check_frame("target", jx.Frame(), size=(2, 3)) == (2, 3)
    assert check_gbuffer("g", value.gbuffer, size=(2, 3)) == (2, 3)
    assert check_gbuffer("g", jx.GBuffer()) is None
    check_camera("camera", value.camera)
    assert set(CHANNELS) == {field.name for field in dataclasses.fields(jx.GBuffer)}


@pytest.mark.parametrize(
    "changes, error, message",
    [
        ({"color": jnp.ones((2, 3, 4))}, ValueError, r"target\.color: expected shape \[H, W, 3\], got \[2, 3, 4\]"),
        ({"color": jnp.ones((2, 3))}, ValueError, r"target\.color: expected shape \[H, W, 3\], got \[2, 3\]"),
        ({"color": jnp.ones((0, 3, 3))}, ValueError, r"target\.color: .*got \[0, 3, 3\]"),
        ({"motion": jnp.ones((3, 2, 2))}, ValueError, r"target\.motion: expected shape \[2, 3, 2\], got \[3, 2, 2\]"),
        ({"motion": jnp.ones((2, 3, 2), int)}, TypeError, r"target\.motion: expected a floating-point .*int32"),
        ({"color": [[1.0]]}, TypeError, r"target\.color: expected a floating-point array .* got list"),
        ({"gbuffer": 1}, TypeError, r"target\.gbuffer: expected a GBuffer, got int"),
        ({"gbuffer": jx.GBuffer(depth=jnp.ones((2, 3, 3)))}, ValueError, r"target\.gbuffer\.depth: .*\[2, 3, 1\]"),
        ({"camera": jx.Camera(jnp.eye(4))}, TypeError, r"target\.camera\.projection: .* got NoneType"),
        ({"camera": jx.Camera(jnp.eye(3), jnp.eye(4))}, ValueError, r"target\.camera\.view: .*\[4, 4\], got \[3, 3\]"),
        ({"camera": 2}, TypeError, r"target\.camera: expected a Camera, got int"),
        ({"jitter": jnp.zeros(3)}, ValueError, r"target\.jitter: expected shape \[2\], got \[3\]"),
    ],
)
def test_check_frame_errors(unchecked, changes, error, message):
    with pytest.raises(error, match=message):
        check_frame("target", replace(frame(), **changes))


def test_other_check_errors(unchecked):
    with pytest.raises(TypeError, match="f: expected a Frame, got GBuffer"):
        check_frame("f", jx.GBuffer())
    with pytest.raises(ValueError, match=r"a: expected shape \[2, N\], got \[3, 1\]"):
        check_array("a", jnp.ones((3, 1)), shape=(2, "N"))
    with pytest.raises(ValueError, match=r"i: expected shape \[4, 4, C\], got \[4, 5, 1\]"):
        check_image("i", jnp.ones((4, 5, 1)), size=(4, 4))
    with pytest.raises(ValueError, match="mode: expected one of 'a', 'b', got 'c'"):
        check_choice("mode", "c", ("a", "b"))
    with pytest.raises(ValueError, match=r"depth: absent \(None\), but the warp needs it"):
        check_present("depth", None, needed_by="the warp")


def test_annotations_are_checked(typechecked):
    import jaxtyping

    with pytest.raises(jaxtyping.TypeCheckError):
        jx.backward_warp(jnp.ones((2, 3)), jnp.zeros((2, 3, 2)))
    with pytest.raises(jaxtyping.TypeCheckError):
        jx.chain_motion(jnp.zeros((2, 3, 2)), jnp.zeros((3, 2, 2)))
