"""A small learned interpolator of the IFRNet kind: two frames to one between them, by flow found coarse to fine.

From IFRNet (Kong et al. 2022): one pyramid of features for both frames; decoders from the coarsest level up, which warp
the level's features by the flow so far and refine it together with a feature of the frame between; a blend mask and a
residual at the end; the mean subtracted from the input. Ours: decoders of four layers at the pyramid's widths, pixel
shuffles in place of transposed convolutions, and time built in: a flow is a velocity times the time to be bridged, the
mask tilts a linear blend, and the residual fades, so that at times 0 and 1 the result is the frame itself. The
residual is held within what the two warped frames differ by (`explained`).
"""

import dataclasses
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_array
from jaxtrapolate.networks.blocks import HE, Layer, pad_to_multiple, pixel_shuffle, upsample_2x, warp
from jaxtrapolate.networks.explained import explained
from jaxtrapolate.precision import widest


@dataclasses.dataclass(frozen=True)
class InterpolatorConfig:
    """The size of an `Interpolator`; the default has 671,848 parameters, and 44 GFLOP at 1280 x 720.

    Attributes:
        widths: channels of each level of the pyramid, the first at half the resolution.
    """

    widths: tuple[int, ...] = (24, 32, 48, 64)

    @property
    def multiple(self) -> int:
        """What height and width are padded to a multiple of: 2 to the number of levels."""
        return 2 ** len(self.widths)


prelu_layer = partial(Layer, norm=False, activation="prelu", gain=HE)
"""What these networks are built of."""


class Decoder(nnx.Module):
    """What one level predicts for the next finer one: `[B, 2h, 2w, outputs]`."""

    def __init__(self, inputs: int, width: int, outputs: int, *, rngs: nnx.Rngs):
        self.join = prelu_layer(inputs, width, rngs=rngs)
        self.refine = nnx.Sequential(prelu_layer(width, width, rngs=rngs), prelu_layer(width, width, rngs=rngs))
        # small at first, so that training sets out from about the linear blend
        self.head = Layer(width, 4 * outputs, norm=False, activation="none", gain=0.05, rngs=rngs)

    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b i j d"]:
        hidden = self.join(x)
        return pixel_shuffle(self.head(hidden + self.refine(hidden)))


class Interpolator(nnx.Module):
    """The network: `model(first, second, time)` is the frame at that time between the two.

    Args:
        config: its size.
        rngs: `nnx.Rngs(params=...)`.

    References:
        Kong et al. 2022 (IFRNet); blend weights by time as in Jiang et al. 2018 (Super SloMo), eq. 1 and 2. What is
        ours says the module.
    """

    def __init__(self, config: InterpolatorConfig = InterpolatorConfig(), *, rngs: nnx.Rngs):
        widths = config.widths
        self.config = config
        self.encoder = nnx.List([])
        for before, after in pairwise((3, *widths)):
            down = prelu_layer(before, after, stride=2, rngs=rngs)
            self.encoder.append(nnx.Sequential(down, prelu_layer(after, after, rngs=rngs)))
        self.decoders = nnx.List([])
        for width, finer in pairwise((*widths[::-1], 4)):  # at last a mask and a residual
            inputs = 3 * width + 4 if self.decoders else 2 * width + 1
            self.decoders.append(Decoder(inputs, width, 4 + finer, rngs=rngs))

    def __call__(
        self, first: Float[Array, "b h w 3"], second: Float[Array, "b h w 3"], time: Float[Array, " b"]
    ) -> Float[Array, "b h w 3"]:
        """The frame between.

        Args:
            first: `[B, H, W, 3]`, in the domain that the weights were trained in:
                `log_encode` of radiance, or display values. Any size from 1 x 1 on: inside it is padded, see
                `pad_to_multiple`.
            second: the frame one unit of time later, likewise.
            time: `[B]` in 0..1, 0 at the first.

        Returns:
            `[B, H, W, 3]` in the dtype of the frames, not clipped; at times 0 and 1 the frame itself, bit for bit.
            Features are computed in the dtype of the parameters, flows, blending and residual in at least float32.

        Edge cases:
            A pixel that is not finite spreads over the frame, as the mean is taken of all.

        Gradient:
            With respect to the frames, the time and the parameters; with respect to flows that of `backward_warp`.

        Raises:
            TypeError, ValueError: no floating-point array, or a shape that does not fit.
        """
        batch, height, width, _ = check_array("first", first, shape=("B", "H", "W", 3))
        check_array("second", second, shape=(batch, height, width, 3))
        check_array("time", time, shape=(batch,))
        wide = widest(first)
        later = time.astype(wide)[:, None, None, None]
        earlier = 1 - later
        frames = jnp.concatenate([first, second]).astype(wide)
        frames = pad_to_multiple(frames, self.config.multiple)
        mean = (jnp.mean(first.astype(wide), (1, 2, 3)) + jnp.mean(second.astype(wide), (1, 2, 3))) / 2
        value, pyramid = frames - jnp.concatenate([mean, mean])[:, None, None, None], []
        for level in self.encoder:
            value = level(value)
            pyramid.append(value)

        def split(pair):
            return pair[:batch], pair[batch:]

        def fetch(pair, flow):
            a, b = split(pair)
            return warp(a, later * flow[..., :2]), warp(b, earlier * flow[..., 2:])

        def join(*parts):
            return jnp.concatenate([part.astype(value.dtype) for part in parts], -1)

        coarsest, *finer = self.decoders
        a, b = split(pyramid.pop())
        code = coarsest(join(a, b, jnp.broadcast_to(later, (*a.shape[:3], 1))))
        flow = code[..., :4].astype(wide)
        for decoder in finer:
            code = decoder(join(code[..., 4:], *fetch(pyramid.pop(), flow), flow))
            flow = 2 * upsample_2x(flow, aligned=False) + code[..., :4].astype(wide)
        a, b = fetch(frames, flow)
        code = code.astype(wide)
        mask, residual = jax.nn.sigmoid(jnp.clip(code[..., 4:5], -10, 10)), code[..., 5:]
        far = later * (1 - mask) / (earlier * mask + later * (1 - mask))
        held = jax.vmap(lambda residual, *warped: explained(residual, warped))(residual, a, b)
        image = a * (1 - far) + b * far + 4 * earlier * later * held
        return image[:, :height, :width].astype(first.dtype)
