"""The renderer: a frame with every buffer, exact flow between any two times, exact visibility.

Everything is a pure function of the scene's parameters and of time: jit, vmap and any device.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrapolate.records import Frame, GBuffer, Keyframe
from jaxtrapolate.scenes import shading
from jaxtrapolate.scenes.casting import Hit, Placed, first_hit, openness, place, stage
from jaxtrapolate.scenes.kinematics import Pose
from jaxtrapolate.scenes.scene import Lights, Scene, Sky
from jaxtrapolate.scenes.vector import Vector, mix, rotate, select, vector
from jaxtrapolate.scenes.view import (
    FAR,
    Pixels,
    View,
    inside,
    matrices,
    origin,
    pixel_steps,
    project,
    ray_directions,
    view_at,
)

Size = tuple[int, int]
Time = int | float | Float[Array, ""]

OPENNESS_HEIGHTS = (0.12, 0.45)
"""Metres above a surface at which the ambient light's occlusion is measured."""

_PACKS = 8
_OBJECTS = 40  # that matrices are made for at least: as many as the fullest scene has, and a few more
"""Into how many packs the pixels of a frame are divided when reflections are traced, each with its own bounce."""


def render(
    scene: Scene,
    time: Time,
    *,
    size: Size,
    samples: int = 1,
    shadows_of_dynamic: bool = True,
    leave_out: Sequence[int] = (),
    jitter: Float[Array, "2"] | None = None,
    previous_time: Time | None = None,
) -> Frame:
    """The frame at `time`: linear radiance, every buffer, the camera, and exact motion to the frame at `previous_time`.

    Args:
        scene: from `scene`; parameters may be traced and batched.
        time: in frames, any real number.
        size: `(H, W)`, static.
        samples: colour samples a pixel, static; 1 = the pixel centre's, with hard edges and textures filtered over the
            pixel; more = an antialiased reference, averaged over a low-discrepancy pattern. Buffers stay the centre's.
        shadows_of_dynamic: static; False = dynamic objects cast no shadows (and the shadow buffer is 0).
        leave_out: stencil ids of the dynamic objects that are left out, their shadows and reflections too.
        jitter: in pixels: colour and buffers are those at p + jitter; the motion stays unjittered.
        previous_time: of the frame that the motion leads to; time - 1 by default.

    Convention:
        See `records`. At the sky: sky 1, depth `FAR`, position at that depth, normal, albedo, n_dot_v 0, roughness 1,
        motion that of a point at infinity. The motion of a point that is behind the previous camera leads four frames
        outside. normal is the geometry's, without water's ripples. sky_color is 0 off the sky.
    """
    _check(size, samples)
    time = jnp.asarray(time, jnp.float32)
    previous = time - 1 if previous_time is None else jnp.asarray(previous_time, jnp.float32)
    hidden = jnp.isin(scene.bodies.stencil, jnp.asarray(tuple(leave_out), jnp.float32))
    return _render(scene, time, previous, hidden, jitter, size=size, samples=samples, shadowed=shadows_of_dynamic)


def flow(scene: Scene, time_from: Time, time_to: Time, *, size: Size) -> Float[Array, "h w 3"]:
    """Exact 3D flow of the surfaces seen at `time_from`: x and y in pixels to add, then the change of depth in metres.

    The sky moves as a direction at infinity does; its depth does not change. Points behind the other camera lead four
    frames outside.
    """
    _check(size, 1)
    return _flow(scene, jnp.asarray(time_from, jnp.float32), jnp.asarray(time_to, jnp.float32), size=size)


def visible(scene: Scene, time_from: Time, time_to: Time, *, size: Size) -> Bool[Array, "h w"]:
    """Whether the surface point seen at a pixel's centre at `time_from` is seen at `time_to` as well.

    It is where it lands inside the frame, faces the camera, and no primitive is nearer on the ray from the camera to
    it.
    """
    _check(size, 1)
    return _visible(scene, jnp.asarray(time_from, jnp.float32), jnp.asarray(time_to, jnp.float32), size=size)


