"""Stiff and extreme inputs of every public function, loss and method, and what has to hold there.

A row is an input of one kind (motion, radiance, ...) as nobody would wish for it; a case is a function with ordinary
arguments, whose leaves of that kind the row replaces. Finite input has to give a finite value and finite gradients, and
not-a-number in one pixel of one argument may only reach the pixels around it. What is documented to be otherwise is
listed here, with the reason, and has to be so: `LISTED` and `WHOLE`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import synthetic
import test_settings
from oracles import look, perspective

import jaxtrapolate as jx
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.methods.hindsight import plain_share
from jaxtrapolate.methods.method import Method
from jaxtrapolate.metrics import image as metrics
from jaxtrapolate.ops import depth as depths
from jaxtrapolate.ops.radiance import demodulation_divisor
from jaxtrapolate.records import replace
from jaxtrapolate.training import losses


@dataclasses.dataclass(frozen=True)
class Case:
    """A function of arrays and records; kinds: of each argument that is an array, by `ROWS`; "" for none of them.

    Leaves of records are of the kind that their field says.
    """

    function: Callable[..., Any]
    arguments: tuple
    kinds: tuple[str, ...]


# Rows


def _filled(value):
    return lambda a: np.full_like(a, value)


def _halves(left, right):
    def fill(a):
        out = np.full_like(a, left)
        out[:, a.shape[1] // 2 :] = right
        return out

    return fill


def _alternating(value):
    def fill(a):
        out = np.full_like(a, value)
        out.reshape(-1)[::2] = -value
        return out

    return fill


def _one(value, rest):
    def fill(a):
        out = np.full_like(a, rest)
        out[a.shape[0] // 2, a.shape[1] // 2] = value
        return out

    return fill


ROWS: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "motion 0": ("motion", _filled(0)),
    "motion 1e6": ("motion", _filled(1e6)),
    "motion 3e38": ("motion", _filled(3e38)),
    "motion -3e38 beside 3e38": ("motion", _alternating(3e38)),
    "motion NaN": ("motion", _filled(np.nan)),
    "motion inf": ("motion", _filled(np.inf)),
    "radiance 0": ("color", _filled(0)),
    "radiance 1e-42": ("color", _filled(1e-42)),
    "radiance 2e-38": ("color", _filled(2e-38)),
    "radiance 1e-20": ("color", _filled(1e-20)),
    "radiance 1e-8": ("color", _filled(1e-8)),
    "radiance 65504": ("color", _filled(65504)),
    "radiance 1e30": ("color", _filled(1e30)),
    "lamp of 65504 in 1e-8": ("color", _one(65504, 1e-8)),
    "albedo 0": ("albedo", _filled(0)),
    "depth 0": ("depth", _filled(0)),
    "depth 1e-2 beside 1e5": ("depth", _halves(1e-2, 1e5)),
    "depth 1e-30 beside 3e38": ("depth", _halves(1e-30, 3e38)),
    "depth 5 beside inf": ("depth", _halves(5, np.inf)),
    "depth inf": ("depth", _filled(np.inf)),
    "normals 0": ("normal", _filled(0)),
    "normals 1e30": ("normal", _filled(1e30)),
    "normals -1e-30 beside 1e-30": ("normal", _alternating(1e-30)),
    "positions 0": ("position", _filled(0)),
    "positions 1e30": ("position", _filled(1e30)),
    "n_dot_v 0": ("n_dot_v", _filled(0)),
    "ids 0": ("stencil", _filled(0)),
    "ids that differ": ("stencil", _alternating(7)),
    "sky everywhere": ("sky", _filled(1)),
    "weights 0": ("weight", _filled(0)),
    "weights 1e-30": ("weight", _filled(1e-30)),
    "weights 3e38": ("weight", _filled(3e38)),
    "mask 0": ("mask", _filled(0)),
    "mask 1": ("mask", _filled(1)),
    "matrices 0": ("matrix", _filled(0)),
    "times alike": ("time", _filled(1)),
}
"""By name: the kind of what is replaced, and by what."""

_FIELDS = {
    "forward_flow": "motion",
    "backward_flow": "motion",
    "sky_color": "color",
    "view": "matrix",
    "projection": "matrix",
    "objects": "matrix",
}
"""Kinds of fields of records that are not called like their kind."""


# Cases

_ALL = test_settings.ALL
_KINDS: dict[str, tuple[str, ...]] = {
    "backward_warp": ("color", "motion", ""),
    "camera_flow": ("position", "matrix", "matrix"),
    "camera_flow-objects": ("position", "matrix", "matrix", "stencil"),
    "camera_motion": ("position", "matrix", "matrix"),
    "camera_motion-objects": ("position", "matrix", "matrix", "stencil"),
    "chain_motion": ("motion", "motion"),
    "convert_motion": ("motion",),
    "demodulate": ("color", "albedo", ""),
    "demodulate-all": ("color",),
    "dilate_motion": ("motion", "depth"),
    "dual_start": ("motion",),
    "edges": (),
    "fill_around": ("color", "depth"),
    "fill_pyramid": ("color",),
    "forecast": (),
    "grid_warp": ("color", "motion", "depth"),
    "guided_warp": ("color", "motion", "albedo", "albedo", "", ""),
    "guided_warp-packed": ("color", "motion", "albedo"),
    "hole_masks": ("normal", "position", "position", "motion", ""),
    "in_frame": ("motion",),
    "interpolate_assisted": ("color", "color", "depth", "motion"),
    "interpolate_bidirectional": ("color", "color", "motion", "motion", "depth"),
    "iterative_search": ("motion", ""),
    "iterative_search-newton": ("motion", ""),
    "latest_start": ("motion", "depth"),
    "modulate": ("color", "albedo", ""),
    "extranet_loss": ("color", "color", "mask"),
    "extranet_loss-paper": ("color", "color", "mask"),
    "far_motion": ("motion", "albedo", "albedo"),
    "occlusion_motion": ("motion", "depth"),
    "overlay": ("color", "depth"),
    "psnr": ("color", "color", ""),
    "psnr-mask": ("color", "color", "mask"),
    "relative_loss": ("color", "color", "color"),
    "temporal_loss": ("color", "color", "mask"),
    "splat": ("color", "motion"),
    "splat-linear": ("color", "motion", "weight"),
    "splat-softmax": ("color", "motion", "weight"),
    "splat_nearest": ("color", "motion", "depth"),
    "splat_nearest-one": ("color", "motion", "depth"),
    "srgb_encode": ("color",),
    "ssim": ("color", "color", ""),
    "ssim-mask": ("color", "color", "mask"),
    "tonemap": ("color", ""),
    "tonemap_inverse": ("color", ""),
}


def _kinds(name: str, arguments: tuple) -> tuple[str, ...]:
    """Of each argument; those of the plain image function where nothing else is said."""
    bare = name.split("-")[0]
    stated = list(_KINDS.get(name, _KINDS.get(bare, ("color",) * len(arguments))))
    if name.startswith("backward_warp-"):
        stated = ["color", "motion"]
    return tuple(stated.pop(0) if hasattr(a, "dtype") and stated else "" for a in arguments)


def function_cases() -> dict[str, Case]:
    """Every public operation, metric and loss, with the arguments of `test_settings.ALL`."""
    named = {n: (f, *a) for n, (f, *a) in _ALL.items() if n not in ("extranet_loss", "cause_map", "disoccluded")}
    buffers, frames, color = test_settings.buffers, test_settings.frames, test_settings.image
    mask = np.asarray(buffers.stencil)
    keyframes = test_settings.keyframes

    def shown(result):
        return result.color, result.weight, result.forward.position

    named |= {
        "extranet_loss": (lambda p, t, m: losses.extranet_loss(p, t, m)[0], color, color[::-1], mask),
        "hole_loss": (losses.hole_loss, color, color[::-1], mask),
        "shading_loss": (losses.shading_loss, color, color[::-1]),
        "plain_share": (
            lambda a, b, m: plain_share(a, b, m, by="albedo+specular"),
            *(frames[1], frames[0], test_settings.motion),
        ),
        "surface_depth": (depths.surface_depth, buffers.depth),
        "demodulation_divisor": (demodulation_divisor, buffers),
        "interpolate_bidirectional-ids": (
            lambda a, b, t: shown(jx.interpolate_bidirectional(a, b, 0.4, target=t, stencil_ids=(1,))),
            *(keyframes[0], keyframes[2], keyframes[1]),
        ),
        "interpolate_image_based": (lambda a, b: shown(jx.interpolate_image_based(a, b, 0.4)), *keyframes[:2]),
        "overlay": (
            lambda a, b, c, d: shown(jx.overlay(jx.interpolate_assisted(a, b, b, 0.4), c, d, d[..., 0] > 5)),
            *(*keyframes[:2], color, buffers.depth),
        ),
        "psnr-mask": (lambda a, b, m: metrics.psnr(a, b, mask=m > 0), color, color[::-1], mask),
        "psnr": (lambda a, b, p: metrics.psnr(a, b, peak=p), color, color[::-1], np.float32(1)),
        "splat_nearest-covered": (jx.splat_nearest, color, test_settings.motion, buffers.depth),
    }
    kinds = {
        "hole_loss": ("color", "color", "mask"),
        "plain_share": ("", "", "motion"),
        "surface_depth": ("depth",),
        "splat_nearest-covered": ("color", "motion", "depth"),
    }
    return {
        name: Case(function, tiled(tuple(arguments), (36, 40)), kinds.get(name, _kinds(name, tuple(arguments))))
        for name, (function, *arguments) in named.items()
    }


def is_image(leaf: Any) -> bool:
    """Whether an array is `[H, W, C]`, and no row of matrices."""
    return np.ndim(leaf) == 3 and np.shape(leaf)[1:] != (4, 4)


def tiled(arguments: tuple, size: tuple[int, int]) -> tuple:
    """The arguments with each image repeated to a larger size, so that there is a far away from a pixel in it."""

    def repeat(leaf):
        if not is_image(leaf):
            return leaf
        times = (-(-n // m) for n, m in zip(size, np.shape(leaf)[:2], strict=True))
        return np.tile(leaf, (*times, 1))[: size[0], : size[1]]

    return jax.tree.map(repeat, arguments)


def cropped(arguments: tuple, size: tuple[int, int]) -> tuple:
    """The arguments with each image's upper left corner of a smaller size."""
    return jax.tree.map(lambda leaf: leaf[: size[0], : size[1]] if is_image(leaf) else leaf, arguments)


