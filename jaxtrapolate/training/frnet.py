"""Training of FRNet (Wu et al. 2023, sections 4.3 and 4.5): its method's own stages prepare, it learns the flow."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, PRNGKeyArray

from jaxtrapolate.checks import Size, check_choice, check_present
from jaxtrapolate.evaluation.windows import Window
from jaxtrapolate.methods.extrass import (
    REFINE_NAME,
    Blend,
    Refinement,
    alike,
    encoded_truth,
    extrass_refine,
    extrass_refine_config,
    extrass_warp,
    half,
    have_albedo,
    taken,
)
from jaxtrapolate.methods.stage import Values
from jaxtrapolate.methods.stages import reflecting
from jaxtrapolate.networks.blocks import pixel_shuffle, pixel_unshuffle
from jaxtrapolate.networks.frnet import FRNet, FRNetConfig, Refined
from jaxtrapolate.networks.inference import inference
from jaxtrapolate.ops.radiance import compress, demodulation_divisor
from jaxtrapolate.training.augment import crop
from jaxtrapolate.training.config import check_range
from jaxtrapolate.training.extrass_losses import census_loss, feature_census_loss
from jaxtrapolate.training.losses import charbonnier_loss, relative_loss
from jaxtrapolate.training.tasks import Batch, Example
from jaxtrapolate.training.validation import Validation, lean
from jaxtrapolate.training.windows import WindowOptions, Windows, check_crop


@dataclasses.dataclass(frozen=True)
class FRNetOptions:
    """What is learned, from what.

    Attributes:
        network: its size, and what is left out of it.
        preparation: what it is shown; goes into the file of its weights.
        windows: the examples.
        crop: `(H, W)` of an item, of frames at half size.
        loss: "answer", eq. 7, of the network's own answer at half size; or "blend", `relative_loss` of the frame at
            full size that is made of it, after a tone curve, against the guided warp. What has changed little is taken
            there too (eq. 6's second test is left out), so that all of it learns.
        crops: with "blend": "even", anywhere; or "error", around pixels drawn by the guided warp's squared error.
        census_weight: of `census_loss` with patches of 7 x 7, beside `charbonnier_loss`.
        feature_weight: of `feature_census_loss`, the paper's lambda.
        validation: windows that validation looks at.
    """

    network: FRNetConfig = dataclasses.field(default_factory=FRNetConfig)
    preparation: Refinement = dataclasses.field(default_factory=Refinement)
    windows: WindowOptions = dataclasses.field(default_factory=WindowOptions)
    crop: Size = (96, 128)
    loss: Literal["answer", "blend"] = "answer"
    crops: Literal["even", "error"] = "even"
    census_weight: float = 1.0
    feature_weight: float = 0.001
    validation: int = 36

    def __post_init__(self) -> None:
        for name in ("census_weight", "feature_weight"):
            check_range(self, name, least=0)
        check_range(self, "validation", least=1)
        check_choice("loss", self.loss, ("answer", "blend"))
        check_choice("crops", self.crops, ("even", "error"))
        if self.crops == "error" and self.loss != "blend":
            raise ValueError('crops: "error" is of the loss "blend", whose examples hold what the guided warp errs by')
        height, width = self.windows.size
        check_crop(self.crop, (-(-height // 2), -(-width // 2)))


class FRNetTask:
    """Trains an `FRNet` on what the method "extrass_refine" shows it. Where the sky is, nothing is learned.

    An example holds the network's inputs "newer", "older" and "roughness", of a network that is led "lead", and
    "target", the true frame as they are, at half size; NaN at the sky. For "blend" also, as `pixel_unshuffle` has it,
    "own", the guided warp at full size as FRNet would see it, "divisor", the target's reflectance, "truth", the true
    frame after the tone curve, NaN at the sky, "alike", eq. 6's first test, and for crops by error "weight".

    References: Wu et al. 2023 (ExtraSS), eq. 7-9. Eq. 7 is taken of the network's own answer: as printed it is of the
    guided warp, which has no parameters. The truth's features are held, see `feature_census_loss`.
    """

    score = "gain"
    adapts = ("preparation",)

    def __init__(self, options: FRNetOptions = FRNetOptions()) -> None:
        self.options = options
        # preparation looks at the configuration alone
        model = FRNet(options.network, rngs=nnx.Rngs(0))
        self._stages = extrass_refine(model, preparation=options.preparation)
        self._windows = Windows(options.windows, self._prepare, past=self._stages.past)
        self._windows.check_sizes()
        self.sequences = self._windows.sequences
        self._validation: Validation | None = None
        config = extrass_refine_config(options.network, options.preparation)
        scenes = ", ".join(options.windows.scenes)
        self.about: Mapping[str, Any] = {"method": REFINE_NAME, "config": config, "note": f"trained on {scenes}"}

    def _prepare(self, window: Window, key: PRNGKeyArray) -> Example:
        del key
        method = self._stages
        values = method.values_before("network", method.state, (), window.history, window.target)
        newer, older, roughness, *lead = values["inputs"]
        buffers = check_present("gbuffer", window.truth.gbuffer, needed_by="training")
        color = check_present("color", window.truth.color, needed_by="training")
        target = encoded_truth(color, buffers, preparation=self.options.preparation)
        if buffers.sky is not None:
            target = jnp.where(half(buffers.sky) > 0.5, jnp.nan, target)
        example = {"newer": newer, "older": older, "roughness": roughness, "target": target.astype(newer.dtype)}
        if lead:
            example["lead"] = lead[0]
        return example if self.options.loss == "answer" else example | self._whole(values, window, color)

    def _whole(self, values: Values, window: Window, color: Array) -> Example:
        """What there is at full size of a window, four pixels to one at half size."""
        preparation = self.options.preparation
        target = window.target.gbuffer
        divided = not preparation.modulated and have_albedo(target, *(source.gbuffer for source in values["sources"]))
        own = preparation.encode(values["warped" if divided else "image"][..., :3])
        divisor, truth = jnp.ones_like(own), compress(color)
        if divided:
            how: dict[str, Any] = {"by": preparation.by, "floor": preparation.floor}
            divisor = demodulation_divisor(reflecting(target, preparation.sky), **how) * divisor
        if target is not None and target.sky is not None:
            truth = jnp.where(target.sky > 0.5, jnp.nan, truth)
        same = (alike(target, own) > Blend().similar).astype(own.dtype)
        whole = {"own": own, "divisor": divisor, "truth": truth.astype(own.dtype), "alike": same}
        if self.options.crops == "error":
            off = jnp.square(compress(preparation.decode(own) * divisor) - truth)
            whole["weight"] = jnp.mean(jnp.nan_to_num(off), -1, keepdims=True)
        odd = (*((0, n % 2) for n in own.shape[:2]), (0, 0))
        modes: dict[str, dict[str, Any]] = {"own": {"mode": "edge"}, "truth": {"constant_values": jnp.nan}}
        packed = {
            name: pixel_unshuffle(jnp.pad(image, odd, **modes.get(name, {}))[None])[0] for name, image in whole.items()
        }
        if "weight" in packed:
            packed["weight"] = jnp.sum(packed["weight"], -1, keepdims=True)
        return packed

    def init(self, rngs: nnx.Rngs) -> nnx.Module:
        """A new network."""
        return FRNet(self.options.network, rngs=rngs)

    def pool(self, key: PRNGKeyArray, numbers: range) -> Example:
        """Prepared windows of the scenes' training seeds."""
        return self._windows.pool(key, numbers)

    def sample(self, example: Example, key: PRNGKeyArray) -> Batch:
        """A random crop."""
        weight = example.pop("weight") if "weight" in (example := dict(example)) else None
        return crop(example, key, size=self.options.crop, weight=weight)

    def loss(self, model: nnx.Module, batch: Batch) -> tuple[Array, Mapping[str, Array]]:
        """The mean over the batch, of `relative_loss` or of `charbonnier_loss` + `census_loss` + `feature_census_loss`.

        The latter two times their weights.
        """
        found, truth = _predict(model, batch)
        if self.options.loss == "blend":
            share = jnp.mean(jax.vmap(relative_loss)(*self._blended(found, batch)))
            return share, {"share": share}
        parts = {
            "charbonnier": jax.vmap(charbonnier_loss)(found.image, batch["target"]),
            "census": jax.vmap(census_loss)(found.image, batch["target"]),
            "feature": jax.vmap(feature_census_loss)(found.features, truth),
        }
        means = {name: jnp.mean(part) for name, part in parts.items()}
        o = self.options
        total = means["charbonnier"] + o.census_weight * means["census"] + o.feature_weight * means["feature"]
        return total, means

    def _blended(self, found: Refined, batch: Batch) -> tuple[Array, Array, Array]:
        """The frame that is made of the network's answer, the true one and the guided warp, after the tone curve."""
        preparation = self.options.preparation
        own, divisor, truth, same = (pixel_shuffle(batch[name]) for name in ("own", "divisor", "truth", "alike"))
        moved = jax.vmap(lambda *images: taken(preparation, *images))(own, batch["newer"], found.image, found.flow)
        made, guess = (compress(preparation.decode(light) * divisor) for light in (moved, own))
        return jnp.where(same > 0, made, guess), truth, guess

    def validate(self, model: nnx.Module) -> tuple[Mapping[str, float], Mapping[str, Any]]:
        """dB of the method's frames: "psnr"; "warp", of the guided warp alone, and "gain" over that."""
        if self._validation is None:
            windows = list(map(lean, self._windows.held(self.options.validation)))
            self._validation = Validation(windows, "warp", extrass_warp())
        scores, images = self._validation(self._stages.with_weights(inference(model)[1]))
        return {"gain": scores["psnr"] - scores["warp"], **scores}, images


def _predict(model: Any, batch: Batch) -> tuple[Any, tuple[Array, ...]]:
    """What the network says, and what its encoder makes of the truth, where that is known, at the same levels."""
    newer, older, target = (batch[name] for name in ("newer", "older", "target"))
    roughness = batch["roughness"] if model.config.roughness else None
    found = model(newer, older, roughness, batch.get("lead"))
    truth = model.features(jnp.where(jnp.isfinite(target), target, newer), roughness, found.mean)
    return found, truth[: len(found.features)]
