"""What is hidden in the newest frame, from older frames that saw it.

Motion vectors cannot find it: at its pixel in the newest frame they belong to what is in front. Its place in the world
can: each older frame's own positions say where it shows which point (`fitted_projection`), and whether what is there is
the same surface. The newest frame that saw it is taken. Light that has changed since is carried along: by how much what
both frames show around has changed.
"""

from typing import cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrapolate.methods.frames import Frames, rendered
from jaxtrapolate.methods.hindsight import block_sums, from_blocks
from jaxtrapolate.methods.memory import MISSES, Memory, recall, surfaces_of
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.methods.space import Space, in_space
from jaxtrapolate.methods.stage import Needed, Stage, Values
from jaxtrapolate.methods.stages import find_holes
from jaxtrapolate.methods.warping import guides, guides_of
from jaxtrapolate.ops.fill import fill_pyramid
from jaxtrapolate.ops.guided import guided_warp
from jaxtrapolate.ops.motion import carried
from jaxtrapolate.ops.projection import fitted_projection, project
from jaxtrapolate.ops.warp import pixel_grid, sample
from jaxtrapolate.precision import divide, widest
from jaxtrapolate.records import Frame, GBuffer, replace

_DARKEST = 1e-3  # light under which a ratio says nothing


@settings
class Remembered:
    """Of what older frames have seen."""

    relight: float = option(4.0, "how far the light of older frames follows that around: at most this factor", low=1)


def _as_it_was(target: GBuffer, moved: Array | None) -> tuple[GBuffer, Bool[Array, "h w 1"]]:
    """The target's surfaces where they were in an older frame, and of which that is known.

    Args:
        target: its buffers.
        moved: `[N, 4, 4]`, for ids 1..N the map of the world now to the world then; `None` = unknown, nothing dynamic.
    """
    known, stencil = surfaces_of(target), target.stencil
    if stencil is None:
        return target, known
    if moved is None:
        return replace(target, stencil=None), known & (stencil < 0.5)
    matrices = jnp.concatenate([jnp.eye(4, dtype=moved.dtype)[None], moved])
    position = cast(Array, target.position)
    held = jnp.where(jnp.isfinite(position), position, 0)
    there = carried(held, matrices.astype(held.dtype), stencil)[1][..., :3]
    normal = target.normal
    if normal is not None:
        turned = matrices.at[:, :3, 3].set(0).astype(normal.dtype)
        normal = carried(normal, turned, stencil)[1][..., :3]
    buffers = replace(target, position=jnp.where(known, there, position), normal=normal, stencil=None)
    return buffers, known & (stencil < len(matrices) - 0.5)


def _moved(history: Frames, target: Frame, place: int) -> Array | None:
    """The map `[N, 4, 4]` of each object's world now to that in history[place]; `None` where a frame says nothing."""
    total = None
    for frame in (target, *history[:place:-1]):
        if frame.objects is None or (total is not None and frame.objects.shape != total.shape):
            return None
        # not a matrix product, which some GPUs take in fewer bits
        step = jnp.asarray(frame.objects)
        total = step if total is None else jnp.sum(step[:, :, :, None] * total[:, None, :, :], 2)
    return total


def seen_at(history: Frames, target: Frame, place: int) -> tuple[Float[Array, "h w 2"], Bool[Array, "h w 1"]]:
    """Where a rendered frame shows the target's surfaces: the motion to it, and where it is one that can be seen there.

    Judged by the pixel nearest to where the point was: the same position, normal and id (see `hole_masks`).

    Args:
        history: in order of display.
        target: with position.
        place: index into history of a frame with position.

    Returns:
        Pixels to add `[H, W, 2]`, 0 where nothing is known, and bool `[H, W, 1]`.
    """
    source, buffers = history[place].gbuffer, cast(GBuffer, target.gbuffer)
    source = cast(GBuffer, source)
    matrix, misses = fitted_projection(source.position, surfaces_of(source)[..., 0])
    then, known = _as_it_was(buffers, _moved(history, target, place))
    height, width = then.position.shape[:2]  # type: ignore[union-attr]
    x, y = (jnp.broadcast_to(v, (height, width)) for v in pixel_grid(height, width, matrix.dtype))
    motion = project(matrix, then.position.astype(matrix.dtype)) - jnp.stack([x, y], -1)  # type: ignore[union-attr]
    ahead = jnp.all(jnp.isfinite(motion), -1, keepdims=True)
    motion = jnp.where(ahead, motion, 0)
    seen = known & ahead & (misses < MISSES) & ~find_holes(then, replace(source, stencil=None), motion)
    if buffers.stencil is not None and source.stencil is not None:
        there = sample(source.stencil, x + motion[..., 0], y + motion[..., 1], filter="nearest")
        seen &= jnp.round(there) == jnp.round(buffers.stencil)
    return motion, seen


