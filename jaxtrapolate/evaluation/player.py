"""The player: steps methods through the frames of a sequence in order of display, and threads their memory.

A method without memory is handed the frames that are wanted of it, and no others. One with memory sees every frame from
the start of a run on, the rendered ones too, and its carry starts anew where a run does. Each frame is generated once;
where frames of that structure are new to a method it is called twice from the same carry, so that the second call can
be timed.
"""

import dataclasses
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from collections.abc import Sequence as Items
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_present
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.schedule import Slot, needed_slots
from jaxtrapolate.evaluation.windows import Window, arguments, load
from jaxtrapolate.files import Sequence
from jaxtrapolate.methods.frames import Frames, rendered
from jaxtrapolate.methods.method import Method
from jaxtrapolate.records import Frame
from jaxtrapolate.runtime.compiled import cache_hits


@dataclasses.dataclass(frozen=True)
class Generated:
    """A frame that a method generated.

    Attributes:
        image: `[scale H, scale W, 3]`, linear radiance.
        ms: how long it took.
        compile_ms: how much longer the first frame of its structure took; `None` for later ones.
        cached: whether compiled programs were read from a cache meanwhile, so that `compile_ms` is no compilation.
        carry: what the method remembered before this frame.
    """

    image: Float[Array, "h w 3"]
    ms: float
    compile_ms: float | None
    cached: bool = False
    carry: Any = ()


class Player:
    """Steps one method, frame by frame in order of display."""

    def __init__(self, method: Method) -> None:
        self.method = method
        self._carry: Any = ()
        self._size: Any = None
        self._known: set[Any] = set()

    def show(self, window: Window, *, first: bool = False) -> Generated | None:
        """The next frame in order of display.

        Args:
            window: the frame and what surrounds it; a target with colour is rendered: taken note of, or super sampled.
            first: whether it starts a run: memory starts anew. So it does where the size of frames changes.

        Returns:
            What was generated; `None` where nothing rendered comes before the frame.

        Raises:
            InputError: the method cannot run on such frames, see `Method.active`.
        """
        history, target, future = given = arguments(self.method, window)
        if first:
            self._size = None
        if target.color is None and not rendered(history):
            return None
        try:
            self.method.active(*given)
        except ValueError as error:
            raise InputError(f"frame {window.number}: {error}") from None
        size = _size(history, target)
        if size != self._size:
            self._carry, self._size = self.method.init(history, target), size
        before = self._carry
        key = _structure((before, given))
        spent = []
        with cache_hits() as hits:
            for _ in range(1 if key in self._known else 2):
                started = time.perf_counter()
                carry, image = jax.block_until_ready(self.method.step(before, history, target, future))
                spent.append((time.perf_counter() - started) * 1e3)
            cached = hits() > 0
        self._known.add(key)
        self._carry = carry
        extra = max(0.0, spent[0] - spent[1]) if len(spent) > 1 else None
        return Generated(image, spent[-1], extra, cached, before)


def _structure(tree: Any) -> tuple[Any, ...]:
    """What a compiled program depends on: how a tree is put together, and the shapes and dtypes of its leaves."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)


def _size(history: Frames, target: Frame) -> tuple[int, ...]:
    newest = target if target.color is not None else history[rendered(history)[0]]
    return check_present("color", newest.color, needed_by="the player").shape[:2]


def play(
    sequence: Sequence,
    slots: Items[Slot],
    methods: Mapping[str, Method],
    *,
    wanted: Callable[[str, Slot], bool] | None = None,
    hidden: Collection[int] = (),
    larger: bool = False,
) -> Iterator[tuple[Slot, Window, dict[str, Generated]]]:
    """Generates frames of a sequence with methods, in one pass over it.

    Args:
        sequence: the frames.
        slots: what is shown, in order of display.
        methods: by name.
        wanted: whether a frame is to be generated with a method, or super sampled where it is rendered; by default
            every frame that is not rendered. What a method with memory has to see before that is replayed.
        hidden: the numbers of the frames that are held back.
        larger: whether windows hold the frames at the output's size as well, as of `load`.

    Yields:
        Each frame of which something was generated, its window, and what was generated, by the methods' names.

    Raises:
        InputError: a method cannot run on these frames.
    """
    players = {name: Player(method) for name, method in methods.items()}
    asked = {n: [not s.rendered if wanted is None else wanted(n, s) for s in slots] for n in methods}
    shown = {n: needed_slots(slots, asked[n], memory=m.memory) for n, m in methods.items()}
    rows = [i for i in range(len(slots)) if any(flags[i] for flags in shown.values())]
    for i, (slot, window) in zip(
        rows, load(sequence, [slots[i] for i in rows], hidden=hidden, larger=larger), strict=True
    ):
        generated = {}
        for name, player in players.items():
            result = player.show(window, first=slot.first) if shown[name][i] else None
            if result is not None and asked[name][i]:
                generated[name] = result
        if generated:
            yield slot, window, generated
