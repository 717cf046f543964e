"""Examples: a frame to be generated and what surrounds it, from the embedded scenes without end, or from dumps.

An example is a `Window`, as evaluation hands it to methods: history of rendered frames with the buffers of the frames
between them, the target without colour, the truth. A task runs its method's own stages on it, up to the network, once
for each example of a pool and at full frame; batches are cut from what that gives.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, PartitionSpec
from jaxtyping import Array, Float, PRNGKeyArray

from jaxtrapolate.checks import Size, check_choice
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.schedule import Slot
from jaxtrapolate.evaluation.windows import Window, hide, load
from jaxtrapolate.files import Sequence, around, open_sequence, runs
from jaxtrapolate.records import Frame, GBuffer, replace
from jaxtrapolate.scenes import TRAINING_SEEDS, Scene, render, scene, scene_names, stack_scenes
from jaxtrapolate.training.augment import brighten, flip
from jaxtrapolate.training.config import check_range
from jaxtrapolate.training.tasks import Example

MotionPath = Literal["chained", "direct"]

VALIDATION_SEEDS = TRAINING_SEEDS[-(2**20) :]
"""Seeds of the scenes that validation sees and training does not; none is a test seed."""

SEEDS = TRAINING_SEEDS[: -(2**20)]
"""Seeds of the scenes that training sees."""

MOVING = tuple(name for name in scene_names() if name != "still")
"""The scenes in which something moves."""

Prepare = Callable[[Window, PRNGKeyArray], Example]
"""What a task derives from a window, once: pure and traced; for windows of several sizes cut to one."""


@dataclasses.dataclass(frozen=True)
class WindowOptions:
    """Which windows a pool consists of.

    Attributes:
        size: `(H, W)` of frames of embedded scenes.
        scenes: their names.
        weights: how often each scene is taken; equally often where empty.
        step: frames' least and largest distance in a scene's own time, uniform between; 1 is what evaluation has.
        time: of the target, the least and the largest, uniform between.
        motion: "chained" = as in evaluation, motion leads from frame to frame, through frames with buffers alone;
            "direct" = exact motion from one rendered frame to the next, without the frames between.
        flip: how likely a window is mirrored left to right, and top to bottom.
        bare: the share of windows that are shown with colour, motion, depth and stencil alone, as many engines write.
        sparse: the share of windows from which one kind of buffer, drawn at random, is left out: albedo, normals,
            positions, materials, depth, stencil or sky. Of bare ones too.
        lamps: the share of windows in which what shines brightly shines as lamps do, up to 3e4; see `brighten`.
        together: how many windows in a row are of one scene; accelerators render these at once.
        dumps: folders of frames with all buffers, see `jaxtrapolate.files.open_sequence`. The last tenth of each one's
            windows is for validation.
        dumps_share: of the windows that are of dumps, where there are any; each window of all dumps is equally likely.
    """

    size: tuple[int, int] = (192, 256)
    scenes: tuple[str, ...] = MOVING
    weights: tuple[float, ...] = ()
    step: tuple[float, float] = (0.5, 1.5)
    time: tuple[float, float] = (0.0, 120.0)
    motion: MotionPath = "chained"
    flip: tuple[float, float] = (0.5, 0.0)
    bare: float = 0.0
    sparse: float = 0.0
    lamps: float = 0.0
    together: int = 1
    dumps: tuple[str, ...] = ()
    dumps_share: float = 0.5

    def __post_init__(self) -> None:
        if min(self.size) < 1:
            raise ValueError(f"size: expected [H, W] of at least 1, got {list(self.size)}")
        for name in self.scenes:
            check_choice("scenes", name, scene_names())
        if self.weights and (len(self.weights) != len(self.scenes) or min(self.weights) < 0 or sum(self.weights) <= 0):
            raise ValueError(f"weights: expected a share for each of {len(self.scenes)} scenes, got {self.weights}")
        for name in ("step", "time"):
            low, high = getattr(self, name)
            if not -np.inf < low <= high < np.inf or (name == "step" and low <= 0):
                raise ValueError(f"{name}: expected [least, largest]{' above 0' * (name == 'step')}, got {[low, high]}")
        if not all(0 <= p <= 1 for p in self.flip):
            raise ValueError(f"flip: expected two probabilities, got {list(self.flip)}")
        check_range(self, "together", least=1)
        for name in ("bare", "sparse", "lamps", "dumps_share"):
            check_range(self, name, least=0, most=1)
        if not (self.dumps if self.dumps_share == 1 else self.scenes):
            raise ValueError(f"{'dumps' if self.dumps_share == 1 else 'scenes'}: expected some, got none")


def scene_window(
    world: Scene,
    time: Float[Array, ""],
    step: Float[Array, ""],
    *,
    size: Size,
    past: int,
    future: int = 0,
    motion: MotionPath = "chained",
) -> Window:
    """The window about a time of a scene, as evaluation has it of a sequence whose frames are `step` apart.

    Frames' times are counted from the target's, in frames: history at -1, -3, ..., future at 1, 3, ..., and with
    "chained" motion the frames between them, which have neither colour nor shadow nor sky colour. The number is 0.
    Jitted with `size`, `past`, `future` and `motion` static, what is not handed over is not computed; each of the two
    kinds of frame is compiled once, in a loop.

    Args:
        world: from `scene`.
        time: of the target, in the scene's time.
        step: from one frame to the next, in the scene's time; may be any real number but 0.
        size: `(H, W)`.
        past: rendered frames before the target.
        future: rendered frames after it.
        motion: see `WindowOptions`.
    """
    shown = [*range(1 - 2 * past, 0, 2), 0, *range(1, 2 * future, 2)]
    between = [*range(2 - 2 * past, 0, 2), *range(2, 2 * future, 2)]
    if motion == "direct":
        jobs = [(render, {offset: 1 if offset in (0, 1) else 2 for offset in shown})]
    else:
        jobs = [(render, dict.fromkeys(shown, 1)), (_buffers, dict.fromkeys(between, 1))]
    frames: dict[int, Frame] = {}
    for draw, gaps in jobs:
        if gaps:

            def one(pair: tuple[Array, Array], draw=draw) -> Frame:
                return draw(world, pair[0], size=size, previous_time=pair[1])

            offset, gap = jnp.array([*gaps], jnp.float32), jnp.array([*gaps.values()], jnp.float32)
            stacked = jax.lax.map(one, (time + offset * step, time + (offset - gap) * step))
            for i, number in enumerate(gaps):
                frame = jax.tree.map(lambda leaf, i=i: leaf[i], stacked)
                frames[number] = replace(frame, time=jnp.float32(number))
    return Window(
        number=0,
        truth=frames[0],
        history=tuple(frames[k] for k in sorted(frames) if k < 0),
        target=hide(frames[0]),
        future=tuple(frames[k] for k in sorted(frames) if k > 0),
    )


_BARE = tuple(f.name for f in dataclasses.fields(GBuffer) if f.name not in ("depth", "stencil"))

_KINDS = (
    *(("albedo",), ("normal",), ("position", "n_dot_v"), ("roughness", "metallic", "specular")),
    *(("depth",), ("stencil",), ("sky", "sky_color")),
)
"""Buffers that an engine writes together or not at all."""

_POWER = 8.0  # of `brighten`: what shines at 12 is at its limit


def _without(window: Window, names: tuple[str, ...]) -> Window:
    """The window without some of its frames' buffers."""

    def strip(node: Any) -> Any:
        if not isinstance(node, Frame) or node.gbuffer is None:
            return node
        return replace(node, gbuffer=replace(node.gbuffer, **dict.fromkeys(names)))

    return jax.tree.map(strip, window, is_leaf=lambda node: isinstance(node, Frame))


