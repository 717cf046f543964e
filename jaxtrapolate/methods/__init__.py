"""Methods by name: `jaxtrapolate.load`."""

from collections.abc import Callable
from os import PathLike

from jaxtrapolate.methods import bidirectional, blending, grids, opticalflow, reprojection, warping
from jaxtrapolate.methods.method import Method as Method
from jaxtrapolate.methods.method import Stage as Stage

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


def method_names() -> tuple[str, ...]:
    """The names that `load` knows."""
    return tuple(_METHODS)


def load(name: str, *, weights: str | PathLike = "default") -> Method:
    """A method by name.

    Args:
        name: one of `method_names()`.
        weights: "default", or a file of weights, for methods that have any.

    Returns:
        A `Method`: `image = method(history, target, future=())`.

    Raises:
        ValueError: an unknown name, or weights for a method that has none.
    """
    if name not in _METHODS:
        raise ValueError(f"method: expected one of {', '.join(_METHODS)}, got {name!r}")
    if weights != "default":
        raise ValueError(f"weights: method {name!r} has none, got {str(weights)!r}")
    return _METHODS[name]()
