"""Validation: windows that training does not see, played by the method that is trained, as evaluation plays frames."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrapolate.checks import check_present
from jaxtrapolate.evaluation.player import Player
from jaxtrapolate.evaluation.windows import Window
from jaxtrapolate.methods.method import Method
from jaxtrapolate.metrics.image import psnr
from jaxtrapolate.ops.radiance import tonemap
from jaxtrapolate.records import Frame, replace

_SHOWN = 4  # windows whose images are kept


def lean(window: Window) -> Window:
    """A window on the host, without what neither methods nor scores look at: buffers of frames that are not rendered.

    Those of the target are kept.
    """

    def seen(frame: Frame) -> Frame:
        return frame if frame.color is not None else replace(frame, gbuffer=None)

    history, future = (tuple(map(seen, frames)) for frames in (window.history, window.future))
    truth = Frame(color=window.truth.color)
    return jax.device_get(replace(window, truth=truth, history=history, future=future))


class Validation:
    """The same few windows for a method whose weights change, and once for one that it has to be better than.

    Args:
        windows: each a run of its own: a method's memory starts anew with it.
        name: of the other method's dB.
        baseline: that method.
        holes: whether dB are taken in holes as well: those that the stages before "network" find.
    """

    def __init__(self, windows: Sequence[Window], name: str, baseline: Method, *, holes: bool = False) -> None:
        self._windows = windows
        find = _hole_finder(baseline)
        self._holes = [find(w) if holes else None for w in windows]
        self._constant, _ = self._play(name, baseline)

    def __call__(self, method: Method) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        """Mean dB of whole frames after the tone curve, and some images: ground truth, generated frame, difference.

        Returns:
            "psnr" and the other method's, each also with "_hole"; of windows where they are finite. Images by name.
        """
        scores, images = self._play("psnr", method)
        return scores | self._constant, images

    def _play(self, name: str, method: Method) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        player, rows, images = Player(method), [], {}
        for i, (window, holes) in enumerate(zip(self._windows, self._holes, strict=True)):
            shown = check_present("frame", player.show(window, first=True), needed_by="validation")
            row, image = _scored(shown.image, window.truth.color, holes)
            rows.append({f"{name}{part}": float(value) for part, value in row.items()})
            if i < _SHOWN:
                images[f"window{i}"] = np.asarray(image)
        scores = {}
        for key in rows[0]:
            known = [row[key] for row in rows if np.isfinite(row[key])]
            scores[key] = float(np.mean(known)) if known else float("nan")
        return scores, images


def _hole_finder(method: Method) -> Callable[[Window], Bool[Array, "h w 1"]]:
    """Where the newest rendered frame of a window shows another surface; compiled once for each structure."""

    @jax.jit
    def holes(state: Any, *frames: Any) -> Array:
        return method.values_before("network", state, (), *frames)["holes"]

    return lambda window: holes(method.state, window.history, window.target)


@jax.jit
def _scored(
    image: Float[Array, "h w 3"], color: Float[Array, "h w 3"], holes: Bool[Array, "h w 1"] | None
) -> tuple[dict[str, Array], Array]:
    """dB of one frame, "" and "_hole", and three images side by side."""
    generated, truth = tonemap(image), tonemap(color)
    scores = {"": psnr(generated, truth)}
    if holes is not None:
        scores["_hole"] = psnr(generated, truth, mask=holes)
    return scores, jnp.concatenate([truth, generated, jnp.minimum(4 * jnp.abs(generated - truth), 1)], 1)
