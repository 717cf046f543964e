"""ExtraNet (Guo et al. 2021): a gated U-Net that fills holes and shades anew, and an encoder of warped histories.

The layers follow section 4 of the paper and, where it is silent, the authors' release.
"""

import dataclasses
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from jaxtrapolate.checks import check_array, check_present
from jaxtrapolate.networks.blocks import HE, LINEAR, Gate, Layer, pad_to_multiple, upsample_2x


@dataclasses.dataclass(frozen=True)
class ExtraNetConfig:
    """The size of an `ExtraNet`; the defaults are the paper's, with 262,141 parameters.

    Attributes:
        widths: channels at full resolution, then of each level below, half as large each. The histories' encoder has
            those of the levels below.
        gate: of the encoder's convolutions: "light", "full" (Yu et al. 2019) or "none".
        warps: warped images of three channels in x; with 1 there is no occlusion composite (Table 7, "w/o OMV").
        features: channels of the target's buffers; 0 for none.
        histories: warped rendered frames; 0 leaves out their encoder (Table 7, "w/o HE").
        norm: whether layers have batch norms; without them initial weights keep the size of signals, ours.
        direct: whether the encoder of the frame sees the histories too, at full resolution; ours, not the paper's.
        contrast: where above 0, all images but x's first are shown as their difference to that one, times this; ours.
        guess: channels that tell of x's first image, last in features and last of what the encoder sees, so that
            weights without them can be trained further with them; 0 for none; ours.
    """

    widths: tuple[int, ...] = (24, 24, 32, 32)
    gate: Gate = "light"
    warps: int = 2
    features: int = 6
    histories: int = 3
    norm: bool = True
    direct: bool = False
    contrast: float = 0.0
    guess: int = 0

    @property
    def multiple(self) -> int:
        """What height and width are padded to a multiple of: 2 to the number of levels below the first."""
        return 2 ** (len(self.widths) - 1)


GATED_CONVOLUTION = ExtraNetConfig(gate="full", histories=0)
"""The baseline "GC": in-painting by full gates (Yu et al. 2019) without histories, at ExtraNet's widths.

The paper fine-tunes Yu's own two-stage network; this one differs from ExtraNet only in gates and histories.
"""


