"""Rays against all primitives of a scene: the first hit, the blocking of lights, the nearness of other surfaces.

Each function loops over the primitives of one shape after the other, with planar arrays of rays. The state of a loop is
one array: XLA's CPU compiler compiles one kernel for each output of a step and would compute the intersection in each.
A primitive never hides or shadows itself, being convex, so a ray that leaves a surface needs no offset: it is told
which primitive it leaves (`own`).
"""

import dataclasses
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrapolate.records import record
from jaxtrapolate.scenes.field import HeightField, enter_field, field_distance, field_gap
from jaxtrapolate.scenes.kinematics import Pose
from jaxtrapolate.scenes.primitives import DISTANCE, ENTER, GAP, KINDS
from jaxtrapolate.scenes.scene import LIMIT, Scene
from jaxtrapolate.scenes.vector import Vector, rotate_back


def stage(function: Callable) -> Callable:
    """`function` as one stage of the renderer, whose results are kept: no later stage computes them again.

    XLA's CPU compiler duplicates cheap operations into every kernel that reads them, over any number of stages, and
    drops optimization barriers before it does so. It does not look into the branches of a conditional. The predicate is
    always true, which the barrier hides until it is too late to simplify; being unbatched, it stays a conditional under
    `vmap`.
    """

    def staged(*args: Any) -> Any:
        go = jax.lax.optimization_barrier(jnp.asarray(True))
        shapes = jax.eval_shape(function, *args)
        nothing = lambda *_: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)  # noqa: E731
        return jax.lax.cond(go, function, nothing, *args)

    return staged


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Placed:
    """A scene's primitives in the world at one time.

    rotation `[P, 3, 3]`, centre `[P, 3]`: pose in the world; size `[P, 3]`; active `[P]`: 0 = left out. poses: of the
    bodies. counts: (aside, static, dynamic) primitives of each kind; see `Scene`.
    """

    rotation: Float[Array, "p 3 3"]
    centre: Float[Array, "p 3"]
    size: Float[Array, "p 3"]
    active: Float[Array, " p"]
    poses: Pose
    field: HeightField | None
    counts: tuple[tuple[int, int, int], ...] = dataclasses.field(metadata={"static": True})

    @property
    def number(self) -> int:
        """How many primitives there are, which is the number of the height field."""
        return sum(map(sum, self.counts))

    def kinds(self) -> np.ndarray:
        """The shape of each primitive, an index into `KINDS`; a height field has a plane's."""
        kinds = np.repeat(np.arange(len(KINDS), dtype=np.int32), [sum(pair) for pair in self.counts])
        return kinds if self.field is None else np.append(kinds, np.int32(0))


@record
@dataclasses.dataclass(frozen=True)
class Hit:
    """t: distance in units of the ray's direction, infinite where nothing is hit; primitive: its number, int32."""

    t: Any
    primitive: Any


def place(scene: Scene, time: Float[Array, ""], hidden: Bool[Array, " b"] | None = None) -> Placed:
    """The primitives at `time`; `hidden`: the bodies that are left out."""
    poses = scene.bodies.at(time)
    body = np.asarray(scene.body)
    world = Pose(poses.rotation[body], poses.translation[body]).compose(Pose(scene.rotation, scene.centre))
    active = jnp.ones(len(body), jnp.float32) if hidden is None else 1.0 - hidden[body].astype(jnp.float32)
    return Placed(world.rotation, world.translation, scene.size, active, poses, scene.field, counts=scene.counts)


def _fold(placed: Placed, step: Callable, state: Array, *, groups: tuple[int, ...] = (0, 1, 2)) -> Array:
    """state = step(kind, state, row) over the primitives of adjacent groups of `counts`; one loop for each kind."""
    first = 0
    for kind, counts in zip(KINDS, placed.counts, strict=True):
        rows = slice(first + sum(counts[: groups[0]]), first + sum(counts[: groups[-1] + 1]))
        if rows.stop > rows.start:
            numbers = jnp.arange(rows.start, rows.stop, dtype=jnp.int32)
            table = (placed.rotation[rows], placed.centre[rows], placed.size[rows], placed.active[rows], numbers)

            def body(state: Array, row: tuple, kind: str = kind) -> tuple[Array, None]:
                return step(kind, state, row), None

            state, _ = jax.lax.scan(body, state, table)
        first += sum(counts)
    return state


def _into(row: tuple, p: Vector, d: Vector | None = None) -> tuple:
    rotation, centre = row[0], row[1]
    local = rotate_back(rotation, p - Vector(centre[0], centre[1], centre[2]))
    size = Vector(row[2][0], row[2][1], row[2][2])
    return (local, size) if d is None else (local, rotate_back(rotation, d), size)


