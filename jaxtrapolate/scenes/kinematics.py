"""How things move: paths, turns and trees of rigid bodies as closed functions of time.

Convention:
    Metres, radians, frames; world space is right-handed with z up. A pose maps a body's own space to the world:
    x_world = rotation @ x_body + translation.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.records import record

HARMONICS = 2
"""How many sines a path or a turn is the sum of."""


@record
@dataclasses.dataclass(frozen=True)
class Path:
    """base + drift t + sum over h of amplitude[h] sin(2 pi (frequency[h] t + phase[h])), by coordinate.

    base, drift `[..., 3]` in metres and metres a frame; amplitude, frequency (cycles a frame) and phase (cycles)
    `[..., HARMONICS, 3]`.
    """

    base: Float[Array, "*n 3"]
    drift: Float[Array, "*n 3"]
    amplitude: Float[Array, "*n h 3"]
    frequency: Float[Array, "*n h 3"]
    phase: Float[Array, "*n h 3"]

    def at(self, time: Float[Array, ""]) -> Float[Array, "*n 3"]:
        """The point at `time`, in frames."""
        sines = jnp.sin(2 * jnp.pi * (self.frequency * time + self.phase))
        return self.base + self.drift * time + jnp.sum(self.amplitude * sines, axis=-2)


@record
@dataclasses.dataclass(frozen=True)
class Turn:
    """A rotation about a fixed axis `[..., 3]` by angle + rate t + sum of sines, right-handed, in radians.

    angle, rate `[...]`; amplitude, frequency, phase `[..., HARMONICS]`.
    """

    axis: Float[Array, "*n 3"]
    angle: Float[Array, "*n"]
    rate: Float[Array, "*n"]
    amplitude: Float[Array, "*n h"]
    frequency: Float[Array, "*n h"]
    phase: Float[Array, "*n h"]

    def at(self, time: Float[Array, ""]) -> Float[Array, "*n 3 3"]:
        """The rotation matrices at `time`, by Rodrigues' formula; exactly the identity where the angle is 0."""
        sines = jnp.sin(2 * jnp.pi * (self.frequency * time + self.phase))
        angle = self.angle + self.rate * time + jnp.sum(self.amplitude * sines, axis=-1)
        return rotation_about(self.axis, angle)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Bodies:
    """A tree of rigid bodies; body 0 is the world, which never moves.

    path, turn: pose relative to the parent, leading axis the bodies. stencil `[B]`: 0 static, > 0 id of the dynamic
    object which the body is part of. parents: the index of each one's parent, smaller than its own; static.
    """

    path: Path
    turn: Turn
    stencil: Float[Array, " b"]
    parents: tuple[int, ...] = dataclasses.field(metadata={"static": True})

    def at(self, time: Float[Array, ""]) -> "Pose":
        """Every body's pose in the world at `time`."""
        rotation, translation = self.turn.at(time), self.path.at(time)
        depths = [0] * len(self.parents)
        for body in range(1, len(self.parents)):
            depths[body] = depths[self.parents[body]] + 1
        levels = max(depths)
        world = Pose(rotation, translation)
        parents = jnp.asarray(self.parents)
        inner = jnp.asarray([depth > 1 for depth in depths])
        for _ in range(levels - 1):
            composed = Pose(world.rotation[parents], world.translation[parents]).compose(Pose(rotation, translation))
            world = Pose(
                jnp.where(inner[:, None, None], composed.rotation, rotation),
                jnp.where(inner[:, None], composed.translation, translation),
            )
        return world


@record
@dataclasses.dataclass(frozen=True)
class Pose:
    """Rigid maps: rotation `[..., 3, 3]`, translation `[..., 3]`."""

    rotation: Float[Array, "*n 3 3"]
    translation: Float[Array, "*n 3"]

    def compose(self, inner: "Pose") -> "Pose":
        """First `inner`, then this one."""
        return Pose(
            matmul(self.rotation, inner.rotation),
            matmul(self.rotation, inner.translation[..., None])[..., 0] + self.translation,
        )

    def inverse(self) -> "Pose":
        """The map back."""
        back = jnp.swapaxes(self.rotation, -1, -2)
        return Pose(back, -matmul(back, self.translation[..., None])[..., 0])


def matmul(a: Array, b: Array) -> Array:
    """A product of small matrices in full float32 on every device."""
    return jnp.matmul(a, b, precision="highest")


def rotation_about(axis: Float[Array, "*n 3"], angle: Float[Array, "*n"]) -> Float[Array, "*n 3 3"]:
    """The right-handed rotation by `angle` about a unit `axis`."""
    x, y, z = axis[..., 0], axis[..., 1], axis[..., 2]
    s, c = jnp.sin(angle), jnp.cos(angle)
    k = 1 - c
    rows = [
        [c + x * x * k, x * y * k - z * s, x * z * k + y * s],
        [y * x * k + z * s, c + y * y * k, y * z * k - x * s],
        [z * x * k - y * s, z * y * k + x * s, c + z * z * k],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