class ExtraNet(nnx.Module):
    """The network: `model(x, mask, features, history)` is irradiance in the log domain.

    Args:
        config: sizes and what is left out.
        rngs: `nnx.Rngs(params=...)`; the initialisation is PyTorch's default, as in the paper, but without batch norms.

    References:
        Guo et al. 2021, sections 4.3 and 4.4. In training the histories share one batch norm's statistics, taken over
        all of them at once; the release takes them of one history after the other. Evaluated, both are the same. What
        `norm`, `direct` and `contrast` change, and what each is worth, is in experiments/README.md.
    """

    def __init__(self, config: ExtraNetConfig = ExtraNetConfig(), *, rngs: nnx.Rngs):
        widths, gate = config.widths, config.gate
        self.config = config
        inputs = 2 * 3 * config.warps + config.features + config.guess + (4 * config.histories if config.direct else 0)
        usual: dict[str, Any] = {"rngs": rngs}
        gated: dict[str, Any] = {"gate": gate, "rngs": rngs}
        bare: dict[str, Any] = {"norm": False, "activation": "none", "rngs": rngs}
        last: dict[str, Any] = dict(bare)
        if not config.norm:
            opened = 1.0 if gate == "none" else 2.0  # a gate is half open at first
            usual |= {"norm": False, "gain": HE}
            gated |= {"norm": False, "gain": opened * HE}
            bare["gain"], last["gain"] = opened * LINEAR, 0.05

        def pair(before, after):
            return [Layer(before, after, **gated), Layer(after, after, **gated)]

        self.encoder = nnx.List([nnx.Sequential(*pair(inputs, widths[0]))])
        for before, after in pairwise(widths):
            self.encoder.append(
                nnx.Sequential(Layer(before, before, stride=2, gate=gate, **bare), *pair(before, after))
            )
        deepest = widths[-1]
        self.history: nnx.Sequential | None = nnx.data(None)
        self.merge: Layer | None = nnx.data(None)
        if config.histories:
            stages, before = [], 4
            for after in widths[1:]:
                stages += [Layer(before, after, stride=2, **usual)]
                stages += [Layer(after, after, **usual) for _ in range(2)]
                before = after
            self.history = nnx.Sequential(*stages)
            self.merge = Layer(config.histories * deepest, deepest, gate=gate, **bare)
        self.decoder, below = nnx.List([]), deepest * (2 if config.histories else 1)
        for skip in widths[-2::-1]:
            inputs = skip + below
            middle = inputs // 2
            self.decoder.append(nnx.Sequential(Layer(inputs, middle, **usual), Layer(middle, skip, **usual)))
            below = skip
        self.output = Layer(widths[0], 3, size=1, **last)

    def __call__(
        self,
        x: Float[Array, "b h w x"],
        mask: Float[Array, "b h w 1"],
        features: Float[Array, "b h w f"] | None,
        history: Float[Array, "b n h w 4"] | None,
    ) -> Float[Array, "b h w 3"]:
        """The target's irradiance, demodulated and in the log domain: the residual is added to x's first image.

        Args:
            x: `[B, H, W, 6]`, log(1 + r) of the newest rendered frame, warped by its motion, then of its occlusion
                composite. Any size from 1 x 1 on: inside it is padded, see `pad_to_multiple`.
            mask: `[B, H, W, 1]`, 1 = valid, 0 = hole.
            features: `[B, H, W, 6]`: world normal, depth, roughness, metallic of the target, and further ones of the
                configuration's `guess`; `None` where it has none of both.
            history: `[B, N, H, W, 4]`, oldest first: each warped frame's log(1 + r), then its mask; `None` likewise.

        Returns:
            `[B, H, W, 3]` in the dtype of x. All but the last sum is computed in the dtype of the parameters.

        Edge cases:
            A pixel that is not finite spreads to all that its receptive field reaches, in a hole too: fill such pixels
            before.

        Raises:
            TypeError, ValueError: no floating-point array, a shape that does not fit, features or history absent.
        """
        config = self.config
        batch, height, width, _ = check_array("x", x, shape=("B", "H", "W", 3 * config.warps))
        check_array("mask", mask, shape=(batch, height, width, 1))
        inputs, history = self._inputs(x, mask, features, history)
        value = pad_to_multiple(jnp.concatenate(inputs, -1), config.multiple)
        skips = []
        for level in self.encoder:
            value = level(value)
            skips.append(value)
        value = skips.pop()
        if history is not None:
            value = jnp.concatenate([value, self._encode(history)], -1)
        for level in self.decoder:
            value = level(jnp.concatenate([skips.pop(), upsample_2x(value)], -1))
        residual = self.output(value)[:, :height, :width]
        return x[..., :3] + residual.astype(x.dtype)

    def _inputs(self, x, mask, features, history):
        """What the frame's encoder is shown, each `[B, H, W, C]`, and what the histories' is."""
        config, size = self.config, x.shape[:3]
        if config.contrast:
            first = x[..., :3]
            others = x[..., 3:].reshape(*size, config.warps - 1, 3) - first[..., None, :]
            x = jnp.concatenate([first, config.contrast * others.reshape(*size, 3 * config.warps - 3)], -1)
        inputs, guess = [x, x * mask], []
        if config.features + config.guess:
            features = check_present("features", features, needed_by="this network")
            check_array("features", features, shape=(*size, config.features + config.guess))
            inputs.append(features[..., : config.features])
            guess = [features[..., config.features :]]
        if not config.histories:
            return inputs + guess, None
        history = check_present("history", history, needed_by="this network")
        check_array("history", history, shape=(size[0], config.histories, *size[1:], 4))
        if config.contrast:
            images = config.contrast * (history[..., :3] - first[:, None])
            history = jnp.concatenate([images, history[..., 3:]], -1)
        return inputs + (list(jnp.moveaxis(history, 1, 0)) if config.direct else []) + guess, history

    def _encode(self, history):
        """All histories in one pass through their common encoder, then merged: `[B, h, w, C]`."""
        batch, count, height, width, channels = history.shape
        assert self.history is not None
        assert self.merge is not None
        frames = pad_to_multiple(history.reshape(-1, height, width, channels), self.config.multiple)
        codes = self.history(frames)
        codes = jnp.moveaxis(codes.reshape(batch, count, *codes.shape[1:]), 1, 3)
        return self.merge(codes.reshape(*codes.shape[:3], -1))