def _buffers(world: Scene, time: Array, *, size: Size, previous_time: Array) -> Frame:
    return hide(render(world, time, size=size, previous_time=previous_time))


def _mapped(function: Callable[..., Any], count: int) -> Callable[..., Any]:
    """`function` over a leading axis of `count`, compiled.

    On CPUs one by one, elsewhere at once, and divided among this host's devices where that comes out even.
    """

    def over(*arguments: Any) -> Any:
        if jax.default_backend() == "cpu":
            return jax.lax.map(lambda one: function(*one), arguments)
        return jax.vmap(function)(*arguments)

    own = jax.local_devices()
    if len(own) > 1 and count % len(own) == 0:
        mesh = Mesh(np.array(own), ("example",), axis_types=(AxisType.Auto,))
        along = PartitionSpec("example")
        return jax.jit(jax.shard_map(over, mesh=mesh, in_specs=along, out_specs=along, check_vma=False))
    return jax.jit(over)


def check_crop(crop: Size, size: Size) -> None:
    """Raise `ValueError` unless crops fit into the windows."""
    if any(a > b for a, b in zip(crop, size, strict=True)):
        raise ValueError(f"crop: expected at most windows.size = {list(size)}, got {list(crop)}")


def _parted(numbers: list[int]) -> tuple[list[int], list[int]]:
    """Numbers for training and for validation, the last tenth; a single one is for both."""
    held = -(-len(numbers) // 10) if len(numbers) > 1 else 0
    return numbers[: len(numbers) - held], numbers[len(numbers) - held :] or numbers


class Windows:
    """Pools of prepared windows, each determined by a key and its number.

    Args:
        options: which windows.
        prepare: what is kept of each; see `Prepare`.
        past: rendered frames before the target that a window has.
        future: rendered frames after it.

    Raises:
        InputError: a dump that cannot be read, or is too short for a window.
    """

    def __init__(self, options: WindowOptions, prepare: Prepare, *, past: int, future: int = 0) -> None:
        self.options, self._past, self._future = options, past, future
        self._dumps = [(s, *_parted(self._numbers(s))) for s in map(open_sequence, options.dumps)]
        draw = functools.partial(scene_window, size=options.size, past=past, future=future, motion=options.motion)
        self._render = _mapped(draw, options.together)
        self._prepare = _mapped(lambda w, h, v, key: prepare(flip(w, horizontal=h, vertical=v), key), options.together)
        self._flip = _mapped(lambda w, h, v: flip(w, horizontal=h, vertical=v), options.together)

    @property
    def sequences(self) -> tuple[Sequence, ...]:
        """The dumps."""
        return tuple(sequence for sequence, _, _ in self._dumps)

    def check_sizes(self) -> None:
        """For a task that keeps whole frames: raise `InputError` where those of a dump are not of `options.size`."""
        expected = self.options.size
        for sequence, _, _ in self._dumps:
            if sequence.size != tuple(expected):
                text = f"its frames are {list(sequence.size)}, options.windows.size is {list(expected)}"
                raise InputError(f"{sequence.name}: {text}; all windows of a run must have one size")

    def _numbers(self, sequence: Sequence) -> list[int]:
        """The frames of a sequence that have all that a window needs around them."""
        before, behind = 2 * self._past - 1, max(0, 2 * self._future - 1)
        needed = [0, *range(-before, 0, 2), *range(1, behind + 1, 2)]
        places = [(run, i) for run in runs(sequence) for i in range(before, len(run) - behind)]
        numbers = [run[i] for run, i in places if all(sequence.has_color(run[i + k]) for k in needed)]
        if not numbers:
            raise InputError(f"{sequence.name}: has no {before + 1 + behind} frames in a row for a window")
        return numbers

    def pool(self, key: PRNGKeyArray, numbers: range) -> Example:
        """The prepared windows `numbers` of the pool that a key stands for, stacked along a leading axis.

        Raises:
            ValueError: `prepare` gives arrays of several shapes.
        """
        words = np.asarray(jax.random.key_data(key)).tolist()
        together = self.options.together
        first, last = numbers.start // together, -(-numbers.stop // together)
        blocks = []
        for number in range(first, last):
            name, windows, flips = self._block(words, number, validation=False)
            keys = jax.random.split(jax.random.fold_in(key, number), together)
            try:
                blocks.append(self._prepare(windows, *flips, keys))
            except ValueError as error:
                raise InputError(f"windows of {name}: {error}") from error
        shapes = {str(jax.tree.map(lambda a: a.shape[1:], block)) for block in blocks}
        if len(shapes) > 1:
            raise ValueError(f"prepare: expected arrays of the same shapes of every window, got {' and '.join(shapes)}")
        skipped = numbers.start - first * together
        return jax.tree.map(lambda *a: jnp.concatenate(a)[skipped : skipped + len(numbers)], *blocks)

    def held(self, count: int) -> Iterator[Window]:
        """The first windows for validation, one by one: of scenes by `VALIDATION_SEEDS`, of dumps' last tenth."""
        words = np.asarray(jax.random.key_data(jax.random.key(0))).tolist()
        for number in range(-(-count // self.options.together)):
            _, windows, flips = self._block(words, number, validation=True)
            windows = self._flip(windows, *flips)
            for k in range(min(self.options.together, count - number * self.options.together)):
                yield jax.tree.map(lambda leaf, k=k: leaf[k], windows)

    def _block(self, words: list[int], number: int, *, validation: bool) -> tuple[str, Window, np.ndarray]:
        """The windows of one scene or dump that are prepared together, and how each is flipped."""
        options, count = self.options, self.options.together
        rng = np.random.default_rng([*words, number])
        flips = rng.random((2, count)) < np.array(options.flip)[:, None]
        if self._dumps and rng.random() < options.dumps_share:
            name, windows = self._read(rng, count, validation)
        else:
            name, windows = self._draw(rng, count, VALIDATION_SEEDS if validation else SEEDS)
        if options.bare and rng.random() < options.bare:
            windows = _without(windows, _BARE)
        if options.sparse and rng.random() < options.sparse:
            windows = _without(windows, _KINDS[rng.integers(len(_KINDS))])
        if options.lamps and rng.random() < options.lamps:
            windows = brighten(windows, rng.uniform(0, _POWER))
        return name, windows, flips

    def _draw(self, rng: np.random.Generator, count: int, seeds: range) -> tuple[str, Window]:
        options = self.options
        shares = np.array(options.weights or [1.0] * len(options.scenes))
        name = options.scenes[rng.choice(len(options.scenes), p=shares / shares.sum())]
        worlds = stack_scenes([scene(name, seeds[int(i)]) for i in rng.integers(0, len(seeds), count)])
        times, steps = (rng.uniform(*bounds, count).astype(np.float32) for bounds in (options.time, options.step))
        return name, self._render(worlds, times, steps)

    def _around(self, sequence: Sequence, number: int) -> Window:
        """The window of any frame: of its neighbours every second one counts as rendered, from the next one on."""
        before, behind = 2 * self._past - 1, max(0, 2 * self._future - 1)
        group = around(sequence, number, before=before, behind=behind)
        slot = Slot(number, group[:before], group[before + 1 :], rendered=False, first=False, full=True, distance=1)
        ((_, window),) = load(sequence, [slot], hidden=group[1::2])
        return window

    def _read(self, rng: np.random.Generator, count: int, validation: bool) -> tuple[str, Window]:
        dumps = [(sequence, held if validation else seen) for sequence, seen, held in self._dumps]
        shares = np.array([len(numbers) for _, numbers in dumps])
        sequence, numbers = dumps[rng.choice(len(dumps), p=shares / shares.sum())]
        chosen = [numbers[i] for i in rng.integers(0, len(numbers), count)]
        read = [self._around(sequence, number) for number in chosen]
        return sequence.name, jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *read)
