"""FRNet, the flow-based refinement network of ExtraSS (Wu et al. 2023): shading that moves, followed at half size.

The paper leaves the layers to a supplement that is not public; these are of the kind of IFRNet (Kong et al. 2022): one
pyramid of features for both warped frames, and decoders from the coarsest level up, which warp the level's features by
the flow so far and refine it together with a feature of the frame that is sought. Ours: the decoders of
`jaxtrapolate.networks.interpolator`, and older light, which has moved further, fetched along a multiple of the flow.
"""

import dataclasses
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_array, check_present
from jaxtrapolate.networks.blocks import pad_to_multiple, upsample_2x, warp
from jaxtrapolate.networks.interpolator import Decoder, prelu_layer
from jaxtrapolate.precision import widest


@dataclasses.dataclass(frozen=True)
class FRNetConfig:
    """The size of an `FRNet`; the default has 811,808 parameters, and 6.7 GFLOP at 480 x 270.

    At the rate at which the paper's ExtraNet is quoted (61.9 GFLOP in 3.3 ms at 960 x 540, RTX 3090) that is 0.36 ms;
    the paper has 1.2 ms for the refinement, two halved guided warps and the blend among it.

    Attributes:
        widths: channels of each level of the pyramid, the first at half the size of the input; the paper has four
            levels. The default are those of IFRNet's small model.
        merge: whether the older frame is warped by a flow of its own, and both are merged by a mask, as a
            re-implementation of 2026 has it; else the newer one alone is warped, as in the paper.
        roughness: whether the target's roughness is an input.
        age: how many times as far as in the newer frame light has moved in the older one: 3 where frames are rendered
            every other time. Not used with `merge`.
        led: whether it is handed a flow to begin with, and the trust in it; the paper's is not.
    """

    widths: tuple[int, ...] = (24, 36, 54, 72)
    merge: bool = False
    roughness: bool = True
    age: float = 3.0
    led: bool = False

    @property
    def multiple(self) -> int:
        """What height and width are padded to a multiple of: 2 to the number of levels."""
        return 2 ** len(self.widths)


class Refined(NamedTuple):
    """What an `FRNet` says of a frame.

    Attributes:
        image: `[B, H, W, 3]`, the newer frame (or both, merged) with its light where it is now.
        flow: `[B, H, W, 2]` in pixels, to where that light is in the newer frame; with `merge` `[B, H, W, 4]`.
        features: predicted for each level of the pyramid but the coarsest, the finest first.
        mean: `[B]`, what was subtracted from the images.
    """

    image: Array
    flow: Array
    features: tuple[Array, ...]
    mean: Array