def method_cases(size: tuple[int, int] = (40, 48)) -> dict[str, Case]:
    """Every method but those on the host, on frames with every buffer; networks are small ones with random weights."""
    return {name: method_case(name, size) for name in jx.method_names()}


def method_case(name: str, size: tuple[int, int]) -> Case:
    """One method as a function of the frames before, of and after the target."""
    method: Method = test_settings.method(name)
    history, target, future = method_frames(method, size)

    def function(history, target, future):
        return method.function(method.state, method.init(history, target), history, target, future)[1]

    return Case(function, (history, target, future), ("", "", ""))


def method_frames(method: Method, size: tuple[int, int]):
    """Frames of a moving box with every buffer, every other one rendered, seen by a camera that moves."""
    sequence, past, future = [], 2 * method.past - 1, max(0, 2 * method.future - 1)
    place = max(5, past)
    for k in range(place + 4):
        frame = synthetic.make_frame(k, size, fog=0.3)
        full = replace(frame.gbuffer, sky=np.zeros_like(frame.gbuffer.depth), sky_color=frame.color)
        camera = jx.Camera(look(0.02 * k).astype(np.float32), perspective(*size).astype(np.float32))
        behind = np.float32([0, 0, 10])  # in front of that camera
        full = replace(full, position=full.position - behind)
        frame = replace(frame, gbuffer=full, camera=camera)
        sequence.append(replace(frame if k % 2 == 0 else hide(frame), time=np.float32(k)))
    return tuple(sequence[place - past : place]), sequence[place], tuple(sequence[place + 1 : place + 1 + future])


