"""ExtraNet as a method (Guo et al. 2021): three warped rendered frames and the target's buffers, shaded by a network.

Histories are warped demodulated, holes are marked, and the network answers in the log domain. What it is shown is its
`Preparation`, which is a part of its weights: the authors' network needs `RELEASE`, as their release prepares it.
"""

import dataclasses
from collections.abc import Mapping
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Literal, get_args

import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_choice
from jaxtrapolate.errors import printable
from jaxtrapolate.methods.hindsight import hindsight_stage
from jaxtrapolate.methods.memory import remember_stage, start
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.options import settings
from jaxtrapolate.methods.seen import Remembered, seen_before_stage
from jaxtrapolate.methods.shading import Continued, light_stages
from jaxtrapolate.methods.space import Space, in_space
from jaxtrapolate.methods.stage import Needed, Stage, Values
from jaxtrapolate.methods.stages import (
    COMPOSITE,
    OCCLUSION,
    SKY,
    composite,
    demodulate_stage,
    holes_stage,
    margin,
    modulate_stage,
    reflecting,
    reproject_stage,
)
from jaxtrapolate.methods.warping import Guide, guided_stage
from jaxtrapolate.networks.explained import explained, standing
from jaxtrapolate.networks.extranet import ExtraNet, ExtraNetConfig, extranet_from_torch
from jaxtrapolate.networks.inference import inference
from jaxtrapolate.networks.stored import load_network
from jaxtrapolate.ops.depth import surface_depth
from jaxtrapolate.ops.holes import Taps
from jaxtrapolate.ops.radiance import By, demodulate, log_decode, log_encode
from jaxtrapolate.ops.warp import backward_warp
from jaxtrapolate.precision import divide, widest
from jaxtrapolate.records import GBuffer
from jaxtrapolate.weights import configured, read_torch

NAME = "extranet"
_FAR = 16.0  # pixels of light's motion, half of all that is told apart


@dataclasses.dataclass(frozen=True)
class Preparation:
    """How a frame is prepared for the network; the defaults are ours, which need no unit of length.

    Attributes:
        first_guess: x's first three channels, which the network corrects: the newest frame by the "warp" along the
            motion, or by the "guided" warp (albedo and normals, else the stencil; without any, the warp), or that with
            its light moved on and its holes filled from older frames ("shading", as of `shading_warp`).
        by, floor: of `demodulate`; with floor 0 what reflects nothing is 0.
        sky: whether the sky's colour is fed undivided; else demodulated like the rest, by the albedo stored there.
        outside: what a warp fetches beyond the frame.
        taps, position_threshold: of `hole_masks`.
        depth: "relative" is m / (m + depth), m the harmonic mean over the frame: 1/2 there, 0 at the sky. "minmax" is
            the release's: depth in centimetres, what is beyond 10 km 0, min and max over the frame to 0 and 1.
        sky_normal: what is fed, in each channel, for the normal of the sky.
        space: in which colours are fetched between pixels.
    """

    first_guess: Literal["warp", "guided", "shading"] = "warp"
    by: By = "albedo+specular"
    floor: float = 1e-2
    sky: bool = True
    outside: Literal["edge", "zero"] = "edge"
    taps: Taps = "nearest"
    position_threshold: tuple[float, float, float] | None = None
    depth: Literal["relative", "minmax"] = "relative"
    sky_normal: float = 0.0
    space: Space = "linear"

    def __post_init__(self):
        for name, choices in _CHOICES.items():
            check_choice(name, getattr(self, name), choices)
        if not 0 <= self.floor < float("inf"):
            raise ValueError(f"floor: expected 0 or more, got {self.floor!r}")


_CHOICES = {
    "first_guess": ("warp", "guided", "shading"),
    "by": get_args(By),
    "outside": ("edge", "zero"),
    "taps": get_args(Taps),
    "depth": ("relative", "minmax"),
    "space": get_args(Space),
}

