"""Training of the learned interpolator: the two rendered frames around a target, and the target, as display values."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, PRNGKeyArray

from jaxtrapolate.checks import Size, check_present
from jaxtrapolate.evaluation.windows import Window
from jaxtrapolate.methods.blending import blend
from jaxtrapolate.methods.interpolator import interpolator, interpolator_config
from jaxtrapolate.networks.inference import inference
from jaxtrapolate.networks.interpolator import Interpolator, InterpolatorConfig
from jaxtrapolate.ops.radiance import compress
from jaxtrapolate.training.augment import crop
from jaxtrapolate.training.config import check_range
from jaxtrapolate.training.losses import charbonnier_loss
from jaxtrapolate.training.tasks import Batch, Example
from jaxtrapolate.training.validation import Validation, lean
from jaxtrapolate.training.windows import WindowOptions, Windows, check_crop


@dataclasses.dataclass(frozen=True)
class InterpolatorOptions:
    """What is learned, from what.

    Attributes:
        network: its size.
        windows: the examples; no motion is looked at, so "direct" saves its rendering.
        crop: `(H, W)` of an item.
        epsilon: of `charbonnier_loss`.
        validation: windows that validation looks at.
    """

    network: InterpolatorConfig = dataclasses.field(default_factory=InterpolatorConfig)
    windows: WindowOptions = dataclasses.field(default_factory=lambda: WindowOptions(motion="direct"))
    crop: Size = (128, 128)
    epsilon: float = 1e-3
    validation: int = 36

    def __post_init__(self) -> None:
        check_range(self, "epsilon", above=0)
        check_range(self, "validation", least=1)
        check_crop(self.crop, self.windows.size)


class InterpolatorTask:
    """Trains an `Interpolator` on what the method "interpolator" shows it, at the middle between two rendered frames.

    An example holds "first" and "second", the network's inputs, and "target", the ground truth as `compress` shows it.

    References: Kong et al. 2022 (IFRNet), its reconstruction loss. Departures: without its census, flow distillation
    and feature losses; the flow is learned from colour alone.
    """

    score = "psnr"

    def __init__(self, options: InterpolatorOptions = InterpolatorOptions()) -> None:
        self.options = options
        self._stages = interpolator(Interpolator(options.network, rngs=nnx.Rngs(0)))
        self._windows = Windows(options.windows, self._prepare, past=1, future=1)
        self._windows.check_sizes()
        self.sequences = self._windows.sequences
        self._validation: Validation | None = None
        scenes = ", ".join(options.windows.scenes)
        config = interpolator_config(options.network)
        self.about: Mapping[str, Any] = {"method": "interpolator", "config": config, "note": f"trained on {scenes}"}

    def _prepare(self, window: Window, key: PRNGKeyArray) -> Example:
        del key
        method = self._stages
        values = method.values_before("network", method.state, (), window.history, window.target, window.future)
        first, second, _ = values["inputs"]
        truth = compress(check_present("color", window.truth.color, needed_by="training"))
        return {"first": first, "second": second, "target": truth}

    def init(self, rngs: nnx.Rngs) -> nnx.Module:
        """A new network."""
        return Interpolator(self.options.network, rngs=rngs)

    def pool(self, key: PRNGKeyArray, numbers: range) -> Example:
        """Prepared windows of the scenes' training seeds."""
        return self._windows.pool(key, numbers)

    def sample(self, example: Example, key: PRNGKeyArray) -> Batch:
        """A random crop, as likely backward in time as forward."""
        place, order = jax.random.split(key)
        item = crop(example, place, size=self.options.crop)
        backward = jax.random.bernoulli(order, jnp.float32(0.5))
        first, second = item["first"], item["second"]
        turned = {"first": jnp.where(backward, second, first), "second": jnp.where(backward, first, second)}
        return item | turned

    def loss(self, model: nnx.Module, batch: Batch) -> tuple[Array, Mapping[str, Array]]:
        """`charbonnier_loss`, its mean over the batch."""
        predicted = _predict(model, batch)
        return jnp.mean(
            jax.vmap(lambda *a: charbonnier_loss(*a, epsilon=self.options.epsilon))(predicted, batch["target"])
        ), {}

    def validate(self, model: nnx.Module) -> tuple[Mapping[str, float], Mapping[str, Any]]:
        """dB of the method's frames: "psnr"; "blend", of both rendered frames mixed."""
        if self._validation is None:
            windows = list(map(lean, self._windows.held(self.options.validation)))
            self._validation = Validation(windows, "blend", blend())
        return self._validation(self._stages.with_weights(inference(model)[1]))


def _predict(model: Any, batch: Batch) -> Array:
    first = batch["first"]
    return model(first, batch["second"], jnp.full(first.shape[0], 0.5, first.dtype))
