"""A memory of what rendered frames have shown and the newest hides, carried from frame to frame.

Each rendered frame hides some of what the one before it showed. Those points are kept, behind its surfaces and around
its border (`jaxtrapolate.ops.layered`), with their light; so are those that were kept before. What a generated frame
shows and no frame that it is handed has seen may be among them.
"""

import dataclasses
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxtrapolate.checks import Size
from jaxtrapolate.methods.frames import Frames, newest_color, rendered
from jaxtrapolate.methods.hindsight import from_blocks
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.methods.stages import reflecting
from jaxtrapolate.ops.layered import HiddenLayer, Landed, Points, advanced, from_layer, margins, no_points
from jaxtrapolate.ops.projection import fitted_projection
from jaxtrapolate.ops.radiance import demodulation_divisor
from jaxtrapolate.ops.warp import pixel_grid
from jaxtrapolate.precision import divide, widest
from jaxtrapolate.records import Frame, GBuffer, record, replace

MISSES = 0.25  # pixels: a frame whose positions no camera explains
_SCENE = 0.1  # of what lands in a frame: less of it is found there after a cut
_ASKED = 4096  # points, of how all light has changed
_ROUGH = 0.3  # less rough, light depends on where it is seen from
_BLOCK = 8  # pixels, of a block
_EVIDENCE = 4  # points around a block say how light has changed
_STEP = 7.0  # of the logarithm: so much light changes from one frame to the next at most
_BRIGHTEST = 1e9
_DARKEST = 1e-3  # light under which a ratio says nothing
_DIFFERS = 0.5  # of the logarithm: light that is so much other is another's


def surfaces_of(buffers: GBuffer) -> Array:
    """Where a surface is, bool `[H, W, 1]`."""
    position = cast(Array, buffers.position)
    there = jnp.all(jnp.isfinite(position), -1, keepdims=True)
    if buffers.sky is not None:
        there &= buffers.sky < 0.5
    return there if buffers.depth is None else there & (buffers.depth < jnp.inf)


def points_of(buffers: GBuffer, values: Array, known: Array) -> Points:
    """A frame's pixels as points; without positions none."""
    position = cast(Array, buffers.position)
    dtype = widest(values)
    normal = jnp.zeros_like(position) if buffers.normal is None else buffers.normal
    position, normal = (jnp.nan_to_num(a).astype(dtype) for a in (position, normal))
    return Points(position, normal, values.astype(dtype), known)


@record
@dataclasses.dataclass(frozen=True)
class Memory:
    """What is kept from frame to frame.

    Attributes:
        layer: what the newest rendered frame hides: light, then what reflects it.
        restless: bool `[H, W, 1]`, where the light on what that frame shows has changed while it was seen.
    """

    layer: HiddenLayer
    restless: Bool[Array, "h w 1"]


def start(history: Frames, target: Frame) -> Memory:
    """`Method.start`: nothing has been seen yet."""
    color = newest_color(history, target)
    size = color.shape[0], color.shape[1]
    return Memory(no_points(size, 6, widest(color)), jnp.zeros((*size, 1), bool))


def _shown(how: Any, frame: Frame) -> Points:
    """What a rendered frame shows: its light and what reflects it."""
    buffers, color = cast(GBuffer, frame.gbuffer), jnp.asarray(frame.color)
    known = surfaces_of(buffers) & jnp.all(jnp.isfinite(color), -1, keepdims=True)
    divisor = jnp.ones_like(color)
    if buffers.albedo is not None:
        divisor = demodulation_divisor(reflecting(buffers, how.sky), by=how.by, floor=how.floor).astype(color.dtype)
    return points_of(buffers, jnp.concatenate([divide(color, divisor), divisor], -1), known)