RELEASE = Preparation(
    by="albedo",
    floor=0.0,
    sky=False,
    outside="zero",
    position_threshold=(7.5, 45.0, 0.005),
    depth="minmax",
    sky_normal=-1.0,
)
"""What the authors' weights were trained on: lengths in centimetres, sky normals (-1, -1, -1), and no floor.

Departure: holes are judged by the nearest pixel, not by four taps with or without weight, which is 0.15 dB better on a
path-traced clip.
"""


def relative_depth(depth: Float[Array, "h w 1"], sky: Float[Array, "h w 1"] | None) -> Float[Array, "h w 1"]:
    """m / (m + depth), m the harmonic mean of what is no sky: in 0..1, without a unit; 0 at the sky.

    Depth that is not positive or not finite counts as sky. The gradient is finite everywhere.
    """
    known = (depth > 0) & jnp.isfinite(depth)
    if sky is not None:
        known &= sky < 0.5
    nearness = divide(1, depth, where=known)
    mean = divide(jnp.sum(nearness), jnp.sum(known.astype(depth.dtype)))
    return divide(nearness, nearness + mean)


def minmax_depth(depth: Float[Array, "h w 1"]) -> Float[Array, "h w 1"]:
    """The release's depth: in units of 100 m, 0 where over 100 of them, then (d - min) / (max - min + 1e-6).

    Depth that is not positive, or NaN, counts as over 100.
    """
    hundreds = surface_depth(depth) * 1e-4
    known = hundreds <= 100
    hundreds = jnp.where(known, hundreds, 0)
    low, high = jnp.min(hundreds), jnp.max(hundreds)
    return (hundreds - low) / (high - low + 1e-6)


def features(buffers: GBuffer | None, like: Float[Array, "h w c"], preparation: Preparation) -> Float[Array, "h w 6"]:
    """What the network is shown of the target `[H, W, 6]`: world normal, depth, roughness, metallic.

    Zeros for what is not there, or not finite; size and dtype are those of `like`.
    """
    buffers = buffers or GBuffer()
    nothing = jnp.zeros((*like.shape[:2], 1), like.dtype)
    # held, so that no number that is not one of a unit vector's overflows in the network
    normal = (
        jnp.repeat(nothing, 3, -1) if buffers.normal is None else jnp.clip(buffers.normal, -1, 1).astype(like.dtype)
    )
    if buffers.sky is not None and buffers.normal is not None:
        normal = jnp.where(buffers.sky > 0.5, preparation.sky_normal, normal)
    depth = nothing
    if buffers.depth is not None:
        given = jnp.asarray(buffers.depth, like.dtype)
        depth = minmax_depth(given) if preparation.depth == "minmax" else relative_depth(given, buffers.sky)
    rest = (nothing if v is None else jnp.asarray(v, like.dtype) for v in (buffers.roughness, buffers.metallic))
    shown = jnp.concatenate([normal, depth, *rest], -1)
    return jnp.where(jnp.isfinite(shown), shown, 0)  # one that is not would reach as far as the network looks


def of_guess(values: Values, like: Float[Array, "h w c"]) -> Float[Array, "h w 4"]:
    """What the network is shown of the first guess `[H, W, 4]`: how its light has moved, the trust in that, its age.

    The motion is flow / (16 + |flow|), the age 0 for the newest frame and 1 for what no frame has seen. Zeros for what
    no stage has given.
    """
    nothing = jnp.zeros((*like.shape[:2], 1), like.dtype)
    given = (values[name] for name in ("light_flow", "trust", "age"))
    flow, trust, age = (nothing if value is None else value.astype(like.dtype) for value in given)
    flow = jnp.broadcast_to(flow, (*like.shape[:2], 2))
    return jnp.concatenate([flow / (_FAR + jnp.abs(flow)), trust, age / 3], -1)


def encode(image: Float[Array, "h w c"]) -> Float[Array, "h w c"]:
    """log(1 + r) in at least float32; what is negative or not finite counts as 0."""
    image = image.astype(widest(image))
    return log_encode(jnp.where(jnp.isfinite(image), image, 0))


