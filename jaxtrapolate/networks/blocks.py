"""The building blocks of the networks: a layer (convolution, gate, batch norm, activation), doubling, padding.

Convention:
    `[B, H, W, C]`, channels last, with a leading batch axis (Flax NNX; a function of one frame without it is
    `jaxtrapolate.networks.inference`). A layer computes in the dtype of its kernel.
"""

import math
import operator
from typing import Literal, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_choice
from jaxtrapolate.ops.warp import landing, sample
from jaxtrapolate.precision import widest

Gate = Literal["none", "light", "full"]
Activation = Literal["none", "relu", "prelu"]

HE = math.sqrt(6)
"""The gain of He et al. 2015, uniform."""

LINEAR = math.sqrt(3)
"""The same without an activation."""


def _uniform(bound):
    """An initialiser: uniform within the bound."""

    def initialise(key, shape, dtype=jnp.float32, out_sharding=None):
        count = math.prod(shape)
        drawn = 8 ** math.ceil(math.log2(count) / 3)  # few sizes, as each is compiled anew
        values = jax.random.uniform(key, (drawn,), dtype, -bound, bound)
        return values[:count].reshape(shape)

    return initialise


def convolution(
    inputs: int, outputs: int, *, size: int = 3, stride: int = 1, gain: float | None = None, rngs: nnx.Rngs
) -> nnx.Conv:
    """A convolution with bias, `size // 2` zeros around the frame, by default initialised as PyTorch does.

    That is uniform within 1 / sqrt(inputs * size^2), kernel and bias; with a `gain` the kernel within that times the
    gain, and the bias 0. A frame of H x W becomes ceil(H / stride) x ceil(W / stride); output p is centred on input
    stride * p.
    """
    bound = 1 / math.sqrt(inputs * size * size)
    return nnx.Conv(
        inputs,
        outputs,
        (size, size),
        (stride, stride),
        padding=size // 2,
        kernel_init=_uniform(bound if gain is None else gain * bound),
        bias_init=_uniform(bound) if gain is None else nnx.initializers.zeros_init(),
        rngs=rngs,
    )


def _convolved(x: Array, *convolutions: nnx.Conv) -> list[Array]:
    """What convolutions of the same size and stride make of x, by one of them all, with zeros up to a multiple of 8.

    XLA's convolution on CPUs fills its registers only so: 24 + 1 outputs cost what 24 do, where two convolutions cost
    up to twice as much, and 25 outputs more than these.
    """
    outputs = [c.out_features for c in convolutions]
    kernel, bias = (
        jnp.pad(jnp.concatenate(parts, -1), ((0, 0),) * (parts[0].ndim - 1) + ((0, -sum(outputs) % 8),))
        for parts in ([c.kernel[...] for c in convolutions], [cast(nnx.Param, c.bias)[...] for c in convolutions])
    )
    around = kernel.shape[0] // 2
    strides, layout = cast(tuple[int, int], convolutions[0].strides), ("NHWC", "HWIO", "NHWC")
    wide = widest(x)  # of the sums: half precision is rounded once, after the bias
    y = jax.lax.conv_general_dilated(
        x, kernel, strides, [(around, around)] * 2, dimension_numbers=layout, preferred_element_type=wide
    )
    y = (y + bias.astype(wide)[None, None, None]).astype(x.dtype)
    ends = np.cumsum(outputs)
    return [y[..., end - count : end] for end, count in zip(ends, outputs, strict=True)]


