"""ExtraSSNet (Wu et al. 2023): rendered and extrapolated frames super sampled by one decoder with an encoder for each.

The paper leaves the layers to a supplement that is not public. This is a U-Net at the input's size, whose last layer
has a channel for each part of a pixel. Ours: the history enters as such channels too, so that nothing of it is lost;
the answer is a residual to the upsampled input; both encoders are told the jitter.
"""

import dataclasses
from itertools import pairwise
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_array, check_choice
from jaxtrapolate.networks.blocks import HE, Layer, pad_to_multiple, pixel_shuffle, pixel_unshuffle, upsample_2x
from jaxtrapolate.networks.frnet import FRNet, FRNetConfig
from jaxtrapolate.networks.interpolator import prelu_layer
from jaxtrapolate.ops.upsample import upsample

Skips = Literal["concatenate", "add"]


@dataclasses.dataclass(frozen=True)
class ExtraSSNetConfig:
    """The size of an `ExtraSSNet`; the default has 2,083,492 parameters.

    From 960 x 540 to 1920 x 1080 it takes 61.1 GFLOP for a rendered frame and 62.4 for another. At the rate at which
    the paper's ExtraNet is quoted (61.9 GFLOP in 3.3 ms there, RTX 3090) that is 3.3 ms; the paper has 2.5.

    Attributes:
        widths: channels of each of the encoders' levels, the first at the size of the input; the paper has four.
        bottleneck: channels below the coarsest level, of the shared decoder.
        scale: output size over input size, a whole number; the paper's is 2.
        skips: how the decoder takes the encoders' features: "add" or "concatenate" (73.2 and 74.6 GFLOP);
            the paper leaves it open.
    """

    widths: tuple[int, ...] = (22, 32, 64, 128)
    bottleneck: int = 256
    scale: int = 2
    skips: Skips = "add"

    def __post_init__(self) -> None:
        check_choice("skips", self.skips, get_args(Skips))
        if self.scale < 1:
            raise ValueError(f"scale: expected a whole number from 1 on, got {self.scale}")

    @property
    def multiple(self) -> int:
        """What height and width are padded to a multiple of: 2 to the number of levels."""
        return 2 ** len(self.widths)


class SuperSampled(NamedTuple):
    """What an `ExtraSSNet` says of a frame.

    Attributes:
        image: `[B, scale H, scale W, 3]`.
        features: the encoder's, of each level, the finest first.
    """

    image: Array
    features: tuple[Array, ...]


