"""Methods by name: `jaxtrapolate.load`."""

import dataclasses
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from inspect import getdoc
from os import PathLike
from typing import Any

from jaxtrapolate.methods import (
    bidirectional,
    blending,
    extranet,
    extrass,
    extrass_joint,
    grids,
    guided_net,
    interpolator,
    opticalflow,
    reprojection,
    shading,
    upsampling,
    warping,
)
from jaxtrapolate.methods.frames import neighbours as neighbours
from jaxtrapolate.methods.method import Method as Method
from jaxtrapolate.methods.method import Precision as Precision
from jaxtrapolate.methods.stage import Needed as Needed
from jaxtrapolate.methods.stage import Stage as Stage
from jaxtrapolate.weights import default_weights

_METHODS: dict[str, Callable[[], Method]] = {
    "repeat": warping.repeat,
    "warp": warping.warp,
    "occlusion_warp": warping.occlusion_warp,
    "guided_warp": warping.guided,
    "extrass_warp": extrass.extrass_warp,
    "shading_warp": shading.shading_warp,
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
    "bidirectional_shading": shading.bidirectional_shading,
    "bilinear": upsampling.bilinear,
    "bicubic": upsampling.bicubic,
    "easu": upsampling.easu,
    "taa": upsampling.taa,
    "taau": upsampling.taau,
}


_NETWORKS: dict[str, Callable[[str | PathLike[str]], Method]] = {
    "guided_net": guided_net.load,
    "extranet": extranet.load,
    "extrass_refine": extrass.load_refine,
    "extrass": extrass_joint.load,
    "interpolator": interpolator.load,
}
"""Methods with weights, each built from a file of them."""


_DESCRIBED: dict[str, Callable[..., Method]] = _METHODS | {
    "guided_net": guided_net.guided_net,
    "extranet": extranet.extranet,
    "extrass_refine": extrass.extrass_refine,
    "extrass": extrass_joint.extrass,
    "interpolator": interpolator.interpolator,
}

BEST_FIRST = (
    *("bidirectional_shading", "bidirectional_guided", "bidirectional", "guided_net", "shading_warp", "guided_warp"),
    *("bidirectional_image", "interpolator", "occlusion_warp", "softmax_splat", "dis", "warp", "blend", "repeat"),
)
"""Methods by what they have been worth on embedded scenes: what is used where none is named is the first that can."""

ON_REQUEST = (extranet.NAME, extrass.WARP_NAME, extrass.REFINE_NAME, extrass_joint.NAME, *upsampling.NAMES)
"""The papers' own forms of `guided_net` and `guided_warp`, what has no default weights, and what super samples."""

ENTRY_POINTS = "jaxtrapolate.methods"
"""The group of entry points by which other packages add methods, see `load`."""


def _others() -> dict[str, EntryPoint]:
    """The methods of other packages by name; those of this one go before them."""
    found = entry_points(group=ENTRY_POINTS)
    return {point.name: point for point in sorted(found, key=lambda p: p.name) if point.name not in _DESCRIBED}


def method_names() -> tuple[str, ...]:
    """The names that `load` knows, those of other installed packages last; some need a file of weights."""
    return (*_METHODS, *_NETWORKS, *_others())


def default_methods() -> tuple[str, ...]:
    """The methods that are tried where none is named: all but `ON_REQUEST`."""
    return tuple(name for name in method_names() if name not in ON_REQUEST)


def method_description(name: str) -> str:
    """The first line that a method's own documentation says.

    Raises:
        ValueError: an unknown name, or a method of another package that cannot be imported.
    """
    return (getdoc(_DESCRIBED[name] if name in _DESCRIBED else _factory(name)) or "").partition("\n")[0]


def _factory(name: str) -> Callable[..., Method]:
    point = _others().get(name)
    if point is None:
        raise ValueError(f"method: expected one of {', '.join(method_names())}, got {name!r}")
    try:
        return point.load()
    except Exception as error:
        package = point.dist.name if point.dist is not None else point.value
        raise ValueError(f"method {name!r} of the package {package} cannot be imported: {error}") from error


def load(
    name: str, *, weights: str | PathLike[str] = "default", dtype: Precision | None = None, **options: Any
) -> Method:
    """A method by name.

    A package adds one by an entry point of the group "jaxtrapolate.methods": its name, and a function that returns a
    `Method`, called without arguments, or with `weights=` where a file of weights is named.

    Args:
        name: one of `method_names()`.
        weights: for methods that have any: "default", those that come with the package; a file of weights of this
            library (`.npz`); an Orbax checkpoint (a folder); for "extranet" also the authors' `.pth.tar`.
        dtype: "float32", "bfloat16" or "float16": what colours and buffers are cast to before the stages; the image is
            in the dtype of the colours that were given. Motion, depth, position, stencil, cameras and times keep
            their dtype, and a network computes in the dtype of its weights. `None` = nothing is cast.
        options: of the method, as `Method.options` lists them; see `Method.replace`.

    Returns:
        A `Method`: `image = method(history, target, future=())`.

    Raises:
        OSError: the file of weights cannot be read.
        ValueError: an unknown name, weights for a method that has none, a method without default weights, or a file
            that holds none of that method; a method of another package that cannot be imported or is none; an option
            that the method does not have, or of a wrong kind or out of range.
    """
    method = _load(name, weights)
    method = method if dtype is None else dataclasses.replace(method, dtype=dtype)
    return method.replace(**options) if options else method


def _load(name: str, weights: str | PathLike[str]) -> Method:
    if name in _METHODS:
        if weights != "default":
            raise ValueError(f"weights: method {name!r} has none, got {str(weights)!r}")
        return _METHODS[name]()
    if name in _NETWORKS:
        return _NETWORKS[name](default_weights(name) if weights == "default" else weights)
    method = _factory(name)() if weights == "default" else _factory(name)(weights=weights)
    if not isinstance(method, Method):
        raise ValueError(f"method {name!r}: expected its entry point to return a Method, got {type(method).__name__}")
    return method
