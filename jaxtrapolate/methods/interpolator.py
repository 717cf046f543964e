"""A learned interpolator as a method: the rendered frames around the target and nothing else, as of a video."""

import dataclasses
from collections.abc import Mapping
from os import PathLike
from typing import Any

import jax.numpy as jnp
from flax import nnx

from jaxtrapolate.methods.between import PAIR
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.networks.explained import standing
from jaxtrapolate.networks.inference import inference
from jaxtrapolate.networks.interpolator import Interpolator, InterpolatorConfig
from jaxtrapolate.networks.stored import load_network
from jaxtrapolate.ops.radiance import compress, expand
from jaxtrapolate.weights import configured

_NAME = "interpolator"


def interpolator(model: Interpolator) -> Method:
    """The rendered frames around the target, interpolated by a network that sees nothing else (of the kind of IFRNet).

    The baseline "learned video interpolation".

    The network sees the frames before and after through `compress`, as values of a display, and the target's time
    between them: `values["inputs"]` is `(first, second, time)`. Pixels that are not finite count as black or white.
    Where the two are equal, tile by tile, they are the result (`standing`).

    References: of the kind of Kong et al. 2022 (IFRNet), see `jaxtrapolate.networks.interpolator` for what differs.
    """
    function, weights = inference(model)

    def inputs(state, values: Values):
        first, second = (compress(values[name].color) for name in ("previous", "next"))
        return {"inputs": (first, second, values["alpha"].astype(first.dtype))}

    def network(state, values: Values):
        image = expand(function(state.weights, *values["inputs"]))
        first, second = (values[name].color for name in ("previous", "next"))
        return {"image": jnp.where(standing((first, second)), first.astype(image.dtype), image)}

    stages = (
        PAIR,
        Stage("inputs", inputs, ("previous", "next", "alpha"), ("inputs",)),
        Stage("network", network, ("inputs", "previous", "next"), ("image",)),
    )
    return Method(_NAME, stages, kind="interpolation", future=1, weights=weights, networks={"network": function})


def interpolator_config(config: InterpolatorConfig) -> dict[str, Any]:
    """What a file of weights states about them, as `load` reads it."""
    return {"network": dataclasses.asdict(config)}


def load(path: str | PathLike[str]) -> Method:
    """The method with the weights in a file; see `load_network`."""

    def build(stated: Mapping[str, Any]):
        config = configured(InterpolatorConfig, stated.get("network", {}), source=str(path))
        return lambda: Interpolator(config, rngs=nnx.Rngs(0))

    return interpolator(load_network(path, _NAME, build)[0])
