"""Training of ExtraNet (Guo et al. 2021, section 4.6): the method's own stages prepare, its network learns the rest."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, PRNGKeyArray

from jaxtrapolate.checks import Size, check_present
from jaxtrapolate.evaluation.windows import Window
from jaxtrapolate.methods.extranet import NAME, Preparation, encoded_truth, extranet, extranet_config, first_guess
from jaxtrapolate.methods.stages import reflecting
from jaxtrapolate.networks.extranet import ExtraNet, ExtraNetConfig
from jaxtrapolate.networks.inference import inference
from jaxtrapolate.ops.radiance import demodulation_divisor
from jaxtrapolate.training.augment import crop
from jaxtrapolate.training.config import check_range
from jaxtrapolate.training.losses import extranet_loss, relative_loss
from jaxtrapolate.training.tasks import Batch, Example
from jaxtrapolate.training.validation import Validation, lean
from jaxtrapolate.training.windows import WindowOptions, Windows, check_crop

_BRIGHTEST = 16.0  # in the log domain; above it nothing is told apart
_DARKEST = 1e-3
_LEAST = 1e-12  # the sum of weights that are all 0
_LEAST_ERROR, _LEAST_HOLE_ERROR = 1e-6, 1e-5  # squared errors: few hole pixels that are all but right teach nothing


@dataclasses.dataclass(frozen=True)
class ExtraNetOptions:
    """What is learned, from what.

    Attributes:
        network: its size, and what is left out of it.
        preparation: what it is shown; goes into the file of its weights.
        windows: the examples.
        crop: `(H, W)` of an item, a multiple of the network's.
        space: where errors are measured: "log" of the light, as in the paper; or "display", the image after a tone
            curve, where an error under a dark albedo counts as little as it is seen.
        loss: "extranet", `extranet_loss`; or "relative", `relative_loss` against the first guess, once of all and,
            times `hole_weight`, once of holes alone, whose errors may be small beside the largest.
        hole_weight: of holes in either loss, and in "error" crops.
        hole_margin: pixels around the masks' holes that count as holes there too: the masks miss their rims.
        shade_weight, shade, shade_fraction: of `extranet_loss`.
        crops: "even", anywhere; or "error", around pixels drawn by the first guess's squared error, so that the mean of
            the relative loss over crops is about that over frames; with `hole_weight` times the chance in holes alone.
        validation: windows that validation looks at.
    """

    network: ExtraNetConfig = dataclasses.field(default_factory=ExtraNetConfig)
    preparation: Preparation = dataclasses.field(default_factory=Preparation)
    windows: WindowOptions = dataclasses.field(default_factory=WindowOptions)
    crop: Size = (128, 128)
    space: Literal["log", "display"] = "log"
    loss: Literal["extranet", "relative"] = "extranet"
    hole_weight: float = 1.0
    hole_margin: int = 0
    shade_weight: float = 1.0
    shade: Literal["release", "paper"] = "release"
    shade_fraction: float = 0.1
    crops: Literal["even", "error"] = "even"
    validation: int = 36

    def __post_init__(self) -> None:
        for name in ("hole_weight", "hole_margin", "shade_weight"):
            check_range(self, name, least=0)
        check_range(self, "shade_fraction", above=0, most=1)
        check_range(self, "validation", least=1)
        check_crop(self.crop, self.windows.size)


class ExtraNetTask:
    """Trains an `ExtraNet` on what its method shows it. Where the sky is, nothing is learned or scored.

    Args:
        options: see `ExtraNetOptions`.
        method: of which the weights are to be, "extranet" or "guided_net".

    An example holds the network's inputs, histories `[H, W, N, 4]` so that all is cut alike; "target", the true light
    in the log domain, NaN at the sky; and "divisor", the target's reflectance.
    """

    score = "gain"
    adapts = ("preparation", "network.guess")

    def __init__(self, options: ExtraNetOptions = ExtraNetOptions(), *, method: str = NAME) -> None:
        self.options = options
        # preparation looks at the configuration alone
        self._stages = extranet(ExtraNet(options.network, rngs=nnx.Rngs(0)), preparation=options.preparation)
        self._windows = Windows(options.windows, self._prepare, past=self._stages.past)
        self._windows.check_sizes()
        self.sequences = self._windows.sequences
        self._validation: Validation | None = None
        config = extranet_config(options.network, options.preparation)
        scenes = ", ".join(options.windows.scenes)
        self.about: Mapping[str, Any] = {"method": method, "config": config, "note": f"trained on {scenes}"}

    def _prepare(self, window: Window, key: PRNGKeyArray) -> Example:
        del key
        method, preparation = self._stages, self.options.preparation
        values = method.values_before("network", method.state, (), window.history, window.target)
        buffers = check_present("gbuffer", window.truth.gbuffer, needed_by="training")
        color = check_present("color", window.truth.color, needed_by="training")
        target, divisor = encoded_truth(color, buffers, preparation=preparation), jnp.ones_like(color)
        if buffers.albedo is not None:
            how: dict[str, Any] = {"by": preparation.by, "floor": preparation.floor}
            divisor = demodulation_divisor(reflecting(buffers, preparation.sky), **how)
        if buffers.sky is not None:
            target = jnp.where(buffers.sky > 0.5, jnp.nan, target)
        inputs = {name: value for name, value in values["inputs"].items() if value is not None}
        if "history" in inputs:
            inputs["history"] = jnp.moveaxis(inputs["history"], 0, 2)  # [H, W, N, 4]: crops cut the leading axes
        example = inputs | {"target": target, "divisor": jnp.broadcast_to(divisor, color.shape).astype(target.dtype)}
        if self.options.crops == "error":
            predicted, truth = self._measured(inputs["x"][..., :3], example)
            example["weight"] = jnp.nan_to_num(jnp.mean(jnp.square(predicted - truth), -1, keepdims=True))
        return example

    def _measured(self, light: Array, example: Example) -> tuple[Array, Array]:
        """An image and the truth where errors are measured."""
        images = light, example["target"]
        if self.options.space == "log":
            return images
        predicted, truth = (_display(image, example["divisor"]) for image in images)
        return predicted, truth

    def init(self, rngs: nnx.Rngs) -> nnx.Module:
        """A new network."""
        return ExtraNet(self.options.network, rngs=rngs)

    def pool(self, key: PRNGKeyArray, numbers: range) -> Example:
        """Prepared windows of the scenes' training seeds."""
        return self._windows.pool(key, numbers)

    def sample(self, example: Example, key: PRNGKeyArray) -> Batch:
        """A random crop."""
        weight = example.pop("weight") if "weight" in (example := dict(example)) else None
        if weight is not None:
            holes = jnp.where(_valid(example["mask"], self.options.hole_margin) < 0.5, weight, 0)
            weight, holes = (error / jnp.maximum(jnp.sum(error), _LEAST) for error in (weight, holes))
            weight += self.options.hole_weight * holes
        return crop(example, key, size=self.options.crop, weight=weight)

    def loss(self, model: nnx.Module, batch: Batch) -> tuple[Array, Mapping[str, Array]]:
        """The loss in the space that the options say, its mean over the batch."""
        o = self.options
        predicted, truth = self._measured(_predict(model, batch), batch)
        valid = _valid(batch["mask"], o.hole_margin)
        if o.loss == "relative":
            guess, _ = self._measured(batch["x"][..., :3], batch)
            holes = jnp.where(valid < 0.5, truth, jnp.nan)  # NaN does not count
            whole, hole = (
                jnp.mean(jax.vmap(partial(relative_loss, epsilon=least))(predicted, target, guess))
                for target, least in ((truth, _LEAST_ERROR), (holes, _LEAST_HOLE_ERROR))
            )
            return whole + o.hole_weight * hole, {"whole": whole, "hole": hole}
        how: dict[str, Any] = {"hole_weight": o.hole_weight, "shade_weight": o.shade_weight}
        how |= {"shade": o.shade, "fraction": o.shade_fraction}
        total, parts = jax.vmap(lambda *a: extranet_loss(*a, **how))(predicted, truth, valid.astype(jnp.float32))
        return jnp.mean(total), {name: jnp.mean(part) for name, part in parts.items()}

    def validate(self, model: nnx.Module) -> tuple[Mapping[str, float], Mapping[str, Any]]:
        """dB of the method's frames: "psnr", in holes "psnr_hole"; "guess" without the network, "gain" over that."""
        if self._validation is None:
            windows = list(map(lean, self._windows.held(self.options.validation)))
            self._validation = Validation(windows, "guess", first_guess(self._stages), holes=True)
        scores, images = self._validation(self._stages.with_weights(inference(model)[1]))
        return {"gain": scores["psnr"] - scores["guess"], **scores}, images