def keyframe(scene: Scene, time: Time, *, size: Size, next_time: Time, previous_time: Time) -> Keyframe:
    """The I-frame at `time` with its exact flows to the I-frames at `next_time` and `previous_time`."""
    frame = render(scene, time, size=size, previous_time=previous_time)
    return Keyframe(
        color=frame.color,
        depth=frame.gbuffer.depth,  # type: ignore[union-attr]
        stencil=frame.gbuffer.stencil,  # type: ignore[union-attr]
        forward_flow=flow(scene, time, next_time, size=size),
        backward_flow=flow(scene, time, previous_time, size=size),
        time=jnp.asarray(time, jnp.float32),
    )


def _check(size: Size, samples: int) -> None:
    if len(size) != 2 or min(size) < 1:
        raise ValueError(f"size: expected (H, W) of at least 1, got {size!r}")
    if samples < 1:
        raise ValueError(f"samples: expected at least 1, got {samples!r}")


def _grid(size: Size) -> tuple[Array, Array]:
    x = jnp.broadcast_to(jnp.arange(size[1], dtype=jnp.float32), size)
    y = jnp.broadcast_to(jnp.arange(size[0], dtype=jnp.float32)[:, None], size)
    return x, y


def _both(
    scene: Scene, time: Array, other: Array, size: Size, hidden: Array | None = None
) -> tuple[tuple[View, View], tuple[Placed, Placed]]:
    """Views and placed primitives at two times.

    A loop, because XLA's CPU compiler keeps a loop's results, and would compute anything else anew in every pixel.
    """

    def at(moment: Array) -> tuple[View, Placed]:
        return view_at(scene.camera, moment, size), place(scene, moment, hidden)

    views, placed = jax.lax.map(at, jnp.stack([time, other]))
    return tuple(  # type: ignore[return-value]
        tuple(jax.tree.map(lambda leaf, k=k: leaf[k], tree) for k in range(2)) for tree in (views, placed)
    )


def _primary(scene: Scene, placed: Placed, view: View, x: Array, y: Array) -> tuple[Vector, Hit]:
    d = stage(ray_directions)(view, x, y)
    return d, stage(first_hit)(placed, origin(view), d)


def _moved(scene: Scene, before: Pose, after: Pose, body: Array, point: Vector) -> tuple[Vector, Array]:
    """World points on bodies, carried from one pose to another; `(point, dynamic)`. Static points stay bit for bit."""
    relative = after.compose(before.inverse())

    def pick(column: Array) -> Array:
        return column.at[body].get(mode="promise_in_bounds")

    dynamic = pick(scene.bodies.stencil) > 0
    rows = tuple(tuple(pick(relative.rotation[:, i, j]) for j in range(3)) for i in range(3))
    offset = Vector(*(pick(relative.translation[:, i]) for i in range(3)))
    return select(dynamic, rotate(rows, point) + offset, point), dynamic


def _reprojected(
    scene: Scene, views: tuple[View, View], poses: tuple[Pose, Pose], hit: Array, body: Array, point: Vector, d: Vector
) -> tuple[Vector, Pixels, Pixels]:
    """(moved, there, here): points at the other time, and where they are seen then and now; the sky's by direction."""
    moved, _ = _moved(scene, *poses, body, point)
    there = project(views[1], select(hit, moved, d), at_infinity=~hit)
    here = project(views[0], select(hit, point, d), at_infinity=~hit)
    return moved, there, here


def _color(
    scene: Scene, placed: Placed, time: Array, view: View, d: Vector, hit: Hit, footprint: float, shadowed: bool
) -> tuple[Vector, shading.Surface, Array]:
    """(radiance, surface, shadow) of primary rays; footprint: edge of a sample's area in pixels."""
    steps = [step * footprint for step in pixel_steps(view)]

    def primary_spread(t: Array, n: Vector) -> list[Vector]:
        slant = jnp.minimum(n.dot(d), -0.02 * d.length())
        return [(step - d * (n.dot(step) / slant)) * t for step in steps]

    s = shading.surface(scene, placed, time, origin(view), d, hit, primary_spread)
    ray = d.normalized()
    n = stage(shading.rippled)(s, time) if scene.water else s.normal
    direct, shadow = shading.direct_light(scene, placed, time, s, n, -ray, shadows_of_dynamic=shadowed)

    free = openness(placed, s.position, s.normal, s.primitive, OPENNESS_HEIGHTS)
    mirrored = stage(_mirror)(ray, n, s.normal)
    traced = _traced(scene, placed, time, s, mirrored, view, shadowed) if scene.bounce else None
    parts = (scene.sky, scene.lights, s, hit.t, d, n, mirrored, free, direct, shading.reflectance(s), traced)
    color = stage(_combine)(*parts)
    return color, s, jnp.where(s.hit, shadow, 0.0)