def encoded_truth(
    color: Float[Array, "h w 3"], buffers: GBuffer | None, *, preparation: Preparation
) -> Float[Array, "h w 3"]:
    """The answer that the network should give: a frame's true colour, demodulated, in the log domain.

    Args:
        color: `[H, W, 3]`, linear radiance.
        buffers: of the same frame; without albedo nothing is demodulated.
        preparation: of the network that is trained.

    Raises:
        TypeError, ValueError: no floating-point array, or a size that differs.
    """
    if buffers is not None and buffers.albedo is not None:
        color = demodulate(color, reflecting(buffers, preparation.sky), by=preparation.by, floor=preparation.floor)
    return encode(color)


@settings
class Correction(Guide):
    """Of the guided warp that makes the first guess, and of hindsight."""

    margin: float = margin()


@settings
class LitCorrection(Remembered, Continued, Correction):
    """Of `shading_warp`, which makes the first guess."""


_SETTINGS = {"warp": (), "guided": Correction(), "shading": LitCorrection()}
"""By first guess."""


def _inputs_stage(config: ExtraNetConfig, preparation: Preparation) -> Stage:
    def function(state, values: Values):
        warped = [encode(image) for image in values["histories"]]
        first = encode(values["warped"][..., :3])
        valid = [1 - mask.astype(first.dtype) for mask in values["masks"]]
        along = partial(composite, values, outside=preparation.outside)
        guesses = [first, encode(in_space(preparation.space, along, values["layers"][0][..., :3]))]
        sources = [jnp.concatenate(pair, -1) for pair in zip(warped, valid, strict=True)]
        sources = [sources[min(k, len(sources) - 1)] for k in range(config.histories)]
        shown = [features(values["target"].gbuffer, first, preparation)] if config.features else []
        shown += [of_guess(values, first)] if config.guess else []
        inputs = {
            "x": jnp.concatenate(guesses[: config.warps], -1),
            "mask": valid[0],
            "features": jnp.concatenate(shown, -1) if shown else None,
            "history": jnp.stack(sources[::-1]) if sources else None,
        }
        motions, still = values["motions"], jnp.zeros_like(values["holes"])
        if len(motions) > 1:  # with one rendered frame it is not known whether anything changes
            still = standing([source.color for source in values["sources"]], *motions)
        return {"inputs": inputs, "still": still}

    takes = ("target", "layers", "masks", "sources", "motions", "histories", "warped", *COMPOSITE)
    takes += ("light_flow?", "trust?", "age?") if config.guess else ()
    return Stage("inputs", function, takes, ("inputs", "still"))