def first_hit(placed: Placed, o: Vector, d: Vector, own: Array | int = -1) -> Hit:
    """The nearest primitive that each ray enters, but for its `own`.

    The loop keeps t and the number in one integer, t to 2^-16 of itself: surfaces closer to each other than that are in
    no order. The t that is returned is that of the primitive found, in full precision.
    """
    shape = jnp.broadcast_shapes(jnp.shape(o.x), jnp.shape(d.x), jnp.shape(own))
    nothing = jnp.int32(0x7F800000 | LIMIT)

    def pack(t: Array, number: Any) -> Array:
        return (jax.lax.bitcast_convert_type(t, jnp.int32) & jnp.int32(~127)) | number

    def step(kind: str, nearest: Array, row: tuple) -> Array:
        t = ENTER[kind](*_into(row, o, d))
        key = jnp.where((row[3] > 0) & (row[4] != own), pack(t, row[4]), nothing)
        return jnp.minimum(nearest, key)

    nearest = _fold(placed, step, jnp.full(shape, nothing))
    number = placed.number
    if placed.field is not None:
        t_field = enter_field(placed.field, o, d) + jnp.zeros(shape, jnp.float32)
        nearest = jnp.minimum(nearest, jnp.where(own != number, pack(t_field, number), nothing))
    found = nearest < jnp.int32(0x7F800000)
    primitive = jnp.where(found, nearest & 127, 0)

    def pick(column: Array) -> Array:
        return column.at[jnp.minimum(primitive, number - 1)].get(mode="promise_in_bounds")

    rotation = tuple(tuple(pick(placed.rotation[:, i, j]) for j in range(3)) for i in range(3))
    row = (
        rotation,
        tuple(pick(placed.centre[:, i]) for i in range(3)),
        tuple(pick(placed.size[:, i]) for i in range(3)),
    )
    local, direction, size = _into(row, o, d)
    kinds = jnp.asarray(placed.kinds()).at[primitive].get(mode="promise_in_bounds")
    t = jnp.zeros(shape, jnp.float32)
    for index, (kind, pair) in enumerate(zip(KINDS, placed.counts, strict=True)):
        if sum(pair):
            t = jnp.where(kinds == index, ENTER[kind](local, direction, size), t)
    if placed.field is not None:
        t = jnp.where(primitive == number, t_field, t)
    return Hit(jnp.where(found, t, jnp.inf), primitive)


def light_visibility(
    placed: Placed, o: Vector, d: Vector, own: Array, *, near: bool, softness: Array
) -> tuple[Array, Array]:
    """(static, dynamic): the part of a light that static and that dynamic primitives let through, 0..1.

    d: towards the light; near: the light is at t = 1, else infinitely far. softness: half width of the light's cone a
    unit of t; the light fades over it as its edge passes that of the shape, and the most opaque primitive counts. With
    softness 0 this is the exact ray test.
    """
    end = 1.0 if near else jnp.inf

    def step(kind: str, state: Array, row: tuple) -> Array:
        t, gap = GAP[kind](*_into(row, o, d))
        through = jnp.clip(0.5 + 0.5 * gap / jnp.maximum(t * softness, 1e-6), 0.0, 1.0)
        counts = (t > 0) & (t < end) & (row[3] > 0) & (row[4] != own)
        return jnp.minimum(state, jnp.where(counts, through, 1.0))

    static = _fold(placed, step, jnp.ones_like(o.x), groups=(1,))
    dynamic = _fold(placed, step, jnp.ones_like(o.x), groups=(2,))
    if placed.field is not None:
        # A terrain does shadow itself: its rays start a little above it.
        lifted = Vector(o.x, o.y, o.z + jnp.where(own == placed.number, 2e-3, 0.0))
        gap = field_gap(placed.field, lifted, d, jnp.maximum(softness, 4e-3))
        static = jnp.minimum(static, jnp.clip(0.5 + 0.5 * gap, 0.0, 1.0))
    return static, dynamic


def openness(placed: Placed, p: Vector, normal: Vector, own: Array, heights: tuple[float, ...]) -> Array:
    """How free the hemisphere above `p` is, 1 = free, from the distance to other primitives at some heights above it.

    A cheap ambient occlusion (Evans, "Fast Approximations for Global Illumination on Dynamic Scenes", 2006): the most
    occluding primitive at the most occluded height counts.
    """
    points = [p + normal * height for height in heights]

    def free(distance: Callable[[Vector], Array]) -> Array:
        parts = [jnp.clip(distance(point) / height, 0.0, 1.0) for point, height in zip(points, heights, strict=True)]
        total = cast(Array, sum(parts))  # `heights` is not empty, so that it is not the int 0
        return 0.25 + 0.75 * total / len(parts)

    def step(kind: str, state: Array, row: tuple) -> Array:
        counts = (row[3] > 0) & (row[4] != own)
        return jnp.minimum(state, jnp.where(counts, free(lambda point: DISTANCE[kind](*_into(row, point))), 1.0))

    result = _fold(placed, step, jnp.ones_like(p.x))
    if placed.field is not None:
        below = free(lambda point: field_distance(placed.field, point))  # type: ignore[arg-type]
        result = jnp.minimum(result, jnp.where(own != placed.number, below, 1.0))
    return result