def _valid(mask: Array, margin: int) -> Array:
    """A mask `[..., H, W, 1]`, 0 in holes, with the holes wider by a margin."""
    window = (*(1,) * (mask.ndim - 3), 2 * margin + 1, 2 * margin + 1, 1)
    return -jax.lax.reduce_window(-mask, -jnp.inf, jax.lax.max, window, (1,) * mask.ndim, "SAME") if margin else mask


def _predict(model: Any, batch: Batch) -> Array:
    history = jnp.moveaxis(batch["history"], 3, 1) if "history" in batch else None
    return model(batch["x"], batch["mask"], batch.get("features"), history)


def _display(light: Array, divisor: Array) -> Array:
    """Light in the log domain as an image after a tone curve; NaN stays.

    The curve is sqrt(x / (1 + x)) begun at 0.001, where its slope is 16, and goes on straight below 0, so that what is
    too dark can learn.
    """
    known = jnp.isfinite(light)
    image = jnp.expm1(jnp.minimum(jnp.where(known, light, 0), _BRIGHTEST)) * divisor
    lit = image > 0
    mapped = jnp.sqrt(1 - 1 / (1 + _DARKEST + jnp.where(lit, image, 0)))
    return jnp.where(known, jnp.where(lit, mapped, mapped + image * (0.5 / _DARKEST**0.5)), jnp.nan)
