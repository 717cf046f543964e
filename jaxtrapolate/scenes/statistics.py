"""How hard a scene is: motion, disocclusion, moving shadow and gloss between rendered frames, two frame steps apart."""

import dataclasses
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrapolate.ops.warp import landing
from jaxtrapolate.records import Frame
from jaxtrapolate.scenes.render import flow, render, visible
from jaxtrapolate.scenes.scene import Scene

STEP = 2
"""Frames from one rendered frame to the next: every second one is held back."""


@dataclasses.dataclass(frozen=True)
class Statistics:
    """Means over frames, in pixels and in fractions of all pixels.

    motion: median length of the motion to the rendered frame before, pixels. hidden: what is inside that frame but
    hidden in it. outside: what is not inside it. shadow: what is seen in both, with a shadow that differs by more than
    0.2. glossy: surfaces of roughness below 0.3. dynamic: surfaces of dynamic objects. sky: the sky.
    """

    motion: float
    hidden: float
    outside: float
    shadow: float
    glossy: float
    dynamic: float
    sky: float


def statistics(
    scene: Scene, *, times: Iterable[float] = (20.0, 61.0, 107.0), size: tuple[int, int] = (768, 1024)
) -> Statistics:
    """The statistics of a scene over some times."""
    rows = []
    for time in times:
        now, before = (render(scene, t, size=size, previous_time=time - STEP) for t in (time, time - STEP))
        motion = flow(scene, time, time - STEP, size=size)
        seen = visible(scene, time, time - STEP, size=size)
        rows.append(_measure(now, before, motion, seen))
    return Statistics(*(float(value) for value in np.mean(np.asarray(rows), axis=0)))


@jax.jit
def _measure(now: Frame, before: Frame, motion: Float[Array, "h w 3"], seen: Array) -> Array:
    height, width = seen.shape
    x, y, _ = landing(motion[..., :2])
    inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    column = jnp.clip(jnp.round(x), 0, width - 1).astype(jnp.int32)
    row = jnp.clip(jnp.round(y), 0, height - 1).astype(jnp.int32)
    g = now.gbuffer
    warped = before.gbuffer.shadow[row, column]  # type: ignore[union-attr]
    changed = (jnp.abs(g.shadow - warped)[..., 0] > 0.2) & seen  # type: ignore[union-attr]
    surface = g.sky[..., 0] < 0.5  # type: ignore[union-attr]
    glossy = (g.roughness[..., 0] < 0.3) & surface  # type: ignore[union-attr]
    moving = g.stencil[..., 0] > 0  # type: ignore[union-attr]
    length = jnp.median(jnp.hypot(motion[..., 0], motion[..., 1]))
    fractions = (inside & ~seen, ~inside, changed, glossy, moving, ~surface)
    return jnp.stack([length, *(jnp.mean(part, dtype=jnp.float32) for part in fractions)])


def table(rows: dict[str, Statistics]) -> str:
    """Statistics by scene as a Markdown table."""
    names = [field.name for field in dataclasses.fields(Statistics)]
    lines = ["| scene | motion, px | " + " | ".join(f"{name}, %" for name in names[1:]) + " |"]
    lines.append("|---" * (len(names) + 1) + "|")
    for scene_name, row in rows.items():
        values = [f"{row.motion:.1f}"] + [f"{100 * getattr(row, name):.1f}" for name in names[1:]]
        lines.append(f"| {scene_name} | " + " | ".join(values) + " |")
    return "\n".join(lines)


def mean(rows: Iterable[Statistics]) -> Statistics:
    """The means of several."""
    return Statistics(*(float(value) for value in np.mean([dataclasses.astuple(row) for row in rows], axis=0)))