def extranet(model: ExtraNet, *, preparation: Preparation = Preparation(), name: str = NAME) -> Method:
    """Up to three rendered frames warped, demodulated, holes marked, and shaded by a network (ExtraNet).

    The three newest rendered frames are warped to the target, demodulated, and with masks; where fewer can be had the
    oldest is repeated. The network sees x `[H, W, 6]` (the first guess and the occlusion composite), mask `[H, W, 1]`,
    features `[H, W, 6]` (4 more with the network's `guess`, see `of_guess`) and history `[3, H, W, 4]`, oldest first,
    all in the log domain: these are `values["inputs"]` of the stages before "network". Its answer is decoded and
    modulated. The sky is the engine's where it draws it apart, else that of the newest frame, warped as the first guess
    is. Outside holes the network's correction is held within what its inputs differ by (`explained`), and where nothing
    moves and all rendered frames are equal, tile by tile, the newest is the result (`standing`). Where the guided warp
    makes the first guess, hindsight mixes in that of the undivided colour: of the guess 1 - share is left and of the
    network's correction 1 - share^2. The options are then those of the guided warp, and of hindsight; all else that
    could be set was set when the network was trained.

    What a scene lacks is left out: no albedo, no demodulation; no depth, no occlusion motion, the composite is the
    warp; normal, depth, roughness or metallic that are absent are zeros; masks are those that the buffers allow.

    Args:
        model: its batch norms are used as in evaluation.
        preparation: what the model was trained on.
        name: of the method.

    Raises:
        ValueError: a model with other features than these or none, or with more warped images than these two.

    References:
        Guo et al. 2021 (ExtraNet), sections 4 and 5.2, and the authors' release. Departures: motion is chained with
        interpolation and is not dilated; the sky is not taken from the target's own colour.
    """
    config = model.config
    if config.features not in (0, 6) or config.guess not in (0, 4) or not 1 <= config.warps <= 2:
        raise ValueError(f"model: expected features 6 or 0, guess 4 or 0, and 1 or 2 warped images, got {config}")
    function, weights = inference(model)
    guided = ()
    if preparation.first_guess != "warp":
        guided += (dataclasses.replace(guided_stage(preparation.space), optional=True),)
    if preparation.first_guess == "shading":
        guided += (*light_stages(preparation.space), seen_before_stage(preparation.space))
    remembers = preparation.first_guess == "shading"

    def warp(state, values: Values):
        pairs = zip(values["layers"], values["motions"], strict=True)
        warped = tuple(
            in_space(preparation.space, partial(backward_warp, motion=motion, outside=preparation.outside), image)
            for image, motion in pairs
        )
        return {"histories": tuple(image[..., :3] for image in warped), "warped": warped[0]}

    def network(state, values: Values):
        inputs, share = values["inputs"], values["plain_share"]
        answer = function(state.weights, *(inputs[name] for name in ("x", "mask", "features", "history")))
        first, *others = jnp.split(inputs["x"], config.warps, -1)
        if inputs["history"] is not None:
            others += list(inputs["history"][..., :3])
        divisor = values["divisor"]

        def shown(image):
            return image if divisor is None else encode(log_decode(image) * divisor.astype(image.dtype))

        correction = explained(answer - first, (first, *others), shown=shown, free=inputs["mask"] < 0.5)
        image = log_decode(first + correction)
        guess, own = values["warped"][..., :3], values["warped"][..., 3:]  # undivided, where hindsight asks for it
        if share is not None:  # of the guess 1 - share is left, of its correction 1 - share^2
            known = jnp.all(jnp.isfinite(values["warped"]), -1, keepdims=True)
            share, own = jnp.where(known, share, 0), jnp.where(known, own, 0)
            begun, factor = guess.astype(image.dtype), 1 + share.astype(image.dtype)
            onward = begun + factor * (image - begun)
            image = jnp.where(known, jnp.where(onward > 0, onward, 0), image)
        image = jnp.where(values["still"], values["histories"][0].astype(image.dtype), image)
        return outputs(image, guess, own, share)

    def outputs(image, guess, own, share):
        warped = jnp.concatenate([image, own.astype(image.dtype)], -1)
        return {"warped": warped, "image": image, "guess": guess, "plain_share": share}

    def newest(state, values: Values):
        image = values["histories"][0].astype(widest(values["inputs"]["x"]))
        guess, own = values["warped"][..., :3], values["warped"][..., 3:]
        return outputs(image, guess, own, values["plain_share"])

    def sky(state, values: Values):
        image = values["image"]
        # the guided warp finds like sky where the occluder has moved on; the sky is not divided by anything
        if guided and preparation.sky:
            plain = values["guess"]
        else:
            plain = in_space(preparation.space, partial(composite, values), values["newest"].color)
        return {"image": jnp.where(values["target"].gbuffer.sky > 0.5, plain.astype(image.dtype), image)}

    # asked in linear light, in which a lamp that was divided spoils all around it: there nothing is to be divided
    doubt = dataclasses.replace(preparation, space="linear")
    past = max(1, config.histories)
    stages = (
        *((remember_stage(preparation),) if remembers else ()),
        reproject_stage(past),
        holes_stage(preparation.taps, position_threshold=preparation.position_threshold),
        dataclasses.replace(OCCLUSION, optional=True),
        *((hindsight_stage(doubt),) if guided else ()),
        demodulate_stage(preparation),
        Stage("warp", warp, ("layers", "motions"), ("histories", "warped")),
        *guided,
        _inputs_stage(config, preparation),
        Stage(
            "network",
            network,
            takes=("inputs", "still", "histories", "warped", "plain_share?", "divisor?"),
            gives=("warped", "image", "guess", "plain_share"),
            needed=Needed("not all stands still", lambda state, values: ~jnp.all(values["still"]), newest),
        ),
        modulate_stage(preparation),
        Stage(
            "warped sky",
            sky,
            takes=("image", "guess", "newest", "target", *COMPOSITE),
            gives=("image",),
            reads=("target.sky",),
            optional=True,
        ),
        SKY,
    )
    given, begin = _SETTINGS[preparation.first_guess], start if remembers else None
    return Method(name, stages, past=past, weights=weights, settings=given, networks={"network": function}, start=begin)