class Layer(nnx.Module):
    """A convolution, then a gate, batch norm and an activation, each where it is asked for.

    Args:
        inputs: channels of its input.
        outputs: channels of its output.
        size: of the convolution's kernel, in both directions.
        stride: of the convolution.
        gate: "none"; "light": the result times sigmoid(a second convolution with one output channel), the same for all
            channels; "full": a gate for each channel.
        norm: batch norm with PyTorch's defaults (epsilon 1e-5, a tenth of the new statistics a step); `model.train()`
            normalises by the batch and moves the running statistics, `model.eval()` uses them. The running variance is
            the batch's own, where PyTorch corrects it by n / (n - 1).
        activation: "none", "relu" (gradient 0 at the kink), or "prelu" with a slope of each channel, 0.25 at first.
        gain: of the feature convolution's first kernel, see `convolution`. With PyTorch's initialisation signals fade
            from layer to layer unless there is a batch norm; `HE` keeps their size through a ReLU.
        rngs: where the first weights come from.

    Raises:
        ValueError: an unknown `gate` or `activation`.

    References:
        Guo et al. 2021, eq. 1-3, after Yu et al. 2019 (full gates) and Yi et al. 2020 (light ones).
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        size: int = 3,
        stride: int = 1,
        gate: Gate = "none",
        norm: bool = True,
        activation: Activation = "relu",
        gain: float | None = None,
        rngs: nnx.Rngs,
    ):
        check_choice("gate", gate, get_args(Gate))
        check_choice("activation", activation, get_args(Activation))
        self.feature = convolution(inputs, outputs, size=size, stride=stride, gain=gain, rngs=rngs)
        gates = {"none": 0, "light": 1, "full": outputs}[gate]
        self.gate: nnx.Conv | None = nnx.data(None)
        self.norm: nnx.BatchNorm | None = nnx.data(None)
        self.offset: nnx.Param | None = nnx.data(None)  # what is left of a batch norm behind a gate, see `fold`
        self.slope: nnx.Param | None = nnx.data(None)
        self.activation = activation
        if gates:
            self.gate = convolution(inputs, gates, size=size, stride=stride, rngs=rngs)
        if norm:
            self.norm = nnx.BatchNorm(outputs, momentum=0.9, epsilon=1e-5, use_fast_variance=False, rngs=rngs)
        if activation == "prelu":
            self.slope = nnx.Param(jnp.full((outputs,), 0.25, jnp.float32))

    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b i j d"]:
        x = x.astype(self.feature.kernel.dtype)
        y, *gate = _convolved(x, self.feature, *(() if self.gate is None else (self.gate,)))
        if gate:
            y = y * jax.nn.sigmoid(gate[0])
        if self.norm is not None:
            y = self.norm(y)
        if self.offset is not None:
            y = y + self.offset[None, None, None]
        if self.slope is not None:
            return jnp.where(y > 0, y, y * self.slope[None, None, None].astype(y.dtype))
        return jax.nn.relu(y) if self.activation == "relu" else y

    def fold(self) -> None:
        """Replace the batch norm, in place, by what it does with its running statistics.

        Its factor goes into the feature convolution, its offset into that one's bias, or behind the gate.
        """
        norm = self.norm
        if norm is None:
            return
        assert norm.scale is not None
        assert norm.bias is not None
        assert self.feature.bias is not None
        factor = norm.scale[...] / jnp.sqrt(norm.var[...] + norm.epsilon)
        offset = norm.bias[...] - norm.mean[...] * factor
        self.feature.kernel[...] = self.feature.kernel[...] * factor[None, None, None]
        self.feature.bias[...] = self.feature.bias[...] * factor
        if self.gate is None:
            self.feature.bias[...] = self.feature.bias[...] + offset
        else:
            self.offset = nnx.Param(offset)
        self.norm = nnx.data(None)


def _upsample_axis_2x(x, axis, aligned):
    n = x.shape[axis]
    place = np.arange(2 * n) * ((n - 1) / (2 * n - 1)) if aligned else np.minimum(np.arange(2 * n) / 2, n - 1)
    lower = np.minimum(np.floor(place).astype(np.int32), max(n - 2, 0))
    upper = np.minimum(lower + 1, n - 1)
    shape = [1] * x.ndim
    shape[axis] = 2 * n
    share = np.reshape(place - lower, shape)
    before, behind = (x.at[(slice(None),) * axis + (i,)].get(mode="promise_in_bounds") for i in (lower, upper))
    return before * jnp.asarray(1 - share, x.dtype) + behind * jnp.asarray(share, x.dtype)


def upsample_2x(x: Float[Array, "b h w c"], *, aligned: bool = True) -> Float[Array, "b i j c"]:
    """Twice the height and width, bilinear.

    With aligned corners output k is the input at k (n - 1) / (2n - 1). Without, it is the input at k / 2, the last
    repeated: pixels stay where a convolution of stride 2 has put them, and a flow is doubled by 2. Positions and
    weights are fixed when tracing; rows are gathered, then columns.
    """
    return _upsample_axis_2x(_upsample_axis_2x(x, 1, aligned), 2, aligned)


def pixel_shuffle(x: Float[Array, "b h w c"], factor: int = 2) -> Float[Array, "b i j d"]:
    """`factor` times the height and width, of so many channels less: each pixel's parts become pixels, row by row."""
    batch, height, width, channels = x.shape
    left = channels // factor**2
    x = x.reshape(batch, height, width, factor, factor, left)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(batch, factor * height, factor * width, left)


def pixel_unshuffle(x: Float[Array, "b i j d"], factor: int = 2) -> Float[Array, "b h w c"]:
    """What `pixel_shuffle` makes an image of: height and width, multiples of `factor`, divided by it."""
    batch, height, width, channels = x.shape
    x = x.reshape(batch, height // factor, factor, width // factor, factor, channels)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(batch, height // factor, width // factor, factor**2 * channels)


@jax.vmap
def warp(image, motion):
    """`backward_warp` for an image that is known to be finite: mapped, that one would compute both of its cases."""
    x, y, _ = landing(motion)
    return sample(image, x, y, product=operator.mul)  # type: ignore[arg-type]


def pad_to_multiple(x: Float[Array, "b h w c"], multiple: int) -> Float[Array, "b i j c"]:
    """The frame padded, at the bottom and on the right, to a multiple of `multiple`, by mirroring it at its edge.

    The pixels keep their position on every level of a network; crop its result by `y[:, :height, :width]`. Within 8
    pixels of the padding zeros cost the trained ExtraNet 1.2 to 3.1 times the error of mirroring, repeating the edge
    1.0 to 1.5 times (its official test frames cropped to five sizes, against the whole frames' results).
    """
    _, height, width, _ = x.shape
    return jnp.pad(x, ((0, 0), (0, -height % multiple), (0, -width % multiple), (0, 0)), mode="symmetric")
