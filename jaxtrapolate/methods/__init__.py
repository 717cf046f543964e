"""Methods by name: `jaxtrapolate.load`."""

from collections.abc import Callable
from os import PathLike

from jaxtrapolate.methods import (
    bidirectional,
    blending,
    extranet,
    grids,
    interpolator,
    opticalflow,
    reprojection,
    warping,
)
from jaxtrapolate.methods.method import Method as Method
from jaxtrapolate.methods.method import Stage as Stage
from jaxtrapolate.methods.method import neighbours as neighbours
from jaxtrapolate.weights import default_weights

_METHODS: dict[str, Callable[[], Method]] = {
    "repeat": warping.repeat,
    "warp": warping.warp,
    "occlusion_warp": warping.occlusion_warp,
    "guided_warp": warping.guided,
    "blend": blending.blend,
    "reproject": reprojection.reprojection,
    "half_motion": blending.half_motion,
    "warp_3d": reprojection.warp_3d,
    "grid_warp": grids.grid_warp,
    "grid_extrapolate": grids.grid_extrapolate,
    "softmax_splat": blending.softmax_splat,
    "dis": opticalflow.dis,
    "bidirectional_image": bidirectional.bidirectional_image,
    "bidirectional": bidirectional.bidirectional,
    "bidirectional_guided": bidirectional.bidirectional_guided,
}


_NETWORKS: dict[str, Callable[[str | PathLike[str]], Method]] = {
    "extranet": extranet.load,
    "interpolator": interpolator.load,
}
"""Methods with weights, each made from a file of them."""


def method_names() -> tuple[str, ...]:
    """The names that `load` knows; some need a file of weights."""
    return (*_METHODS, *_NETWORKS)


def load(name: str, *, weights: str | PathLike[str] = "default") -> Method:
    """A method by name.

    Args:
        name: one of `method_names()`.
        weights: for methods that have any: "default", those that come with the package; a file of weights of this
            library (`.npz`); an Orbax checkpoint (a folder); for "extranet" also the authors' `.pth.tar`.

    Returns:
        A `Method`: `image = method(history, target, future=())`.

    Raises:
        OSError: the file of weights cannot be read.
        ValueError: an unknown name, weights for a method that has none, a method without default weights, or a file
            that holds none of that method.
    """
    if name in _METHODS:
        if weights != "default":
            raise ValueError(f"weights: method {name!r} has none, got {str(weights)!r}")
        return _METHODS[name]()
    if name not in _NETWORKS:
        raise ValueError(f"method: expected one of {', '.join(method_names())}, got {name!r}")
    return _NETWORKS[name](default_weights(name) if weights == "default" else weights)