def first_guess(method: Method) -> Method:
    """The same method with what its network corrects as the answer: what a network has to be better than."""

    def guess(state, values: Values):
        image = values["warped"][..., :3]
        kept = {name: values[name] for name in ("warped", "plain_share")}
        return {"image": image, "guess": image, **kept}

    stages = {stage.name: stage for stage in method.stages}
    stages["network"] = dataclasses.replace(stages["network"], function=guess, needed=None)
    return dataclasses.replace(method, stages=tuple(stages.values()))


def read_network(path: str | PathLike[str], name: str) -> tuple[ExtraNet, Preparation]:
    """A network and its preparation, from a file of this library or an Orbax checkpoint.

    Args:
        path: see `jaxtrapolate.weights.read_weights`.
        name: of the method whose weights these have to be.

    Raises:
        OSError: the file cannot be read.
        ValueError: one line that names the file: damaged, of another method, or with weights that do not fit.
    """

    def build(stated: Mapping[str, Any]):
        config = configured(ExtraNetConfig, stated.get("network", {}), source=str(path))
        return lambda: ExtraNet(config, rngs=nnx.Rngs(0))

    model, stated = load_network(path, name, build)
    return model, configured(Preparation, stated.get("preparation", {}), source=str(path))


def load_extranet(path: str | PathLike[str]) -> tuple[ExtraNet, Preparation]:
    """The same of the method "extranet", from the authors' `.pth.tar` too.

    Args:
        path: what ends in `.npz` and folders are read by `read_network`, all else by `read_torch`.

    Raises:
        OSError: the file cannot be read.
        ValueError: one line that names the file: damaged, of another method, or with weights that do not fit.
    """
    path = Path(path)
    if path.suffix != ".npz" and not path.is_dir():
        checkpoint = read_torch(path)
        arrays = checkpoint.get("state_dict", checkpoint)
        try:
            if not isinstance(arrays, dict) or not all(isinstance(name, str) for name in arrays):
                raise ValueError("its state_dict is no table of arrays by name")
            if wrong := [name for name, array in arrays.items() if not isinstance(array, np.ndarray)]:
                raise ValueError(f"{wrong[0]} is no array")
            return extranet_from_torch(arrays), RELEASE
        except ValueError as error:
            raise ValueError(f"{printable(path)}: no weights of ExtraNet: {error}") from error
    return read_network(path, NAME)


def extranet_config(config: ExtraNetConfig, preparation: Preparation) -> dict[str, Any]:
    """What a file of weights states about them, as `read_network` reads it."""
    return {"network": dataclasses.asdict(config), "preparation": dataclasses.asdict(preparation)}


def load(path: str | PathLike[str]) -> Method:
    """The method with the weights in a file; see `load_extranet`."""
    model, preparation = load_extranet(path)
    return extranet(model, preparation=preparation)