class ExtraSSNet(nnx.Module):
    """The network: `model(color, history, depth, jitter)` of a rendered frame, with `guided` and `albedo` of another.

    Args:
        config: its size.
        rngs: `nnx.Rngs(params=...)`; at first it answers about the upsampled input.

    References:
        Wu et al. 2023 (ExtraSS), section 4.4, eq. 10. What is ours says the module.
    """

    def __init__(self, config: ExtraSSNetConfig = ExtraSSNetConfig(), *, rngs: nnx.Rngs):
        self.config = config
        history = 3 * config.scale**2
        # colour, history, depth and jitter; of an extrapolated frame also the guided warp and base colour
        self.rendered = self._encoder(3 + history + 1 + 2, rngs)
        self.generated = self._encoder(3 + history + 1 + 2 + 3 + 3, rngs)
        deepest = config.widths[-1]
        self.bottom = nnx.Sequential(
            prelu_layer(deepest, config.bottleneck, stride=2, rngs=rngs),
            prelu_layer(config.bottleneck, config.bottleneck, rngs=rngs),
        )
        self.decoder, below = nnx.List([]), config.bottleneck
        for skip in config.widths[::-1]:
            if config.skips == "add":
                pair = [prelu_layer(below, skip, rngs=rngs), prelu_layer(skip, skip, rngs=rngs)]
            else:
                pair = [prelu_layer(below + skip, skip, rngs=rngs), prelu_layer(skip, skip, rngs=rngs)]
            self.decoder.append(nnx.List(pair))
            below = skip
        self.output = Layer(below, history, norm=False, activation="none", gain=0.05 * HE, rngs=rngs)

    def _encoder(self, inputs: int, rngs: nnx.Rngs) -> Any:
        levels = []
        for k, (before, after) in enumerate(pairwise((inputs, *self.config.widths))):
            first = prelu_layer(before, after, stride=2 if k else 1, rngs=rngs)
            levels.append(nnx.Sequential(first, prelu_layer(after, after, rngs=rngs)))
        return nnx.List(levels)

    def __call__(
        self,
        color: Float[Array, "b h w 3"],
        history: Float[Array, "b i j 3"],
        depth: Float[Array, "b h w 1"],
        jitter: Float[Array, "b 2"],
        guided: Float[Array, "b h w 3"] | None = None,
        albedo: Float[Array, "b h w 3"] | None = None,
    ) -> SuperSampled:
        """The frame at the larger size, unjittered.

        Args:
            color: `[B, H, W, 3]`, the rendered frame, or what FRNet has made of the extrapolated one, in the domain
                that the weights were trained in. Any size from 1 x 1 on: inside it is padded, see `pad_to_multiple`.
            history: `[B, scale H, scale W, 3]`, the answer to the frame before, warped, in the same domain.
            depth: `[B, H, W, 1]`, in 0..1.
            jitter: `[B, 2]`, x and y of the colour's samples in pixels.
            guided: `[B, H, W, 3]`, of an extrapolated frame: the guided warp. It chooses the encoder.
            albedo: `[B, H, W, 3]`, likewise its base colour; absent, it counts as 1.

        Returns:
            `SuperSampled`; the image in the dtype of the colour.

        Edge cases:
            A pixel that is not finite spreads to all that its receptive field reaches.

        Raises:
            TypeError, ValueError: no floating-point array, or a shape that does not fit.
        """
        scale = self.config.scale
        batch, height, width, _ = check_array("color", color, shape=("B", "H", "W", 3))
        check_array("history", history, shape=(batch, scale * height, scale * width, 3))
        check_array("depth", depth, shape=(batch, height, width, 1))
        check_array("jitter", jitter, shape=(batch, 2))
        told = jnp.broadcast_to(jitter[:, None, None], (batch, height, width, 2))
        inputs = [color, pixel_unshuffle(history, scale), depth, told]
        if guided is not None:
            check_array("guided", guided, shape=(batch, height, width, 3))
            if albedo is not None:
                check_array("albedo", albedo, shape=(batch, height, width, 3))
            inputs += [guided, jnp.ones_like(color) if albedo is None else albedo]
        value = jnp.concatenate([a.astype(color.dtype) for a in inputs], -1)
        value, features = pad_to_multiple(value, self.config.multiple), []
        for level in self.rendered if guided is None else self.generated:
            value = level(value)
            features.append(value)
        value = self.bottom(value)
        for skip, (first, second) in zip(features[::-1], self.decoder, strict=True):
            value = upsample_2x(value, aligned=False)
            add = self.config.skips == "add"
            value = first(value) + skip if add else first(jnp.concatenate([value, skip], -1))
            value = second(value)
        residual = pixel_shuffle(self.output(value)[:, :height, :width], scale)
        larger = jax.vmap(lambda image, shift: upsample(image, scale=scale, jitter=shift))(color, jitter)
        return SuperSampled(larger + residual.astype(color.dtype), tuple(features))


@dataclasses.dataclass(frozen=True)
class ExtraSSConfig:
    """Of both networks of the method "extrass".

    Attributes:
        frnet: of `FRNet`.
        sampler: of `ExtraSSNet`.
    """

    frnet: FRNetConfig = dataclasses.field(default_factory=FRNetConfig)
    sampler: ExtraSSNetConfig = dataclasses.field(default_factory=ExtraSSNetConfig)


class ExtraSS(nnx.Module):
    """Both networks of the method "extrass", whose weights are one file: `frnet` and `sampler`.

    Args:
        config: their sizes.
        rngs: `nnx.Rngs(params=...)`.
    """

    def __init__(self, config: ExtraSSConfig = ExtraSSConfig(), *, rngs: nnx.Rngs):
        self.config = config
        self.frnet = FRNet(config.frnet, rngs=rngs)
        self.sampler = ExtraSSNet(config.sampler, rngs=rngs)