def _brighter(points: Landed) -> Array:
    """By which factor light has changed in most places `[3]`: the median, of some thousand points."""
    step = -(-points.same.shape[0] // _ASKED)
    before, now, both = (a[::step] for a in (points.values[:, :3], points.shown[:, :3], points.same[:, None]))
    usual = both & (before > 0) & (now > 0)
    ratios = jnp.where(usual, jnp.log(jnp.where(usual, divide(now, before), 1)), jnp.inf)
    middle = jnp.sum(usual, 0, keepdims=True) // 2
    median = jnp.take_along_axis(jnp.sort(ratios, 0), middle.astype(jnp.int32), 0)[0]
    return jnp.where(jnp.isfinite(median), jnp.exp(jnp.clip(median, -_STEP, _STEP)), 1)


def _off(points: Landed, usual: Array) -> Array:
    """How much the light that is shown differs from what is known and `usual` `[3]`: `[N, 1]`, of its logarithm."""
    now, then = (jnp.clip(a[:, :3], 0, 1e6) + _DARKEST for a in (points.shown, usual[None] * points.values[:, :3]))
    return jnp.mean(jnp.abs(jnp.log(divide(now, then))), -1, keepdims=True)


def _restless(points: Landed, before: Array, usual: Array) -> Array:
    """Where a frame shows what has been seen to change its light, and beside it, bool `[H, W, 1]`."""
    changed = points.same & (before.reshape(-1) | (_off(points, usual)[:, 0] > _DIFFERS))
    marked = jnp.zeros(before.size, jnp.float32).at[points.index].max(changed.astype(jnp.float32))
    window = jax.lax.reduce_window(marked.reshape(before.shape), -jnp.inf, jax.lax.max, (3, 3, 1), (1, 1, 1), "SAME")
    return window > 0


def _as_reappeared(points: Landed, size: Size, usual: Array) -> tuple[Array, Array]:
    """By which factor light differs from what was remembered, `[I, J, 3]`, and where it may be believed, `[I, J, 1]`.

    The mean over blocks of 8 x 8 pixels and those around each, of points that are seen again; on the raster of the
    layer, bilinear. Where none is seen again the factor is `usual` `[3]`. Where those that are differ much from what
    that says, light goes its own ways: shadows have come or gone, and what else is remembered there says nothing.
    """
    blocks = rows, columns = tuple(-(-n // _BLOCK) for n in size)
    row, column = points.index // size[1] // _BLOCK, points.index % size[1] // _BLOCK
    cell = jnp.where(points.same, row * columns + column, rows * columns)
    now, then = (jnp.where(points.same[:, None], jnp.clip(a[:, :3], 0, 1e6), 0) for a in (points.shown, points.values))
    off = jnp.where(points.same[:, None], _off(points, usual), 0)
    given = jnp.concatenate([now, then, off, jnp.ones_like(off)], -1)
    sums = jnp.zeros((rows * columns + 1, 8), given.dtype).at[cell].add(given, mode="promise_in_bounds")[:-1]
    padded = jnp.pad(sums.reshape(*blocks, 8), ((1, 1), (1, 1), (0, 0)))
    around = padded[:-2] + padded[1:-1] + padded[2:]
    around = around[:, :-2] + around[:, 1:-1] + around[:, 2:]
    count = around[..., 7:]
    factor = divide(around[..., :3] + _DARKEST * count, around[..., 3:6] + _DARKEST * count)
    enough = count >= _EVIDENCE
    other = jnp.where(enough, jnp.log(divide(factor, usual[None, None], otherwise=1)), 0)
    wrong = enough & (around[..., 6:7] > _DIFFERS * count)
    down, across = margins(size)
    x, y = pixel_grid(size[0] + 2 * down, size[1] + 2 * across, given.dtype)
    x, y = jnp.broadcast_arrays(x - across, y - down)
    other = jnp.clip(other, -_DIFFERS, _DIFFERS)
    found = from_blocks(jnp.concatenate([other, wrong.astype(given.dtype)], -1), x, y)
    return usual[None, None] * jnp.exp(found[..., :3]), found[..., 3:] < 0.5


def _remember(how: Any, state, values: Values):
    history, target, memory = values["history"], values["target"], values["carry"]
    how = how or state.settings
    source = history[rendered(history)[0]]
    newest, before = _shown(how, target), _shown(how, source)
    known, lasting = before.known, ~memory.restless
    if source.gbuffer.stencil is not None:
        known &= source.gbuffer.stencil < 0.5
    if source.gbuffer.roughness is not None:
        lasting &= source.gbuffer.roughness >= _ROUGH
    matrix, misses = fitted_projection(target.gbuffer.position, newest.known[..., 0])
    matrix = jnp.where(misses < MISSES, matrix, 0).astype(memory.layer.matrix.dtype)
    layer, again, still = advanced(memory.layer, replace(before, known=known), newest, matrix, lasting)
    found, landed = (jnp.sum(a.astype(jnp.float32)) for a in (still.same, still.inside))
    usual = _brighter(still)
    light, believed = _as_reappeared(again, (known.shape[0], known.shape[1]), usual)
    same_scene = found > _SCENE * landed
    points = layer.points
    light = jnp.clip(points.values[..., :3] * light, -_BRIGHTEST, _BRIGHTEST)
    changed = jnp.concatenate([light, points.values[..., 3:]], -1)
    points = replace(points, values=changed, known=points.known & believed & same_scene)
    restless = _restless(still, memory.restless, usual) & same_scene
    return {"carry": Memory(HiddenLayer(points, matrix), restless), "image": values["image"]}


def recall(target: GBuffer, memory: Memory, *, divided: bool, channels: int) -> tuple[Array, Array]:
    """What is remembered of the target's surfaces, as "warped" has it, and where, bool `[H, W, 1]`.

    Args:
        target: with position.
        memory: of the newest rendered frame.
        divided: whether light is divided by the reflectance.
        channels: of "warped": 3, or 6 if the undivided colour follows.
    """
    known = surfaces_of(target)
    if target.stencil is not None:
        known &= target.stencil < 0.5
    position = cast(Array, target.position)
    found, seen = from_layer(memory.layer, points_of(target, jnp.zeros_like(position[..., :1]), known))
    light, reflectance = found[..., :3], found[..., 3:]
    color = light * reflectance
    return jnp.concatenate([light if divided else color, color], -1)[..., :channels], seen


def remember_stage(how: Any = None) -> Stage:
    """Keeps what the rendered frame before showed and this one hides, and forgets all after a cut.

    What moves by itself, what mirrors, and where light has been seen to change is not kept. Light that changes
    elsewhere is followed: as it has where points nearby are seen again, or else as in most places of the frame.

    Args:
        how: has by, floor and sky, as `Demodulation`; `None` = the method's options.
    """
    return Stage(
        "remember",
        partial(_remember, how),
        takes=("history", "target", "carry", "image"),
        gives=("carry", "image"),
        reads=("target.position", "newest.position"),
        optional=True,
        past=1,
        on="rendered",
    )
