"""ExtraSS at the input's resolution (Wu et al. 2023): the guided warp, and its shading refined by FRNet at half size.

Half size is every other pixel of every other row, of colours and buffers alike: pixel p of it is pixel 2p, and motion
there is half as long. Upsampled, each stands for the 2 x 2 pixels from there on (the paper's nearest upsampling).

Values passed on: "inputs", what FRNet is shown, and "refined", what it has made of it, both at half size; "moves",
bool, whether it was asked at all.
"""

import dataclasses
from collections.abc import Callable, Mapping
from os import PathLike
from typing import Any, Literal, get_args

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_choice
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.methods.shading import Continued, light_stages
from jaxtrapolate.methods.space import Space, space
from jaxtrapolate.methods.stage import Needed, Stage, Values
from jaxtrapolate.methods.stages import (
    HOLES,
    REPROJECT,
    SKY,
    demodulate_stage,
    find_holes,
    modulate_stage,
    reflecting,
    reproject_stage,
)
from jaxtrapolate.methods.warping import Guide, fetch_guided, guided_stage, guides_of
from jaxtrapolate.networks.blocks import upsample_2x
from jaxtrapolate.networks.frnet import FRNet, FRNetConfig, Refined
from jaxtrapolate.networks.inference import inference
from jaxtrapolate.networks.stored import load_network
from jaxtrapolate.ops.radiance import By, compress, demodulate, expand, log_decode, log_encode, modulate
from jaxtrapolate.ops.warp import backward_warp, root
from jaxtrapolate.precision import divide, widest
from jaxtrapolate.records import GBuffer
from jaxtrapolate.weights import configured

WARP_NAME, REFINE_NAME = "extrass_warp", "extrass_refine"

Curve = Literal["tone", "log"]
Taken = Literal["light", "change", "flow"]


@settings
class ExtraSSWarp(Guide):
    """Of the guided warp as the paper has it, demodulated by the base colour alone."""

    by: By = option("albedo", "what the colour is divided by before it is warped", choices=By)
    floor: float = option(0.01, "the smallest divisor", low=0, high=1)
    sky: bool = option(True, "whether the sky's colour is warped undivided; else its albedo counts")
    space: Space = space()


def extrass_warp() -> Method:
    """The guided warp alone, demodulated by the base colour (ExtraSS, "Ours-W").

    `guided_warp` without what is ours in it: hindsight, the material's specular part in the divisor, and bilinear
    fetching where all guides agree.

    References:
        Wu et al. 2023 (ExtraSS), section 4.2. Departures: the widths of the Gaussians, which are those of
        `guided_warp`, and `far_motion` before it, in frames of 360 rows or more (`rows`).
    """
    stages = (REPROJECT, HOLES, demodulate_stage(), guided_stage(), modulate_stage(), SKY)
    return Method(WARP_NAME, stages, settings=ExtraSSWarp())