# What may be otherwise

_STAYS = "motion that is not finite stays so: no vector"
_NOTHING = "depth is +inf where nothing was hit"
_BEHIND = "NaN where a point is not in front of both cameras: no vector"
_BEYOND = "beyond the largest number"
_EQUAL = "infinite decibels for equal images"
_EMPTY = "NaN for an empty mask"
_NO_VECTOR = ("motion NaN", "motion inf")
_NO_DEPTH = ("depth 0", "depth 5 beside inf", "depth inf")
_EQUALLY = tuple(row for row, (kind, _) in ROWS.items() if kind == "color")
_REASONS: dict[str, dict[str, tuple[str, ...]]] = {
    _STAYS: {
        name: _NO_VECTOR
        for name in (
            *("chain_motion", "convert_motion", "dilate_motion", "far_motion", "forecast"),
            *("complete_flows", "complete_flows-flat"),
        )
    },
    "the error is infinite where the flow is not finite": {"iterative_search-newton": _NO_VECTOR},
    _NOTHING: {name: _NO_DEPTH for name in ("complete_flows", "complete_flows-flat", "forecast", "surface_depth")},
    _BEHIND: {
        "camera_motion": ("positions 0", "positions 1e30", "matrices 0"),
        "camera_flow": ("positions 0", "positions 1e30", "matrices 0"),
        "camera_motion-objects": ("matrices 0",),
        "camera_flow-objects": ("matrices 0",),
    },
    _BEYOND: {
        "convert_motion": ("motion 3e38", "motion -3e38 beside 3e38"),
        "camera_motion-objects": ("positions 1e30",),
        "camera_flow-objects": ("positions 1e30",),
        "srgb_decode": ("radiance 1e30",),
        "mse": ("radiance 1e30",),
        "relative_loss": ("radiance 1e30",),
    },
    "infinite from 1 on": {"tonemap_inverse": ("radiance 65504", "radiance 1e30", "lamp of 65504 in 1e-8")},
    _EQUAL: {"psnr": _EQUALLY, "psnr-mask": _EQUALLY},
    _EMPTY: {"psnr-mask": ("mask 0",), "ssim-mask": ("mask 0",)},
}
LISTED = {(name, row): reason for reason, cases in _REASONS.items() for name, rows in cases.items() for row in rows}
"""By case and row: why value or gradient is not finite there."""

