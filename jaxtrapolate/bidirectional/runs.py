"""Many frames around rendered ones, generated one after the other: an interval's, or those of an open shutter.

Each starts its searches where those of the frame interpolated before it ended (Yang et al. 2011, section 5.3).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrapolate.bidirectional.assisted import Offsets, check_keyframe
from jaxtrapolate.bidirectional.image_based import slim
from jaxtrapolate.bidirectional.interpolate import interpolate_bidirectional
from jaxtrapolate.checks import ArrayLike, check_scalar
from jaxtrapolate.precision import widest
from jaxtrapolate.records import Keyframe

_TRACED = ("search", "visibility")  # their traced are, and the rest of them is part of the tree

Static = tuple[tuple[str, Any], ...]


def _split(options: dict[str, Any]) -> tuple[dict[str, Any], Static]:
    """Options of `interpolate_bidirectional`: those with traced, which are traced, and the static others."""
    for name in ("target", "offsets"):
        if name in options:
            raise ValueError(f"{name}: expected none, a run has its own")
    lists = {k: tuple(v) if isinstance(v, Sequence) and not isinstance(v, str) else v for k, v in options.items()}
    traced = {k: lists.pop(k) for k in _TRACED if k in lists}
    return traced, tuple(sorted(lists.items()))


def _lit(options: Static, light) -> Callable | None:
    """`shade_attributes` of a frame, by its light if there is one."""
    shade = dict(options).get("shade_attributes")
    return shade if shade is None or light is None else lambda attributes: shade(attributes, light)


def _frames(previous, next, alphas, targets, lights, keep: Callable, total, traced, options: Static):
    """Frames at `alphas` in one scan: (total, what was kept), by keep(total, color) -> (total, kept)."""

    def step(carried, given):
        offsets, total = carried
        alpha, target, light = given
        how = traced | dict(options) | {"shade_attributes": _lit(options, light)}
        result = interpolate_bidirectional(previous, next, alpha, target=target, offsets=offsets, **how)
        total, kept = keep(total, result.color)
        return (offsets if result.offsets is None else result.offsets, total), kept

    none = jnp.zeros((*previous.color.shape[:2], 2), alphas.dtype)
    known = previous.depth is not None and next.depth is not None
    far = jnp.full((*none.shape[:2], 1), jnp.inf, none.dtype) if known else None
    start = Offsets(jnp.asarray(0.5, none.dtype), none, none, far, far)  # of no frame yet
    # differentiated, a step is recomputed, instead of keeping all its intermediate values
    step = jax.checkpoint(step, prevent_cse=False)
    (_, total), kept = jax.lax.scan(step, (start, total), (alphas, targets, lights))
    return total, kept


def _wide(*frames: Keyframe):
    """The dtype of positions between some frames."""
    flows = [flow for frame in frames for flow in (frame.forward_flow, frame.backward_flow) if flow is not None]
    return widest(*flows)


@partial(jax.jit, static_argnames=("factor", "options"))
def _run(previous, next, targets, lights, traced, *, factor, options):
    alphas = jnp.arange(1, factor, dtype=_wide(previous, next)) / factor
    return _frames(previous, next, alphas, targets, lights, lambda _, c: (None, c), None, traced, options)[1]


def interpolate_run(
    previous: Keyframe,
    next: Keyframe,
    *,
    factor: int,
    targets: Keyframe | None = None,
    lights: Any = None,
    **options: Any,
) -> Float[Array, "n h w c"]:
    """All `factor - 1` frames between two rendered ones, in order, one scan; each starts from the offsets of the last.

    Args:
        previous: as of `interpolate_bidirectional`.
        next: as of `interpolate_bidirectional`.
        factor: the frames are at alpha = k / factor, k = 1 .. factor - 1; at least 2.
        targets: as `target`, each field `[factor - 1, ...]`.
        lights: any arrays `[factor - 1, ...]`, of which `shade_attributes(attributes, light)` gets those of its frame,
            so that attributes are lit as the scene is then (section 9). Traced, unlike the function.
        options: of `interpolate_bidirectional`, but target and offsets.

    Returns:
        The colours `[factor - 1, H, W, C]`.

    Raises:
        TypeError, ValueError: as of `interpolate_bidirectional`; factor below 2, or target or offsets given.

    References:
        Yang et al. 2011, section 5.3, latest-frame initialization.
    """
    if not isinstance(factor, int) or factor < 2:
        raise ValueError(f"factor: expected an integer of at least 2, got {factor!r}")
    traced, static = _split(options)
    size = check_keyframe("previous", previous)
    check_keyframe("next", next, size=size)
    _check_lights(lights, factor - 1, static)
    return _run(*slim(previous, next), targets, lights, traced, factor=factor, options=static)


def _check_lights(lights: Any, number: int, options: Static) -> None:
    if lights is not None and dict(options).get("shade_attributes") is None:
        raise ValueError("lights: expected none without shade_attributes")
    for leaf in jax.tree.leaves(lights):
        if jnp.ndim(leaf) == 0 or jnp.shape(leaf)[0] != number:
            raise ValueError(f"lights: expected arrays [{number}, ...], got {list(jnp.shape(leaf))}")


@partial(jax.jit, static_argnames=("samples", "options"))
def _blur(before, after, shutter, targets, lights, traced, *, samples, options):
    shade = _lit(options, jax.tree.map(lambda a: a[samples], lights))
    sharp = after[0].color if shade is None else shade(after[0].color)
    wide, parts = widest(sharp), 2 * samples + 1

    def add(total, color):
        return total + (color.astype(wide) - sharp.astype(wide)), None

    steps = jnp.arange(1, samples + 1, dtype=_wide(*before, *after))
    steps = jnp.asarray(shutter).astype(steps.dtype) / parts * steps
    total = jnp.zeros(sharp.shape, wide)

    def cut(tree, places):
        return jax.tree.map(lambda a: a[places], tree)

    earlier = np.s_[samples - 1 :: -1]  # on both sides from the rendered frame on
    for (first, second), alphas, target, light in (
        (before, 1 - steps, cut(targets, earlier), cut(lights, earlier)),
        (after, steps, cut(targets, np.s_[samples:]), cut(lights, np.s_[samples + 1 :])),
    ):
        total, _ = _frames(first, second, alphas, target, light, add, total, traced, options)
    return (sharp.astype(wide) + total / parts).astype(sharp.dtype)


def motion_blur(
    previous: Keyframe,
    current: Keyframe,
    next: Keyframe,
    *,
    shutter: float | Float[ArrayLike, ""] = 0.5,
    samples: int = 5,
    targets: Keyframe | None = None,
    lights: Any = None,
    **options: Any,
) -> Float[Array, "h w c"]:
    """A rendered frame as a camera with an open shutter sees it: the mean of it and of frames interpolated around it.

    The time that the shutter is open, half of it before and half after the rendered frame, is divided into
    2 samples + 1 equal parts. The middle of the middle part is the rendered frame; those of the others are generated,
    from it and the frame before, or it and the frame after.

    Args:
        previous: color `[H, W, C]`, forward_flow, depth (may be absent).
        current: color, both flows, depth.
        next: color, backward_flow, depth. The flows lead from each to the next of the three.
        shutter: in intervals between rendered frames, 0..2; 1/2 is a shutter of 180 degrees at their rate. Traced.
        samples: frames that are generated on each side, at least 1; they are generated one after the other, so that
            memory does not depend on it.
        targets: the geometry of the frames to be generated, `target` of `interpolate_bidirectional`, each field
            `[2 samples, ...]` in order of time: at k shutter / (2 samples + 1) intervals from `current`, k = -samples
            .. samples without 0.
        lights: as of `interpolate_run`, `[2 samples + 1, ...]` in order of time, with the rendered frame's.
        options: of `interpolate_bidirectional`, but target and offsets. `shade_attributes` is called for each frame,
            the rendered one too, and what it gives is averaged.

    Returns:
        `[H, W, C]`. Colours are averaged unchanged: they should be linear radiance, before any tone mapping.

    Convention:
        Each flow belongs to its own frame's grid and is added; pixels, x right, y down, integers are centres.

    Exactness:
        shutter 0 returns the rendered frame bit for bit; where all stands still and keeps its colour it is returned up
        to rounding.

    Edge cases:
        As of `interpolate_bidirectional`. A colour that is not finite in one of the frames is not finite in the mean.

    Gradient:
        With respect to colours, flows and shutter, as of `interpolate_bidirectional`; of each generated frame its
        offsets are kept for the reverse pass, and the rest is recomputed.

    Raises:
        TypeError, ValueError: as of `interpolate_bidirectional`; samples below 1, or target or offsets given.

    References:
        Yang et al. 2011, section 9, motion blur (ten frames for each rendered one: samples 5). Departure: the
        rendered frame has part in the mean.
    """
    if not isinstance(samples, int) or samples < 1:
        raise ValueError(f"samples: expected an integer of at least 1, got {samples!r}")
    check_scalar("shutter", shutter)
    traced, static = _split(options)
    size = check_keyframe("current", current)
    check_keyframe("previous", previous, size=size)
    check_keyframe("next", next, size=size)
    _check_lights(lights, 2 * samples + 1, static)
    sides = slim(previous, current), slim(current, next)
    return _blur(*sides, shutter, targets, lights, traced, samples=samples, options=static)