@dataclasses.dataclass(frozen=True)
class Refinement:
    """How frames are prepared for FRNet; a part of its weights.

    Attributes:
        by, floor: of `demodulate`, before every warp.
        sky: whether the sky's colour is fed undivided; else demodulated like the rest, by the albedo stored there.
        modulated: whether FRNet is shown colours, as in the paper; else light, which the target's own reflectance at
            full size makes a colour again.
        curve: in which values it sees them: "tone", `compress`, or "log", `log_encode`.
        space: in which colours are fetched between pixels.
        taken: what of FRNet's answer is taken: "light", itself, as in the paper, or "change", what it has changed of
            its newer input, which is added to the guided warp at full size, whose detail stays; or "flow", where it
            has moved light, by which the guided warp is moved at full size. The latter two are ours.
        changed: from which relative difference to the guided warp on it is taken; the option `changed` begins there.
    """

    by: By = "albedo"
    floor: float = 1e-2
    sky: bool = True
    modulated: bool = True
    curve: Curve = "tone"
    space: Space = "tone"
    taken: Taken = "light"
    changed: float = 0.1

    def __post_init__(self) -> None:
        for name, choices in (("by", By), ("curve", Curve), ("space", Space), ("taken", Taken)):
            check_choice(name, getattr(self, name), get_args(choices))
        for name, value in (("floor", self.floor), ("changed", self.changed)):
            if not 0 <= value < float("inf"):
                raise ValueError(f"{name}: expected 0 or more, got {value!r}")

    def encode(self, image: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """Light as FRNet sees it, in at least float32; what is negative or NaN counts as 0."""
        image = image.astype(widest(image))
        return compress(image) if self.curve == "tone" else log_encode(jnp.where(jnp.isfinite(image), image, 0))

    def decode(self, image: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """The inverse of `encode`."""
        return expand(image) if self.curve == "tone" else log_decode(image)


@settings
class Blend(Guide):
    """Where FRNet's light is taken, and of the guided warps."""

    similar: float = option(0.1, "how much alike the surfaces of both sizes have to be at least", low=-1, high=1)
    changed: float = option(0.1, "relative difference to the guided warp from which on light is taken", low=0)
    softness: float = option(0.0, "half width of the steps at both thresholds", low=0, high=1)
    least: float = option(0.001, "brightness below which differences are no longer relative", low=1e-30)


@settings
class LedBlend(Blend, Continued):
    """And of the flow of light that FRNet begins with."""


def half(image: Float[Array, "h w c"]) -> Float[Array, "i j c"]:
    """Every other pixel of every other row: `[ceil(H / 2), ceil(W / 2), C]`."""
    return image[::2, ::2]


def doubled(image: Float[Array, "i j c"], like: Float[Array, "h w c"]) -> Float[Array, "h w c"]:
    """Each pixel of a halved image for those that it stands for, at the size of the whole one."""
    height, width = like.shape[:2]
    return jnp.repeat(jnp.repeat(image, 2, 0), 2, 1)[:height, :width]


def halved(buffers: GBuffer | None) -> GBuffer:
    """Buffers at half size."""
    given = {field.name: getattr(buffers or GBuffer(), field.name) for field in dataclasses.fields(GBuffer)}
    return GBuffer(**{name: None if value is None else half(jnp.asarray(value)) for name, value in given.items()})


def _step(x: Array, softness: Array) -> Array:
    """0 below -softness, 1 from there on above, straight between; with softness 0 whether x is over 0."""
    soft = softness > 0
    return jnp.where(soft, jnp.clip((x / jnp.where(soft, softness, 1) + 1) / 2, 0, 1), jnp.where(x > 0, 1, 0))


def taken(
    preparation: Refinement,
    own: Float[Array, "h w c"],
    before: Float[Array, "i j c"],
    after: Float[Array, "i j c"],
    flow: Float[Array, "i j f"],
) -> Float[Array, "h w c"]:
    """What FRNet's answer makes of the guided warp, images as `encode` has them.

    Args:
        preparation: whose `taken` says it.
        own: the guided warp at full size.
        before: the newer image that FRNet was shown, at half size.
        after: its answer.
        flow: its flow.
    """
    if preparation.taken == "flow":
        height, width = own.shape[:2]
        larger = 2 * upsample_2x(flow[None], aligned=False)[0, :height, :width]
        return backward_warp(own, larger.astype(own.dtype))
    before, after = (doubled(image, own) for image in (before, after))
    if preparation.taken == "light":
        return after
    return jnp.clip(own + (after - before), 0, jnp.maximum(own, jnp.maximum(before, after)))


def alike(buffers: GBuffer | None, like: Float[Array, "h w c"]) -> Float[Array, "h w 1"]:
    """How much each pixel's surface is that which stands for it at half size: eq. 6's first test, 1 where it is.

    Args:
        buffers: of the target; albedo and normal that are absent count as alike.
        like: an image of the result's dtype.
    """
    buffers, found = buffers or GBuffer(), jnp.ones_like(like[..., :1])
    if buffers.albedo is not None:
        albedo = jnp.asarray(buffers.albedo, like.dtype)
        apart = jnp.sum(jnp.square(doubled(half(albedo), albedo) - albedo), -1, keepdims=True)
        found -= root(apart / 3)
    if buffers.normal is not None:
        normal = jnp.clip(jnp.asarray(buffers.normal, like.dtype), -1, 1)  # no square overflows
        found *= jnp.sum(doubled(half(normal), normal) * normal, -1, keepdims=True)
    return found


def blend_mask(
    light: Float[Array, "h w 3"], warped: Float[Array, "h w 3"], buffers: GBuffer | None, how: Any
) -> Float[Array, "h w 1"]:
    """How much of the refined light is taken at each pixel, in 0..1.

    Where the surface at half size is like the pixel's own, and where that light differs from the warped frame's: at the
    sky never, nor where either is not finite.

    Args:
        light: `[H, W, 3]`, refined at half size and doubled.
        warped: `[H, W, 3]`, by the guided warp at full size.
        buffers: of the target, see `alike`.
        how: a `Blend`.

    References:
        Wu et al. 2023 (ExtraSS), eq. 6, with the sum of the channels' differences for its norm. Ours are `softness`,
        `least` and the sky.
    """
    buffers = buffers or GBuffer()
    similar, changed, softness, least = (
        jnp.asarray(v, light.dtype) for v in (how.similar, how.changed, how.softness, how.least)
    )
    known = jnp.all(jnp.isfinite(light) & jnp.isfinite(warped), -1, keepdims=True)
    light, warped = (jnp.where(known, a, 0).astype(light.dtype) for a in (light, warped))
    size = jnp.maximum(jnp.sum(jnp.abs(light), -1, keepdims=True), least)
    difference = divide(jnp.sum(jnp.abs(light - warped), -1, keepdims=True), size)
    mask = _step(alike(buffers, light) - similar, softness) * _step(difference - changed, softness)
    if buffers.sky is not None:
        known &= buffers.sky < 0.5
    return jnp.where(known, mask, 0)


def _halve_stage(preparation: Refinement, *, led: bool) -> Stage:
    """Both histories halved and guided-warped there, each by its own motion and buffers, and the halved roughness.

    led: whether the flow of light and the trust in it follow, halved too; where they are not known both are 0.
    """

    def function(state, values: Values):
        target, warped, sources = halved(values["target"].gbuffer), [], values["sources"]
        divided = have_albedo(target, *(source.gbuffer for source in sources))
        for source, motion in zip(sources[:2], values["motions"][:2], strict=True):
            buffers, color = halved(source.gbuffer), half(jnp.asarray(source.color))
            shorter = half(motion) / 2
            how: dict[str, Any] = {"by": preparation.by, "floor": preparation.floor}
            light = demodulate(color, reflecting(buffers, preparation.sky), **how) if divided else color
            holes = find_holes(target, buffers, shorter)
            light = fetch_guided(light, shorter, holes, target, buffers, state.settings, preparation.space)
            if divided and preparation.modulated:
                light = modulate(light, reflecting(target, preparation.sky), **how)
            warped.append(preparation.encode(light))
        newer, older = warped
        ones = jnp.ones_like(newer[..., :1])
        rough = ones if target.roughness is None else jnp.asarray(target.roughness, newer.dtype)
        inputs = (newer, older, jnp.where(jnp.isfinite(rough), rough, 1))
        if not led:
            return {"inputs": inputs}
        lead = jnp.zeros((*newer.shape[:2], 3), newer.dtype)
        if values["light_flow"] is not None:
            lead = jnp.concatenate([half(values["light_flow"]) / 2, half(values["trust"])], -1).astype(newer.dtype)
        return {"inputs": (*inputs, lead)}

    reads = ("since_oldest.motion", guides_of("history"))
    takes = ("target", "sources", "motions", *(("light_flow?", "trust?") if led else ()))
    return Stage("halved warps", function, takes, ("inputs",), reads=reads, past=2, optional=True)


def extrass_refine(model: FRNet, *, preparation: Refinement = Refinement()) -> Method:
    """The guided warp, its shading refined by a flow network at half size (ExtraSS, "Ours-E").

    The two newest rendered frames are halved and guided-warped to the target, each by its own buffers, the motion to
    the older one chained through the frames between. FRNet moves the newer one's light to where it is now: with the
    target's roughness, halved too, these are `values["inputs"]` before the stage "network". Where its answer differs
    from the guided warp at full size, and the surface is the same at both sizes, it is taken (`blend_mask`).

    A network that is led begins with the flow of light that `shading_warp` finds, and the trust in it.

    What a scene lacks is left out: without a second rendered frame, or motion that leads there, the answer is the
    guided warp; where the newer and the older frame agree everywhere, no light moves, and no network runs; no albedo,
    no demodulation; roughness that is absent counts as 1. The options are those of the guided warps and of the blend.

    Args:
        model: of any configuration.
        preparation: what the model was trained on.

    References:
        Wu et al. 2023 (ExtraSS), section 4.3, eq. 4-6. Departures: see `blend_mask` and `extrass_warp`; what the paper
        leaves open of the network says `jaxtrapolate.networks.FRNet`.
    """
    function, weights = inference(model)
    stages = (*refinement_stages(function, model.config, preparation, weights_of=lambda all: all), SKY)
    how: Any = LedBlend if model.config.led else Blend
    given: dict[str, Any] = {"settings": how(changed=preparation.changed), "networks": {"network": function}}
    past = 3 if model.config.led else 2
    return Method(REFINE_NAME, stages, past=past, weights=weights, **given)


def refinement_stages(
    function: Callable[..., Refined],
    config: FRNetConfig,
    preparation: Refinement,
    *,
    weights_of: Callable[[Any], Any],
) -> tuple[Stage, ...]:
    """The stages of `extrass_refine` that give the generated frame as "image", and the guided warp alone as "guided".

    Args:
        function: FRNet, as `inference` has it.
        config: its configuration.
        preparation: what it was trained on.
        weights_of: takes its weights out of the method's.
    """

    if config.merge and preparation.taken == "flow":
        raise ValueError('taken: "flow" is of a network that moves the newer frame alone, without merge')

    def network(state, values: Values):
        newer, older, roughness, *lead = values["inputs"]
        found = function(weights_of(state.weights), newer, older, roughness if config.roughness else None, *lead)
        return {"refined": found.image, "refined_flow": found.flow, "moves": jnp.ones((), bool)}

    def blend(state, values: Values):
        target, warped = values["target"].gbuffer, values["image"]
        divisor = None if preparation.modulated else values["divisor"]
        own = preparation.encode(warped if divisor is None else values["warped"])
        answer = values["inputs"][0], values["refined"], values["refined_flow"]
        light = preparation.decode(taken(preparation, own, *answer))
        if divisor is not None:
            light = light * divisor.astype(light.dtype)
        mask = jnp.where(values["moves"], blend_mask(light, warped, target, state.settings), 0)
        light = jnp.where(jnp.isfinite(light), light, 0)
        mixed = light * mask + warped.astype(light.dtype) * (1 - mask)
        return {"image": jnp.where(mask > 0, mixed.astype(warped.dtype), warped)}

    def unmoved(state, values: Values):
        newer = values["inputs"][0]
        flow = jnp.zeros((*newer.shape[:2], 4 if config.merge else 2), widest(newer))
        return {"refined": newer, "refined_flow": flow, "moves": jnp.zeros((), bool)}

    given = ("refined", "refined_flow", "moves")
    blended = ("image", "warped", "divisor?", "inputs", *given, "target")
    still = Needed("light moves", lambda state, values: jnp.any(values["inputs"][0] != values["inputs"][1]), unmoved)
    moved = light_stages(preparation.space)[:-1] if config.led else ()  # FRNet moves it
    return (
        reproject_stage(3 if config.led else 2),
        HOLES,
        demodulate_stage(preparation),
        guided_stage(preparation.space),
        *moved,
        modulate_stage(preparation),
        Stage("guided frame", lambda state, values: {"guided": values["image"]}, ("image",), ("guided",)),
        _halve_stage(preparation, led=config.led),
        Stage(
            "network", network, ("inputs",), ("refined", "refined_flow", "moves"), optional=True, past=2, needed=still
        ),
        Stage("blend", blend, blended, ("image",), optional=True, past=2),
    )


def have_albedo(*buffers: GBuffer | None) -> bool:
    """Whether all have it, so that light is divided by it."""
    return all(b is not None and b.albedo is not None for b in buffers)


def encoded_truth(
    color: Float[Array, "h w 3"], buffers: GBuffer | None, *, preparation: Refinement
) -> Float[Array, "i j 3"]:
    """The answer that FRNet should give: a frame's true colour at half size, as `preparation` has it.

    Args:
        color: `[H, W, 3]`, linear radiance.
        buffers: of the same frame; without albedo nothing is demodulated.
        preparation: of the network that is trained.

    Raises:
        TypeError, ValueError: no floating-point array, or a size that differs.
    """
    if not preparation.modulated and have_albedo(buffers):
        given = reflecting(buffers, preparation.sky)
        color = demodulate(color, given, by=preparation.by, floor=preparation.floor)
    return preparation.encode(half(color))


def extrass_refine_config(config: FRNetConfig, preparation: Refinement) -> dict[str, Any]:
    """What a file of weights states about them, as `load_refine` reads it."""
    return {"network": dataclasses.asdict(config), "preparation": dataclasses.asdict(preparation)}


def read_refine(path: str | PathLike[str]) -> tuple[FRNet, Refinement]:
    """An FRNet and its preparation, from a file of weights of "extrass_refine"; see `load_network`."""

    def build(stated: Mapping[str, Any]):
        config = configured(FRNetConfig, stated.get("network", {}), source=str(path))
        return lambda: FRNet(config, rngs=nnx.Rngs(0))

    model, stated = load_network(path, REFINE_NAME, build)
    return model, configured(Refinement, stated.get("preparation", {}), source=str(path))


def load_refine(path: str | PathLike[str]) -> Method:
    """The method "extrass_refine" with the weights in a file; see `read_refine`."""
    model, preparation = read_refine(path)
    return extrass_refine(model, preparation=preparation)