MEANS = ("mse", "psnr", "ssim", "l1_loss", "charbonnier_loss", "hole_loss", "shading_loss", "extranet_loss")
MEANS += ("relative_loss", "census_loss", "feature_census_loss", "feature_difference_loss", "slope_loss")
MEANS += ("temporal_loss",)
"""One number of all pixels: what is not a number in one of them is seen in it."""

REACHES = {"": 4, "extrass_refine": 6, "extrass": 6}
"""In pixels, how far what is not a number in one of them may reach; "" is of all cases that are not named.

What is made at half the size, three pixels there, is twice as far.
"""


# Running


def leaf_kinds(case: Case) -> list[str]:
    """The kind of each leaf of the arguments."""
    found = []
    for path, _ in jax.tree_util.tree_leaves_with_path(case.arguments):
        name = next((str(p.name) for p in reversed(path) if hasattr(p, "name")), "")
        found.append(_FIELDS.get(name, name) if name else case.kinds[path[0].idx])
    return found


def rows_of(case: Case) -> list[str]:
    """The rows that concern a case."""
    kinds = set(leaf_kinds(case))
    return [name for name, (kind, _) in ROWS.items() if kind in kinds]


def with_row(case: Case, row: str) -> list[tuple]:
    """The arguments of a case with those of a row's kind replaced: all of them, and then the first alone."""
    kind, fill = ROWS[row]
    leaves, tree = jax.tree.flatten(case.arguments)
    places = [k for k, found in enumerate(leaf_kinds(case)) if found == kind]
    new = []
    for chosen in [places, places[:1]][: len(places)]:
        replaced = list(leaves)
        for k in chosen:
            replaced[k] = np.asarray(fill(np.asarray(leaves[k])), np.asarray(leaves[k]).dtype)
        new.append(tree.unflatten(replaced))
    return new


