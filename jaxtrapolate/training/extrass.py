"""Training of ExtraSSNet (Wu et al. 2023, sections 4.4 and 4.5), FRNet as it is: jittered frames and larger truth."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, PRNGKeyArray

from jaxtrapolate.checks import Size, check_choice, check_present, missing_package
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.methods.extrass import REFINE_NAME, Refinement, read_refine
from jaxtrapolate.methods.extrass_joint import NAME, extrass, extrass_config
from jaxtrapolate.methods.supersampling import upsampled_motion
from jaxtrapolate.methods.upsampling import taau
from jaxtrapolate.metrics.image import psnr
from jaxtrapolate.networks.blocks import pixel_shuffle, pixel_unshuffle
from jaxtrapolate.networks.extrass import ExtraSS, ExtraSSConfig, ExtraSSNetConfig
from jaxtrapolate.networks.frnet import FRNet, FRNetConfig
from jaxtrapolate.ops.upsample import upsample
from jaxtrapolate.ops.warp import backward_warp, in_frame
from jaxtrapolate.records import Frame
from jaxtrapolate.scenes import Scene, render, scene, scene_names
from jaxtrapolate.scenes.sequence import jitter_of
from jaxtrapolate.training.augment import crop
from jaxtrapolate.training.config import check_range
from jaxtrapolate.training.extrass_losses import (
    Scale,
    feature_difference_loss,
    perceptual_loss,
    slope_loss,
    temporal_loss,
)
from jaxtrapolate.training.losses import hole_loss, l1_loss
from jaxtrapolate.training.tasks import Batch, Example
from jaxtrapolate.training.windows import MOVING, SEEDS, VALIDATION_SEEDS, check_crop
from jaxtrapolate.weights import default_weights

_TIMES = (0.0, 120.0)  # of a scene


@dataclasses.dataclass(frozen=True)
class ExtraSSOptions:
    """What is learned, from what.

    Attributes:
        sampler: the size of the network.
        refinement: a file of weights of "extrass_refine", or "default", whose FRNet and preparation are used; empty: a
            new FRNet, which moves next to nothing.
        size: `(H, W)` of the low-resolution frames.
        scenes: their names.
        step: frames' least and largest distance in a scene's own time, uniform between.
        accumulated: frames that the history of the frame before the target is made of.
        first: the share of items in which that frame has none.
        samples: of a pixel of the truth.
        crop: `(H, W)` of an item, in low-resolution pixels.
        occlusion_weight: of `hole_loss` where the frame before shows something else.
        perceptual_weight: of the perceptual term.
        perceptual: that term: "vgg", `perceptual_loss`, or without its package "slopes", `slope_loss`.
        temporal_weight: of eq. 13's first term.
        feature_weight: of its second term. The paper's is 1 too, of features whose size it does not say; compared as
            "relative" that term is then by far the largest, and the network learns little else: after 2,500 steps what
            it made was 4.5 dB below its bilinear upsampling.
        disoccluded: whether what is disoccluded counts in eq. 13's first term, as printed; see `temporal_loss`.
        features: how features are compared in its second term, see `feature_difference_loss`.
        validation: examples that validation looks at.
    """

    sampler: ExtraSSNetConfig = dataclasses.field(default_factory=ExtraSSNetConfig)
    refinement: str = ""
    size: Size = (90, 160)
    scenes: tuple[str, ...] = MOVING
    step: tuple[float, float] = (0.5, 1.5)
    accumulated: int = 8
    first: float = 0.125
    samples: int = 16
    crop: Size = (64, 64)
    occlusion_weight: float = 1.0
    perceptual_weight: float = 0.01
    perceptual: Literal["vgg", "slopes"] = "vgg"
    temporal_weight: float = 1.0
    feature_weight: float = 0.01
    disoccluded: bool = False
    features: Scale = "relative"
    validation: int = 24

    def __post_init__(self) -> None:
        for name in ("occlusion_weight", "perceptual_weight", "temporal_weight", "feature_weight"):
            check_range(self, name, least=0)
        check_range(self, "first", least=0, most=1)
        for name in ("accumulated", "samples", "validation"):
            check_range(self, name, least=1)
        for name in self.scenes:
            check_choice("scenes", name, scene_names())
        if not self.scenes:
            raise ValueError("scenes: expected some, got none")
        if not 0 < self.step[0] <= self.step[1] < np.inf:
            raise ValueError(f"step: expected [least, largest] above 0, got {list(self.step)}")
        check_crop(self.crop, self.size)


class ExtraSSTask:
    """Trains the `ExtraSSNet` of an `ExtraSS` on two frames in a row; its FRNet only prepares what that is shown.

    The frame before the target is super sampled with what "taau" makes of the frames before it as its history, or as
    the first one of a run. Its answer, warped, is the history of the target, which is answered twice: as a rendered
    frame, and extrapolated from the rendered frames one and three before it. So both encoders see one frame, and both
    answers are compared with one truth.

    An example holds arrays at the input's size, those of the output's size by `pixel_unshuffle`: "before", the frame
    before the target, and "history", the answer before that; "color", the target rendered, "refined" and "guided",
    extrapolated; "albedo"; "depths", "jitters" and "motions" to the frame before, of both frames; "holes" there, of the
    target; "truths" of both.

    References: Wu et al. 2023 (ExtraSS), eq. 11-14. Departures: `disoccluded` and `features`, where the printed losses
    are least for ghosts and for no features at all, and the frame before is supervised too, by eq. 12.
    """

    score = "gain"

    def __init__(self, options: ExtraSSOptions = ExtraSSOptions()) -> None:
        self.options = options
        self._frnet: FRNet | None = None
        self._preparation, refining = Refinement(), FRNetConfig()
        if options.refinement:
            given = options.refinement
            self._frnet, self._preparation = read_refine(default_weights(REFINE_NAME) if given == "default" else given)
            refining = self._frnet.config
        self._config = ExtraSSConfig(refining, options.sampler)
        self._stages = extrass(self.init(nnx.Rngs(0)), preparation=self._preparation)
        self._accumulating = taau(options.sampler.scale)
        # of the frames of an example, the last one the target
        self._numbers = range(min(1 - 2 * self._stages.past, -1 - options.accumulated), 1)
        # scenes are compiled each, what is made of their frames once
        self._draw, self._prepared = jax.jit(self._drawing), jax.jit(self._prepare)
        self._held: list[Example] = []
        deep = options.perceptual == "vgg" and missing_package("lpips") is None
        self._perceptual = perceptual_loss if deep else slope_loss
        config = extrass_config(self._config, self._preparation)
        note = f"trained on {', '.join(options.scenes)}, {'with' if deep else 'without'} features of VGG-16"
        self.about: Mapping[str, Any] = {"method": NAME, "config": config, "note": note}

    def init(self, rngs: nnx.Rngs) -> ExtraSS:
        """A new ExtraSSNet, with the FRNet that is given."""
        model = ExtraSS(self._config, rngs=rngs)
        if self._frnet is not None:
            nnx.update(model.frnet, nnx.state(self._frnet))
        return model

    def _drawing(
        self, world: Scene, time: Array, step: Array, jitters: Float[Array, "n 2"]
    ) -> tuple[Frame, Float[Array, "two i j 3"]]:
        """The frames of one place in a scene, stacked, and what the last two of them show, as larger ones."""
        options = self.options
        larger = (options.sampler.scale * options.size[0], options.sampler.scale * options.size[1])

        def draw(number: Array, jitter: Array) -> Frame:
            now = time + number * step
            return render(world, now, size=options.size, jitter=jitter, previous_time=now - step)

        def truth(number: Array) -> Array:
            frame = render(world, time + number * step, size=larger, samples=options.samples)
            return jnp.asarray(check_present("color", frame.color, needed_by="training"))

        frames = jax.lax.map(lambda pair: draw(*pair), (jnp.array(self._numbers, jnp.float32), jitters))
        return frames, jax.lax.map(truth, jnp.array([-1, 0], jnp.float32))

    def _prepare(self, frames: Frame, truths: Float[Array, "two i j 3"]) -> Example:
        """What the network is shown of them."""
        scale, (height, width), method = self.options.sampler.scale, self.options.size, self._stages
        *seen, target = (jax.tree.map(lambda leaf, k=k: leaf[k], frames) for k in range(len(self._numbers)))
        needed = seen[1 - 2 * method.past :]
        # every other one rendered
        *history, before = (hide(frame) if k % 2 else frame for k, frame in enumerate(needed))
        history = tuple(history)
        carry = method.init(history, before)
        at = functools.partial(method.values_before, "super sampling", method.state, carry)
        first, extrapolated = at(history, before), at((*history, before), hide(target))
        rendered = at((*history, before), target)
        refined, _, depth, _, guided, albedo = extrapolated["sampled"]
        motions = [upsampled_motion(values["history"], values["target"], scale) for values in (first, extrapolated)]
        jitters = jnp.concatenate([jnp.asarray(frame.jitter) for frame in (before, target)])
        return {
            "before": first["sampled"][0],
            "color": rendered["sampled"][0],
            "refined": refined,
            "guided": guided,
            "albedo": albedo,
            "depths": jnp.concatenate([first["sampled"][2], depth], -1),
            "jitters": jnp.broadcast_to(jitters, (height, width, 4)),
            "history": pixel_unshuffle(self._preparation.encode(self._accumulated(frames))[None], scale)[0],
            "motions": jnp.concatenate([*pixel_unshuffle(jnp.stack(motions), scale)], -1),
            "holes": extrapolated["holes"].astype(depth.dtype),
            "truths": jnp.concatenate([*pixel_unshuffle(self._preparation.encode(truths), scale)], -1),
        }

    def _accumulated(self, frames: Frame) -> Float[Array, "i j 3"]:
        """The answer of "taau" to the frame two before the target, from all frames before."""
        first, count = jax.tree.map(lambda leaf: leaf[0], frames), len(self._numbers) - 2
        pairs = [jax.tree.map(lambda leaf, k=k: leaf[k : count - 1 + k], frames) for k in (0, 1)]
        carry, image = self._accumulating.step(self._accumulating.init((), first), (), first)

        def step(kept: Any, pair: Any) -> tuple[Any, None]:
            return self._accumulating.step(kept[0], (pair[0],), pair[1]), None

        return jax.lax.scan(step, (carry, image), tuple(pairs))[0][1]

    def _drawn(self, words: list[int], number: int, seeds: range) -> Example:
        rng, options = np.random.default_rng([*words, number]), self.options
        world = scene(options.scenes[rng.integers(len(options.scenes))], seeds[int(rng.integers(len(seeds)))])
        time, step = (np.float32(rng.uniform(*bounds)) for bounds in (_TIMES, options.step))
        begun = int(rng.integers(16))
        jitters = np.stack([jitter_of(begun + k) for k in range(len(self._numbers))]).astype(np.float32)
        return self._prepared(*self._draw(world, jnp.asarray(time), jnp.asarray(step), jnp.asarray(jitters)))

    def pool(self, key: PRNGKeyArray, numbers: range) -> Example:
        """Prepared places in the scenes' training seeds."""
        words = np.asarray(jax.random.key_data(key)).tolist()
        examples = [self._drawn(words, number, SEEDS) for number in numbers]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *examples)

    def sample(self, example: Example, key: PRNGKeyArray) -> Batch:
        """A random crop; of the share `first` without a history, as the first frame of a run."""
        place, chance = jax.random.split(key)
        batch = crop(example, place, size=self.options.crop)
        first = jax.random.bernoulli(chance, self.options.first)
        return batch | {"history": jnp.where(first, jnp.nan, batch["history"])}

    def loss(self, model: nnx.Module, batch: Batch) -> tuple[Array, Mapping[str, Array]]:
        """Eq. 14: the mean of eq. 12 over three answers, and eq. 13 over the two to the target."""
        options, shown = self.options, _answers(model, batch)
        whole = jnp.ones_like(shown["valid"])
        pairs = [("before", "truth before", whole), *((name, "truth", shown["valid"]) for name in ("color", "refined"))]
        parts = {name: jnp.zeros((), jnp.float32) for name in ("l1", "occlusion", "perceptual", "temporal")}
        for answer, truth, valid in pairs:
            image, wanted = shown[answer].image, shown[truth]
            parts["l1"] += jnp.mean(jax.vmap(l1_loss)(image, wanted)) / len(pairs)
            parts["occlusion"] += jnp.mean(jax.vmap(hole_loss)(image, wanted, valid)) / len(pairs)
            parts["perceptual"] += jnp.mean(jax.vmap(self._perceptual)(image, wanted)) / len(pairs)
        for answer in ("color", "refined"):
            where = () if options.disoccluded else (shown["valid"],)
            parts["temporal"] += jnp.mean(jax.vmap(temporal_loss)(shown[answer].image, shown["warped"], *where)) / 2
        compare = jax.vmap(functools.partial(feature_difference_loss, scale=options.features))
        parts["features"] = jnp.mean(compare(shown["color"].features, shown["refined"].features))
        spatial = parts["l1"] + options.occlusion_weight * parts["occlusion"]
        spatial += options.perceptual_weight * parts["perceptual"]
        temporal = options.temporal_weight * parts["temporal"] + options.feature_weight * parts["features"]
        return spatial + temporal, parts

    def validate(self, model: nnx.Module) -> tuple[Mapping[str, float], Mapping[str, Any]]:
        """dB after the tone curve: "psnr_rendered", "psnr_extrapolated", and "gain" over their bilinear upsampling."""
        if not self._held:
            words = np.asarray(jax.random.key_data(jax.random.key(0))).tolist()
            numbers = range(self.options.validation)
            self._held = [jax.device_get(self._drawn(words, number, VALIDATION_SEEDS)) for number in numbers]
        rows = [_scored(model, jax.tree.map(lambda leaf: leaf[None], example)) for example in self._held]
        scores = {name: float(np.mean([row[0][name] for row in rows])) for name in rows[0][0]}
        images = {f"example{k}": np.asarray(row[1]) for k, row in enumerate(rows[:4])}
        means = [(scores[f"{kind}_rendered"] + scores[f"{kind}_extrapolated"]) / 2 for kind in ("psnr", "bilinear")]
        return {"gain": means[0] - means[1], **scores}, images