class FRNet(nnx.Module):
    """The network: `model(newer, older, roughness)` moves the newer frame's light to where it is in the target.

    Args:
        config: its size, and what is left out of it.
        rngs: `nnx.Rngs(params=...)`; at first it moves next to nothing, or by the flow that it is handed.

    References:
        Wu et al. 2023 (ExtraSS), section 4.3, eq. 4. What is ours says the module.
    """

    def __init__(self, config: FRNetConfig = FRNetConfig(), *, rngs: nnx.Rngs):
        self.config = config
        flows = 4 if config.merge else 2
        self.encoder = nnx.List([])
        for before, after in pairwise((3 + config.roughness, *config.widths)):
            down = prelu_layer(before, after, stride=2, rngs=rngs)
            self.encoder.append(nnx.Sequential(down, prelu_layer(after, after, rngs=rngs)))
        self.decoders = nnx.List([])
        for width, finer in pairwise((*config.widths[::-1], int(config.merge))):  # at last a mask, or nothing
            inputs = 3 * width + flows if self.decoders else 2 * width + 3 * config.led
            self.decoders.append(Decoder(inputs, width, flows + finer, rngs=rngs))

    def features(
        self, image: Float[Array, "b h w 3"], roughness: Float[Array, "b h w 1"] | None, mean: Float[Array, " b"]
    ) -> tuple[Array, ...]:
        """The pyramid of an image, the finest level first, `[B, h, w, C]`: of the truth, to compare with.

        Args:
            image: `[B, H, W, 3]`.
            roughness: `[B, H, W, 1]`, of the target; `None` where the configuration has none.
            mean: `[B]`, which is subtracted from the image.

        Raises:
            TypeError, ValueError: no floating-point array, a shape that does not fit, or roughness that is absent.
        """
        size = check_array("image", image, shape=("B", "H", "W", 3))[:3]
        inputs = [image - mean[:, None, None, None].astype(image.dtype)]
        if self.config.roughness:
            roughness = check_present("roughness", roughness, needed_by="this network")
            check_array("roughness", roughness, shape=(*size, 1))
            inputs.append(roughness.astype(image.dtype))
        value, pyramid = pad_to_multiple(jnp.concatenate(inputs, -1), self.config.multiple), []
        for level in self.encoder:
            value = level(value)
            pyramid.append(value)
        return tuple(pyramid)

    def _leads(self, lead: Array | None, size: tuple[int, int, int]) -> list[Array]:
        """The flow that is trusted and the trust in it, at each level, the finest first; none without."""
        if not self.config.led:
            if lead is not None:
                raise ValueError("lead: expected None, as this network's configuration is not led")
            return []
        lead = check_present("lead", lead, needed_by="this network")
        check_array("lead", lead, shape=(*size, 3))
        whole = pad_to_multiple(
            jnp.concatenate([lead[..., :2] * lead[..., 2:], lead[..., 2:]], -1), self.config.multiple
        )
        levels = [whole]
        for _ in self.config.widths:
            batch, height, width, _ = levels[-1].shape
            smaller = jnp.mean(levels[-1].reshape(batch, height // 2, 2, width // 2, 2, 3), (2, 4))
            levels.append(jnp.concatenate([smaller[..., :2] / 2, smaller[..., 2:]], -1))
        return levels

    def __call__(
        self,
        newer: Float[Array, "b h w 3"],
        older: Float[Array, "b h w 3"],
        roughness: Float[Array, "b h w 1"] | None = None,
        lead: Float[Array, "b h w 3"] | None = None,
    ) -> Refined:
        """The refined frame.

        Args:
            newer: `[B, H, W, 3]`, the newest rendered frame, warped to the target by its geometry, in the domain that
                the weights were trained in. Any size from 1 x 1 on: inside it is padded, see `pad_to_multiple`.
            older: the rendered frame before that, likewise.
            roughness: `[B, H, W, 1]`, of the target; `None` where the configuration has none.
            lead: `[B, H, W, 3]`, a flow to begin with, in pixels to where the light is in the newer frame, and the
                trust in it, 0..1: the network adds to their product. `None` where the configuration has none.

        Returns:
            `Refined`; the image in the dtype of the frames. Features are computed in the dtype of the parameters, the
            flow and what is fetched by it in at least float32.

        Edge cases:
            A pixel that is not finite spreads over the frame, as the mean is taken of all. Light from beyond the frame
            is that of its edge.

        Raises:
            TypeError, ValueError: as `features`, frames whose shapes differ, or a `lead` for a network that is not led.
        """
        batch, height, width, _ = check_array("newer", newer, shape=("B", "H", "W", 3))
        check_array("older", older, shape=(batch, height, width, 3))
        merge, wide = self.config.merge, widest(newer, older)
        first, second = (pad_to_multiple(a.astype(wide), self.config.multiple) for a in (newer, older))
        mean = (jnp.mean(newer.astype(wide), (1, 2, 3)) + jnp.mean(older.astype(wide), (1, 2, 3))) / 2
        both = jnp.concatenate([newer, older]).astype(wide)
        rough = None if roughness is None else jnp.concatenate([roughness, roughness])
        pyramid = [
            (level[:batch], level[batch:]) for level in self.features(both, rough, jnp.concatenate([mean, mean]))
        ]

        def fetch(pair, flow):
            if merge:
                return warp(pair[0], flow[..., :2]), warp(pair[1], flow[..., 2:])
            return warp(pair[0], flow), warp(pair[1], jnp.asarray(self.config.age, flow.dtype) * flow)

        leads = self._leads(lead, (batch, height, width))

        def join(*parts):
            return jnp.concatenate([part.astype(parts[0].dtype) for part in parts], -1)

        count, predicted = 4 if merge else 2, []
        coarsest, *finer = self.decoders
        code = coarsest(join(*pyramid.pop(), *(leads[len(finer) + 1 :] if leads else ())))
        own = code[..., :count].astype(wide)

        def whole(own, level):
            return own if not leads else own + _of_both(leads[level], self.config).astype(wide)

        for level in range(len(finer), 0, -1):
            predicted.append(code[..., count:])
            flow = whole(own, level)
            code = finer[-level](join(code[..., count:], *fetch(pyramid.pop(), flow), flow))
            own = 2 * upsample_2x(own, aligned=False) + code[..., :count].astype(wide)
        flow = whole(own, 0)
        if merge:
            a, b = fetch((first, second), flow)
            share = jax.nn.sigmoid(code[..., 4:].astype(wide))
            image = a * share + b * (1 - share)
        else:
            image = warp(first, flow)
        image, flow = (a[:, :height, :width] for a in (image, flow))
        return Refined(image.astype(newer.dtype), flow, tuple(predicted[::-1]), mean)


def _of_both(lead: Array, config: FRNetConfig) -> Array:
    """The flow that leads, for each frame that is warped."""
    flow = lead[..., :2]
    return jnp.concatenate([flow, config.age * flow], -1) if config.merge else flow