def _mirror(ray: Vector, n: Vector, geometric: Vector) -> Vector:
    """The reflected direction, lifted over the horizon of the surface where a bent normal takes it below."""
    mirrored = ray - n * (2 * ray.dot(n))
    return (mirrored + geometric * jnp.maximum(0.01 - mirrored.dot(geometric), 0.0)).normalized()


def _combine(
    sky: Sky,
    lights: Lights,
    s: shading.Surface,
    t: Array,
    d: Vector,
    n: Vector,
    mirrored: Vector,
    free: Array,
    direct: Vector,
    r: shading.Reflectance,
    traced: Vector | None,
) -> Vector:
    """The radiance of primary rays from its parts."""
    ambient = shading.sky_irradiance(sky, n)
    clear = shading.sky_radiance(sky, lights, mirrored, jnp.zeros_like(s.width), sun=False)
    environment = mix(clear * sky.ambient, ambient, jnp.clip(s.roughness, 0.0, 1.0)) * free
    if traced is not None:
        weight = jnp.clip((shading.ROUGH - s.roughness) / (shading.ROUGH - shading.SMOOTH), 0.0, 1.0)
        environment = mix(environment, traced, weight)
    gain = shading.environment_gain(r, jnp.clip(-d.normalized().dot(n), 0.0, 1.0))
    color = direct + s.emission + r.diffuse * ambient * free + environment * gain
    horizon = Vector(*(sky.horizon[k] for k in range(3)))
    color = mix(horizon, color, jnp.exp(-sky.haze * jnp.where(s.hit, t, 0.0)))
    return select(s.hit, color, shading.sky_radiance(sky, lights, d, s.cloud, sun=True))