def _answers(model: Any, batch: Batch) -> dict[str, Any]:
    """What the network says of both frames, and what that is compared with, at the output's size."""
    sampler, count = model.sampler, batch["truths"].shape[-1] // 2
    scale = sampler.config.scale
    truths = [pixel_shuffle(batch["truths"][..., k : k + count], scale) for k in (0, count)]
    jitters = batch["jitters"][:, 0, 0]
    earlier, now = jitters[:, :2], jitters[:, 2:]
    depths = batch["depths"][..., :1], batch["depths"][..., 1:]

    @jax.vmap
    def larger(image: Array, jitter: Array) -> Array:
        return upsample(image, scale=scale, jitter=jitter)

    motions = [pixel_shuffle(part, scale) for part in jnp.split(batch["motions"], 2, -1)]

    def fetched(image: Array, motion: Array, color: Array, jitter: Array) -> tuple[Array, Array, Array]:
        """An answer along the motion, where there is one, and the history: that, or else the frame, upsampled."""
        warped = jax.vmap(backward_warp)(image, motion)
        known = jax.vmap(in_frame)(motion)[..., None] & jnp.all(jnp.isfinite(warped), -1, keepdims=True)
        return warped, known, jnp.where(known, warped, larger(color, jitter))

    history = fetched(pixel_shuffle(batch["history"], scale), motions[0], batch["before"], earlier)[2]
    before = sampler(batch["before"], history, depths[0], earlier)
    warped, known, _ = fetched(before.image, motions[1], batch["before"], earlier)
    nearest = functools.partial(upsample, scale=scale, filter="nearest")
    holes = jax.vmap(lambda image, jitter: nearest(image, jitter=jitter))(batch["holes"], now)
    found: dict[str, Any] = {"before": before, "warped": warped, "truth before": truths[0], "truth": truths[1]}
    found["valid"] = jnp.where(known & (holes < 0.5), 1, 0).astype(warped.dtype)
    for name in ("color", "refined"):
        found[f"{name} larger"] = larger(batch[name], now)
        history = jnp.where(known, warped, found[f"{name} larger"])
        more = () if name == "color" else (batch["guided"], batch["albedo"])
        found[name] = sampler(batch[name], history, depths[1], now, *more)
    return found


@nnx.jit
def _scored(model: Any, example: Batch) -> tuple[dict[str, Array], Array]:
    shown, scores = _answers(model, example), {}
    truth = shown["truth"][0]
    for name, kind in (("color", "rendered"), ("refined", "extrapolated")):
        scores[f"psnr_{kind}"] = psnr(shown[name].image[0], truth)
        scores[f"bilinear_{kind}"] = psnr(shown[f"{name} larger"][0], truth)
    pictures = [truth, shown["color"].image[0], shown["refined"].image[0]]
    return scores, jnp.clip(jnp.concatenate(pictures, 1), 0, 1)