def with_pixel(case: Case, value: float = np.nan) -> dict[str, tuple[tuple[int, int], tuple]]:
    """By leaf: the pixel in the middle, and the arguments with it not a number in that leaf alone."""
    leaves, tree = jax.tree.flatten(case.arguments)
    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(case.arguments)]
    found = {}
    for k, leaf in enumerate(leaves):
        if is_image(leaf):
            place = leaf.shape[0] // 2, leaf.shape[1] // 2
            spoilt = np.array(leaf)
            spoilt[place] = value
            found[names[k]] = place, tree.unflatten([*leaves[:k], spoilt, *leaves[k + 1 :]])
    return found


EVERYWHERE = 10**6
"""The reach of what is not finite in a result that is no image."""


def reach(tree: Any, usual: Any, place: tuple[int, int]) -> int:
    """How many pixels from a place what is not finite lies, and is usually; -1 where there is nothing of it.

    The place is the middle. Of a result that is larger than the argument they are the argument's pixels.
    """
    farthest = -1
    for array, other in zip(jax.tree.leaves(tree), jax.tree.leaves(usual), strict=True):
        array, other = (np.asarray(a, np.float64) for a in (array, other))
        spoilt = ~np.isfinite(array) & np.isfinite(other)
        if not spoilt.any():
            continue
        if array.ndim < 3 or array.shape[-2:] == (4, 4):
            return EVERYWHERE
        *_, rows, columns = np.nonzero(spoilt.any(-1))  # of a run of images, in any of them
        scale = max(1, round(spoilt.shape[-3] / (2 * place[0] + 1)))
        rows, columns = rows // scale, columns // scale
        farthest = max(farthest, int(np.abs(rows - place[0]).max()), int(np.abs(columns - place[1]).max()))
    return farthest


def differentiated(function: Callable) -> Callable:
    """Compiled: `(results, gradients)`, of a loss over all finite results with weights of both signs."""

    def loss(arguments):
        results = [a for a in jax.tree.leaves(function(*arguments)) if jnp.issubdtype(a.dtype, jnp.floating)]
        total = jnp.zeros((), jnp.float32)
        for a in results:
            weight = jnp.cos(jnp.arange(a.size, dtype=jnp.float32)).reshape(a.shape)
            # scaled, so that the loss of large results is finite
            total += jnp.sum(jnp.where(jnp.isfinite(a), a, 0).astype(jnp.float32) * weight * jnp.float32(1e-4))
        return total, results

    def both(arguments):
        gradients, results = jax.grad(loss, has_aux=True)(arguments)
        return results, gradients

    return jax.jit(both)


def finite(tree: Any) -> bool:
    """Whether every number of a tree is."""
    return all(np.isfinite(np.asarray(a, np.float64)).all() for a in jax.tree.leaves(tree))


def examine(case: Case) -> dict[str, Any]:
    """What is not finite in each row, in words, and how far one pixel that is not a number reaches.

    Returns:
        "rows": by row "value", "gradient", both or ""; "reach": in value and gradient, -1 where it does nothing.
    """
    run = differentiated(case.function)
    rows = {}
    for row in rows_of(case):
        found = " and ".join(verdict(*run(arguments)) for arguments in with_row(case, row))
        rows[row] = " and ".join(word for word in ("value", "gradient") if word in found)
    usual = run(case.arguments)
    farthest = [-1, -1]
    for place, arguments in with_pixel(case).values():
        found = run(arguments)
        farthest = [max(far, reach(*pair, place)) for far, *pair in zip(farthest, found, usual, strict=True)]
    return {"rows": rows, "reach": farthest}


def verdict(results: Any, gradients: Any) -> str:
    """What is not finite, in words; "" where all is."""
    wrong = [name for name, tree in (("value", results), ("gradient", gradients)) if not finite(tree)]
    return " and ".join(wrong)
