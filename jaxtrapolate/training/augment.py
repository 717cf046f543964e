"""Augmentation: mirrored frames, whose world is mirrored with them, lamps as bright as real ones, and random crops."""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxtrapolate.checks import Size
from jaxtrapolate.records import Camera, Frame, GBuffer, replace

T = TypeVar("T")

_LEAST = 1e-9  # weight of a pixel that has none, so that there is always one to choose

Flag = bool | Bool[Array, ""]


def flip(tree: T, *, horizontal: Flag, vertical: Flag) -> T:
    """Mirror all `Frame`s in a pytree left to right, top to bottom, or both; flags may be traced.

    The frames are those of a mirrored world: a horizontal flip mirrors the world's x, a vertical one its z. So normals
    and positions change sign along these axes, in all frames alike, whatever the camera, known or not: distances and
    angles between frames stay what they were, and there is a camera that sees exactly this. Where the camera is known
    it becomes that one, view' = D view M and projection' = D projection D with D the mirror of the screen, M of the
    world; projecting the mirrored positions by it gives the mirrored pixels.

    Mirroring at the plane of a camera instead leaves that camera unchanged, but each frame has another, and that of a
    tilted one would tilt the mirrored world. Where z is up, a vertical flip turns the world upside down and leaves
    level what was level; where y is up, the picture is as valid, with a camera that is rolled by half a turn.

    Args:
        tree: a `Frame`, a `Window`, or any pytree that holds such; what is not in a frame stays unchanged.
        horizontal: whether left and right are exchanged.
        vertical: whether top and bottom are.
    """

    def one(value: Any) -> Any:
        return _flip(value, horizontal, vertical) if isinstance(value, Frame) else value

    return jax.tree.map(one, tree, is_leaf=lambda value: isinstance(value, Frame))


def _flip(frame: Frame, horizontal: Flag, vertical: Flag) -> Frame:
    one = jnp.ones((), jnp.float32)
    x, y = (jnp.where(flag, -one, one) for flag in (horizontal, vertical))

    def image(value: Any) -> Array:
        value = jnp.asarray(value)
        value = jnp.where(horizontal, value[:, ::-1], value)
        return jnp.where(vertical, value[::-1], value)

    def signed(value: Any, *signs: Array) -> Array:
        return value * jnp.stack(signs).astype(value.dtype).reshape((1,) * (value.ndim - 1) + (-1,))

    fields: dict[str, Any] = {}
    for name in ("color", "motion"):
        if getattr(frame, name) is not None:
            fields[name] = image(getattr(frame, name))
    if frame.motion is not None:
        fields["motion"] = signed(fields["motion"], x, y)
    if frame.jitter is not None:
        fields["jitter"] = signed(frame.jitter, x, y)
    if frame.gbuffer is not None:
        buffers: GBuffer = jax.tree.map(image, frame.gbuffer)
        vectors = {name: getattr(buffers, name) for name in ("normal", "position")}
        fields["gbuffer"] = replace(
            buffers, **{name: signed(value, x, one, y) for name, value in vectors.items() if value is not None}
        )
    if frame.camera is not None:
        screen, world = jnp.stack([x, y, one, one]), jnp.stack([x, one, y, one])
        view, projection = frame.camera.view, frame.camera.projection
        fields["camera"] = Camera(
            view=None if view is None else view * screen[:, None] * world[None],
            projection=None if projection is None else projection * screen[:, None] * screen[None],
        )
    return replace(frame, **fields)


def brighten(tree: T, power: float | Float[Array, ""], *, above: float = 4.0, most: float = 3e4) -> T:
    """Let what shines brightly in all `Frame`s of a pytree shine as lamps do.

    Radiance whose largest channel p is over `above` is multiplied by (p / above)^power, up to `most`; all other stays
    bit for bit, and so does radiance that is beyond that anyway. It is a function of the radiance alone, so that what
    moves looks the same in every frame.

    Args:
        tree: a `Frame`, a `Window`, or any pytree that holds such; leading axes of colours are free.
        power: 0 changes nothing.
        above: the radiance from which on it shines, over 0.
        most: the largest radiance that comes of it, over `above`.
    """

    def one(value: Any) -> Any:
        if not isinstance(value, Frame) or value.color is None:
            return value
        color = jnp.asarray(value.color)
        peak = jnp.max(color, -1, keepdims=True)
        bright = (peak > above) & (peak < most)
        peak = jnp.where(bright, peak, above)
        gain = jnp.minimum(jnp.exp(jnp.asarray(power, color.dtype) * jnp.log(peak / above)), most / peak)
        return replace(value, color=color * jnp.where(bright, gain, 1))

    return jax.tree.map(one, tree, is_leaf=lambda value: isinstance(value, Frame))


def crop(tree: T, key: PRNGKeyArray, *, size: Size, weight: Float[Array, "h w 1"] | None = None) -> T:
    """Cut the same random rectangle of `size` `(H, W)` out of all images `[H, W, ...]` of a pytree.

    Every leaf is one. Cut what has been warped, not what is still to be warped: motion leads out of a crop.

    Args:
        tree: images of one size.
        key: of the position, which is uniform over all those inside the frame.
        size: of the crop.
        weight: how likely a pixel is the one around which the crop is laid, anywhere in it and inside the frame; not
            negative. What has no weight is almost never chosen.

    Raises:
        ValueError: leaves of different sizes, or smaller than `size`.
    """
    shapes = {jnp.shape(leaf)[:2] for leaf in jax.tree.leaves(tree)}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        raise ValueError(f"tree: expected images of one size, got {sorted(shapes)}")
    (whole,) = shapes
    if whole[0] < size[0] or whole[1] < size[1]:
        raise ValueError(f"size: expected at most the images' {list(whole)}, got {list(size)}")
    room = jnp.array([whole[0] - size[0] + 1, whole[1] - size[1] + 1], jnp.int32)
    if weight is None:
        top, left = jax.random.randint(key, (2,), 0, room, jnp.int32)
    else:
        choice, shift = jax.random.split(key)
        total = jnp.cumsum(jnp.where(jnp.isfinite(weight), weight, 0).reshape(-1) + _LEAST)
        chosen = jnp.searchsorted(total, total[-1] * jax.random.uniform(choice, (), total.dtype))
        before = jax.random.randint(shift, (2,), 0, jnp.array(size, jnp.int32), jnp.int32)
        place = jnp.array(jnp.unravel_index(chosen, whole), jnp.int32) - before
        top, left = jnp.clip(place, 0, room - 1)

    def cut(image: Array) -> Array:
        zeros = (jnp.int32(0),) * (image.ndim - 2)
        return jax.lax.dynamic_slice(image, (top, left, *zeros), (*size, *image.shape[2:]))

    return jax.tree.map(cut, tree)