def _release_names(model: ExtraNet) -> list[tuple[Any, str, str | None]]:
    """Each `Layer` with the release's names of its convolution and batch norm."""
    names: list[tuple[Any, str, str | None]] = []
    for k, level in enumerate(model.encoder):
        *down, first, second = level.layers
        prefix = f"down{k}." if k else ""
        names += [(layer, f"{prefix}downsample", None) for layer in down]
        names += [(first, f"{prefix}conv1", f"{prefix}bn1"), (second, f"{prefix}conv2", f"{prefix}bn2")]
    if model.history is not None:
        for k, layer in enumerate(model.history.layers):
            stage, place = f"convHis{k // 3 + 1}", k % 3 * 3
            names.append((layer, f"{stage}.{place}", f"{stage}.{place + 1}"))
        names.append((model.merge, "lowlevelGated", None))
    for k, level in enumerate(model.decoder):
        stage = f"up{k + 1}.conv.double_conv"
        names += [(layer, f"{stage}.{3 * j}", f"{stage}.{3 * j + 1}") for j, layer in enumerate(level.layers)]
    return [*names, (model.output, "outc", None)]


def extranet_from_torch(state_dict: Mapping[str, np.ndarray], *, config: ExtraNetConfig = ExtraNetConfig()) -> ExtraNet:
    """An `ExtraNet` with weights by the names and in the layout of the authors' release, set to evaluation.

    Args:
        state_dict: the arrays of the release's checkpoint by name; kernels are `[out, in, height, width]`.
            "num_batches_tracked" is passed over.
        config: what the weights are of.

    Returns:
        The model, its batch norms using the running statistics.

    Raises:
        ValueError: names that are missing or unknown, or an array whose shape does not fit, named.
    """
    model = nnx.eval_shape(lambda: ExtraNet(config, rngs=nnx.Rngs(0)))  # shapes only
    left = {k: v for k, v in state_dict.items() if not k.endswith("num_batches_tracked")}

    def put(variable, name, axes=None):
        if name not in left:
            raise ValueError(f"state_dict: {name} is missing")
        value = np.asarray(left.pop(name))
        if axes is not None and value.ndim == len(axes):
            value = value.transpose(axes)
        if value.shape != variable.shape:
            raise ValueError(f"state_dict: {name}: expected shape {list(variable.shape)}, got {list(value.shape)}")
        variable.set_value(jnp.asarray(value, variable.dtype))

    def put_convolution(convolution, name):
        put(convolution.kernel, f"{name}.weight", (2, 3, 1, 0))
        put(convolution.bias, f"{name}.bias")

    for layer, name, norm in _release_names(model):
        if layer.gate is None:
            put_convolution(layer.feature, name)
        else:
            put_convolution(layer.feature, f"{name}.conv_feature")
            put_convolution(layer.gate, f"{name}.conv_mask.0")
        if norm is not None and layer.norm is not None:
            put(layer.norm.scale, f"{norm}.weight")
            put(layer.norm.bias, f"{norm}.bias")
            put(layer.norm.mean, f"{norm}.running_mean")
            put(layer.norm.var, f"{norm}.running_var")
    if left:
        raise ValueError(f"state_dict: unknown names {', '.join(sorted(left))}")
    model.eval()
    return model
