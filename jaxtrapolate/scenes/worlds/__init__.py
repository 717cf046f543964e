"""The embedded scenes by name. A scene is a function of a random generator; its array shapes depend on nothing."""

import zlib
from collections.abc import Callable

import jax
import numpy as np

from jaxtrapolate.checks import check_choice
from jaxtrapolate.scenes.scene import Scene
from jaxtrapolate.scenes.worlds.demo import demo
from jaxtrapolate.scenes.worlds.figures import head, walkers
from jaxtrapolate.scenes.worlds.landscape import dock, forest, terrain, windmill
from jaxtrapolate.scenes.worlds.night import interior, street
from jaxtrapolate.scenes.worlds.still import still

SCENES: dict[str, Callable[[np.random.Generator], Scene]] = {
    "demo": demo,
    "walkers": walkers,
    "terrain": terrain,
    "head": head,
    "windmill": windmill,
    "interior": interior,
    "forest": forest,
    "dock": dock,
    "street": street,
    "still": still,
}
"""Each scene's maker, in the order of reports."""

TRAINING_SEEDS = range(2**31)
"""Seeds below 2^31 are for training."""

DEVELOPMENT_SEEDS = tuple(range(2**31, 2**31 + 4))
"""Seeds that no network was trained on, but on which choices were compared: they are no test of what was chosen."""

TEST_SEEDS = tuple(range(2**32, 2**32 + 4))
"""The seeds that results are reported on: neither training nor any choice of a default has looked at them."""


def scene_names() -> tuple[str, ...]:
    """The names that `scene` knows."""
    return tuple(SCENES)


def scene(name: str, seed: int = 0) -> Scene:
    """The embedded scene `name`, its layout, textures, colours, speeds, lights and camera drawn from `seed`.

    Any non-negative integer is a seed; see `TRAINING_SEEDS`, `DEVELOPMENT_SEEDS` and
    `TEST_SEEDS`. All seeds share one structure.
    """
    check_choice("name", name, scene_names())
    if seed < 0:
        raise ValueError(f"seed: expected a non-negative integer, got {seed}")
    with jax.ensure_compile_time_eval():
        return SCENES[name](np.random.default_rng([seed, zlib.crc32(name.encode())]))