def _ratio(now: Array, then: Array, both: Array, most: Array) -> Array:
    """By which factor light has changed, where both images show it, and around; smooth."""
    wide = widest(now)
    usual = both & jnp.all(jnp.isfinite(now) & jnp.isfinite(then), -1, keepdims=True)
    sums = []
    for image in (now, then):
        held = jnp.where(usual, jnp.clip(image.astype(wide), 0, 1e6), 0)
        sums.append(jnp.concatenate([block_sums(held[..., k : k + 1]) for k in range(image.shape[-1])], -1))
    count = block_sums(usual.astype(wide))
    factor = divide(sums[0] + _DARKEST * count, sums[1] + _DARKEST * count, otherwise=1)
    factor = fill_pyramid(jnp.log(factor), (count > 0)[..., 0])
    height, width = now.shape[:2]
    x, y = (jnp.broadcast_to(v, (height, width)) for v in pixel_grid(height, width, wide))
    most = jnp.log(most.astype(wide))
    spread = jnp.concatenate([from_blocks(factor[..., k : k + 1], x, y) for k in range(factor.shape[-1])], -1)
    return jnp.exp(jnp.clip(spread, -most, most))


def seen_before_stage(space: Space | None = None) -> Stage:
    """Fills what is hidden in the newest frame, and what lies beyond it, from the newest older frame that saw it.

    It gives "age" too: 0 where the newest frame shows what is there, then how many frames before it that one is which
    does, and one more than are looked at where none does.

    Args:
        space: in which colours are fetched; `None` = the method's option.
    """

    def function(state, values: Values):
        how, history, target = state.settings, values["history"], values["target"]
        warped, left = values["warped"], values["holes"]
        age = jnp.zeros(left.shape, widest(warped))
        around = ~left  # whose light is compared: what stands, where ids tell it
        if target.gbuffer.stencil is not None:
            around &= target.gbuffer.stencil < 0.5
        pairs = zip(rendered(history)[1:], values["sources"][1:], values["layers"][1:], strict=False)
        for place, source, layer in pairs:
            motion, seen = seen_at(history, target, place)
            guide = guides(target.gbuffer, source.gbuffer, motion)
            sigmas = {"sigma_guide": how.sigma_guide, "sigma_space": how.sigma_space}

            def fill(warped, layer=layer, motion=motion, seen=seen, guide=guide, sigmas=sigmas, left=left):
                def fetch(image):
                    return guided_warp(image, motion, *guide, strides=(1,), keep=how.keep, **sigmas)

                found = in_space(space or how.space, fetch, layer)
                known = jnp.all(jnp.isfinite(found), -1, keepdims=True)
                found = jnp.where(known, found, 0)  # so that its gradient with respect to the factor is a number
                first, then = (image[..., :3] for image in (warped, found))
                factor = _ratio(first, then, seen & known & around, jnp.asarray(how.relight)).astype(found.dtype)
                found = jnp.concatenate([found[..., k : k + 3] * factor for k in range(0, found.shape[-1], 3)], -1)
                return jnp.where(left & seen & known, found.astype(warped.dtype), warped), known

            warped, known = jax.lax.cond(
                jnp.any(left & seen), fill, lambda warped, left=left: (warped, jnp.ones_like(left)), warped
            )
            seen &= known
            age += left.astype(age.dtype)  # once for each frame that is looked at in vain, and for the one that has it
            left = left & ~seen
        memory = values["carry"]
        if isinstance(memory, Memory):
            divided = all(f.gbuffer.albedo is not None for f in (target, *values["sources"]))
            found, seen = recall(target.gbuffer, memory, divided=divided, channels=warped.shape[-1])
            warped = jnp.where(left & seen, found.astype(warped.dtype), warped)
            left = left & ~seen
        return {"warped": warped, "image": warped[..., :3], "age": age + left.astype(age.dtype)}

    return Stage(
        "seen before",
        function,
        takes=("carry", "history", "target", "sources", "layers", "holes", "warped"),
        gives=("warped", "image", "age"),
        reads=("target.position", "history.position", guides_of("history")),
        optional=True,
        past=2,
        needed=Needed(
            "there are holes",
            lambda state, values: jnp.any(values["holes"]),
            lambda state, values: {
                "warped": values["warped"],
                "image": values["warped"][..., :3],
                "age": jnp.zeros(values["holes"].shape, widest(values["warped"])),
            },
        ),
    )