def _traced(
    scene: Scene, placed: Placed, time: Array, s: shading.Surface, ray: Vector, view: View, shadowed: bool
) -> Vector:
    """`_bounce` where the surface is smooth enough for it to count, 0 elsewhere: packs of such pixels, one by one.

    What a pack reads and writes is gathered and scattered; a frame without a mirror costs nothing.
    """
    shape = s.width.shape
    total = math.prod(shape)
    pack = -(-total // _PACKS)
    needed = (s.hit & (s.roughness < shading.ROUGH)).reshape(-1)
    place = jnp.cumsum(needed, dtype=jnp.int32)
    count = place[-1]
    # order[k] is the k-th pixel that needs a bounce; what needs none goes to a slot that nobody reads
    pixels = jnp.arange(total, dtype=jnp.int32)
    order = jnp.zeros(_PACKS * pack + 1, jnp.int32).at[jnp.where(needed, place - 1, _PACKS * pack)].set(pixels)
    given = (s.position, s.primitive, s.roughness, s.width, ray)
    table = jax.tree.map(lambda leaf: leaf.reshape(-1), given)

    def one(number: Array, colors: Vector) -> Vector:
        first = number * pack
        taken = jax.lax.dynamic_slice(order, (first,), (pack,))
        rows = jax.tree.map(lambda leaf: leaf.at[taken].get(mode="promise_in_bounds"), table)
        position, primitive, roughness, width, mirrored = rows
        found = _bounce(scene, placed, time, position, primitive, roughness, width, mirrored, view, shadowed)
        at = jnp.where(first + jnp.arange(pack, dtype=jnp.int32) < count, taken, total)
        return jax.tree.map(lambda leaf, value: leaf.at[at].set(value, mode="drop"), colors, found)

    zero = vector(jnp.zeros(total, jnp.float32))
    return jax.lax.fori_loop(0, -(-count // pack), one, zero).map(lambda leaf: leaf.reshape(shape))


def _bounce(
    scene: Scene,
    placed: Placed,
    time: Array,
    position: Vector,
    primitive: Array,
    roughness: Array,
    width: Array,
    ray: Vector,
    view: View,
    shadowed: bool,
) -> Vector:
    """What a mirrored ray sees: lit surfaces and the sky, their textures blurred by the roughness of the mirror."""
    hit = stage(first_hit)(placed, position, ray, primitive)
    growth = 1.0 / view.scale[0] + 0.7 * roughness**2
    helper = select(jnp.abs(ray.x) < 0.7, Vector(1.0, 0.0, 0.0), Vector(0.0, 1.0, 0.0))
    zero = jnp.zeros_like(ray.x)
    helper = Vector(helper.x + zero, helper.y + zero, helper.z + zero)
    first = (helper - ray * ray.dot(helper)).normalized()
    second = ray.cross(first)

    def spread(t: Array, n: Vector) -> list[Vector]:
        slant = jnp.minimum(n.dot(ray), -0.05)
        grown = width + t * growth
        return [(edge - ray * (n.dot(edge) / slant)) * grown for edge in (first, second)]

    s2 = shading.surface(scene, placed, time, position, ray, hit, spread)
    direct, _ = shading.direct_light(scene, placed, time, s2, s2.normal, -ray, shadows_of_dynamic=shadowed)

    @stage
    def combine(s2: shading.Surface, r: shading.Reflectance, direct: Vector, ray: Vector) -> Vector:
        ambient = shading.sky_irradiance(scene.sky, s2.normal)
        gain = shading.environment_gain(r, jnp.clip(-ray.dot(s2.normal), 0.0, 1.0))
        color = direct + s2.emission + ambient * r.diffuse + ambient * gain
        return select(s2.hit, color, shading.sky_radiance(scene.sky, scene.lights, ray, s2.cloud, sun=False))

    return combine(s2, shading.reflectance(s2), direct, ray)


def _offsets(samples: int) -> np.ndarray:
    """Low-discrepancy offsets `[S, 2]` in -0.5..0.5 (Roberts' R2 sequence)."""
    k = np.arange(1, samples + 1)[:, None]
    return ((k * np.array([0.7548776662466927, 0.5698402909980532]) + 0.5) % 1.0 - 0.5).astype(np.float32)


@functools.partial(jax.jit, static_argnames=("size", "samples", "shadowed"))
def _render(
    scene: Scene,
    time: Array,
    previous: Array,
    hidden: Array,
    jitter: Array | None,
    *,
    size: Size,
    samples: int,
    shadowed: bool,
) -> Frame:
    (view, view_before), (placed, placed_before) = _both(scene, time, previous, size, hidden)
    x, y = _grid(size)
    if jitter is not None:
        x, y = x + jitter[0], y + jitter[1]
    d, hit = _primary(scene, placed, view, x, y)
    color, s, shadow = _color(scene, placed, time, view, d, hit, 1.0 / samples**0.5, shadowed)
    if samples > 1:

        def add(total: Vector, offset: Array) -> tuple[Vector, None]:
            d, hit = _primary(scene, placed, view, x + offset[0], y + offset[1])
            return total + _color(scene, placed, time, view, d, hit, 1.0 / samples**0.5, shadowed)[0], None

        total, _ = jax.lax.scan(add, vector(jnp.zeros(size, jnp.float32)), jnp.asarray(_offsets(samples)))
        color = total * (1.0 / samples)
    poses = (placed.poses, placed_before.poses)

    # Planes first, then channels: interleaving while computing would be done point by point, not in vectors.
    @stage
    def planes(s: shading.Surface, t: Array, d: Vector, color: Vector, shadow: Array) -> dict[str, Any]:
        point = select(s.hit, s.position, origin(view) + d * FAR)
        _, there, here = _reprojected(scene, (view, view_before), poses, s.hit, s.body, point, d)
        return {
            "albedo": s.albedo,
            "depth": jnp.where(s.hit, t, FAR),
            "normal": s.normal,
            "position": point,
            "roughness": s.roughness,
            "metallic": s.metallic,
            "specular": s.specular,
            "n_dot_v": jnp.clip(-d.normalized().dot(s.normal), 0.0, 1.0),
            "stencil": jnp.where(s.hit, scene.bodies.stencil.at[s.body].get(mode="promise_in_bounds"), 0.0),
            "shadow": shadow if shadowed else jnp.zeros_like(shadow),
            "sky": 1.0 - s.hit.astype(jnp.float32),
            "sky_color": select(s.hit, vector(0.0), color),
            "motion": (there.x - here.x, there.y - here.y),
        }

    buffers = planes(s, hit.t, d, color, shadow)
    motion = jnp.stack(buffers.pop("motion"), axis=-1)
    gbuffer = {name: v.stack() if isinstance(v, Vector) else v[..., None] for name, v in buffers.items()}
    objects = _object_motion(scene, poses)
    return Frame(color.stack(), GBuffer(**gbuffer), motion, matrices(view, size), jitter, time, objects)


def _object_motion(scene: Scene, poses: tuple[Pose, Pose]) -> Array | None:
    """The map of the world now to that of the previous frame, `[N, 4, 4]`, for the ids 1 to N of the stencil.

    An object of several bodies has that of the first of them, the one that the others hang on. N is a multiple of
    `_OBJECTS`, so that what is compiled for one scene fits the others; ids that no object has stand still. `None` where
    a scene has no bodies.
    """
    if len(scene.bodies.parents) == 1:
        return None
    now, before = poses
    moved = before.compose(now.inverse())
    ids = scene.bodies.stencil
    first = jnp.argmax(ids[None, :] == jnp.arange(1, len(scene.bodies.parents), dtype=ids.dtype)[:, None], axis=1)
    top = jnp.concatenate([moved.rotation[first], moved.translation[first][..., None]], axis=-1)
    last = jnp.broadcast_to(jnp.asarray([0, 0, 0, 1], top.dtype), (*top.shape[:1], 1, 4))
    rows = jnp.concatenate([top, last], axis=-2)
    more = -len(rows) % _OBJECTS
    return jnp.concatenate([rows, jnp.broadcast_to(jnp.eye(4, dtype=rows.dtype), (more, 4, 4))])


@functools.partial(jax.jit, static_argnames=("size",))
def _flow(scene: Scene, time: Array, other: Array, *, size: Size) -> Array:
    views, (placed, placed_there) = _both(scene, time, other, size)
    d, hit = _primary(scene, placed, views[0], *_grid(size))
    found, body, point = _hit_points(scene, placed, views[0], d, hit)
    _, there, here = _reprojected(scene, views, (placed.poses, placed_there.poses), found, body, point, d)
    change = jnp.where(there.ahead, there.depth - here.depth, 0.0)
    return jnp.stack([there.x - here.x, there.y - here.y, change], axis=-1)


@functools.partial(jax.jit, static_argnames=("size",))
def _visible(scene: Scene, time: Array, other: Array, *, size: Size) -> Array:
    views, (placed, placed_there) = _both(scene, time, other, size)
    d, hit = _primary(scene, placed, views[0], *_grid(size))
    found, body, point = _hit_points(scene, placed, views[0], d, hit)
    moved, there, _ = _reprojected(scene, views, (placed.poses, placed_there.poses), found, body, point, d)
    eye = origin(views[1])
    own = jnp.where(found & (hit.primitive < placed.number), hit.primitive, -1)
    back = first_hit(placed_there, eye, select(found, moved - eye, d), own)
    clear = jnp.where(found, back.t >= 1 - 1e-3, back.t == jnp.inf)
    return inside(there, size) & clear & (~found | _faces(scene, placed, placed_there, hit, point, moved, d, eye))


def _hit_points(scene: Scene, placed: Placed, view: View, d: Vector, hit: Hit) -> tuple[Array, Array, Vector]:
    """(found, body, point) of primary rays."""
    found = hit.t < jnp.inf
    body = np.append(np.asarray(scene.body, np.int32), np.int32(0))
    point = origin(view) + d * jnp.where(found, hit.t, FAR)
    return found, jnp.asarray(body).at[hit.primitive].get(mode="promise_in_bounds"), point


def _faces(
    scene: Scene, placed: Placed, there: Placed, hit: Hit, point: Vector, moved: Vector, d: Vector, eye: Vector
) -> Array:
    """Whether the side of a primitive that is seen now is turned to the other eye, too."""
    n = shading.surface_normal(placed, hit, point, d)
    body = np.append(np.asarray(scene.body, np.int32), np.int32(0))
    relative = Pose(there.poses.rotation, there.poses.translation).compose(placed.poses.inverse())

    def pick(column: Array) -> Array:
        at = jnp.asarray(body).at[hit.primitive].get(mode="promise_in_bounds")
        return column.at[at].get(mode="promise_in_bounds")

    rows = tuple(tuple(pick(relative.rotation[:, i, j]) for j in range(3)) for i in range(3))
    return rotate(rows, n).dot(eye - moved) > 0
