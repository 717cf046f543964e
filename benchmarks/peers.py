"""What the operations are compared with: cv2, loops in numba, scipy and torch; each is left out where not installed.

Equal footing: a peer gets the same float32 arrays in its own library's layout, makes what it derives from them (maps,
grids, coordinates) within the timed call, and allocates its result there, as ours do. The peers need not treat NaN. The
loops are compiled without fastmath, which gained nothing when tried; those over target pixels run in parallel where the
benchmark uses all cores, those that scatter are sequential, because their order matters.
"""

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

_PACKAGES = {
    "cv2": ("opencv-python-headless", "opencv-python"),
    "numba": ("numba",),
    "scipy": ("scipy",),
    "torch": ("torch",),
}


@dataclass(frozen=True)
class Peer:
    """Another way to do an operation.

    Attributes:
        name: in the results. needs: the module that it needs.
        make: (parallel, *arguments) -> a function of no arguments that does the operation.
        tolerance: a value of the answer agrees when it is as near as this to ours.
        share: of values that may be further off (where rounding decides between two pixels).
        same: whether it computes the same thing; if not, the answers are not compared, and `note` says why.
    """

    name: str
    needs: str
    make: Callable[..., Callable[[], Any]]
    tolerance: float = 1e-4
    share: float = 0.0
    same: bool = True
    note: str = ""


def installed() -> dict[str, str | None]:
    """The version of each module that peers need; None where it cannot be imported."""
    found: dict[str, str | None] = {}
    for module, packages in _PACKAGES.items():
        try:
            importlib.import_module(module)
        except ImportError:
            found[module] = None
            continue
        found[module] = "unknown"
        for package in packages:
            try:
                found[module] = version(package)
                break
            except PackageNotFoundError:
                continue
    return found


def set_threads(count: int) -> None:
    """Threads of all peers that are installed."""
    present = installed()
    if present["cv2"]:
        importlib.import_module("cv2").setNumThreads(count)
    if present["numba"]:
        numba = importlib.import_module("numba")
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    if present["torch"]:
        importlib.import_module("torch").set_num_threads(count)


# --- cv2 ---


def _map(motion):
    height, width, _ = motion.shape
    x = motion[..., 0] + np.arange(width, dtype=np.float32)
    y = motion[..., 1] + np.arange(height, dtype=np.float32)[:, None]
    return x, y


def cv2_warp(interpolation: str, *, map_given: bool = False):
    """cv2.remap; the map is made from the motion within the call, or before it where `map_given`."""

    def make(parallel, image, motion):
        import cv2

        how = {"interpolation": getattr(cv2, interpolation), "borderMode": cv2.BORDER_REPLICATE}
        if map_given:
            x, y = _map(motion)
            return lambda: cv2.remap(image, x, y, **how)
        return lambda: cv2.remap(image, *_map(motion), **how)

    return make


def cv2_chain(parallel, newer, older):
    import cv2

    how = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REPLICATE}
    return lambda: newer + cv2.remap(older, *_map(newer), **how)


def _codes(image):
    return np.round(255 * np.clip(image[..., 0], 0, 1)).astype(np.uint8)


def cv2_farneback(parallel, first, second):
    import cv2

    codes = _codes(first), _codes(second)
    return lambda: cv2.calcOpticalFlowFarneback(*codes, None, 0.5, 4, 15, 5, 7, 1.5, 0)


def cv2_dis(preset: str):
    def make(parallel, first, second):
        import cv2

        codes = _codes(first), _codes(second)
        search = cv2.DISOpticalFlow.create(getattr(cv2, f"DISOPTICAL_FLOW_PRESET_{preset.upper()}"))
        return lambda: search.calc(*codes, None)

    return make


# --- scipy ---


def _map_coordinates(image, motion, order):
    from scipy.ndimage import map_coordinates

    x, y = _map(motion)
    result = np.empty((*motion.shape[:2], image.shape[2]), image.dtype)
    for k in range(image.shape[2]):
        map_coordinates(image[..., k], (y, x), order=order, mode="nearest", prefilter=False, output=result[..., k])
    return result


def scipy_warp(order: int):
    return lambda parallel, image, motion: lambda: _map_coordinates(image, motion, order)


def scipy_chain(parallel, newer, older):
    return lambda: newer + _map_coordinates(older, newer, 1)


# --- torch ---


def torch_warp(mode: str):
    """grid_sample of a channels-last image; the grid is made from the motion within the call."""

    def make(parallel, image, motion):
        import torch

        pixels = torch.from_numpy(image)[None].permute(0, 3, 1, 2)
        vectors = torch.from_numpy(motion)
        height, width, _ = motion.shape

        @torch.inference_mode()
        def run():
            x = (vectors[..., 0] + torch.arange(width)) * (2 / (width - 1)) - 1
            y = (vectors[..., 1] + torch.arange(height)[:, None]) * (2 / (height - 1)) - 1
            grid = torch.stack((x, y), -1)[None]
            how = {"mode": mode, "padding_mode": "border", "align_corners": True}
            return torch.nn.functional.grid_sample(pixels, grid, **how)[0].permute(1, 2, 0).numpy()

        return run

    return make


# --- numba: plain loops over pixels, compiled by `_compiled`; `prange` is range in a sequential one. The casts keep
# the arithmetic in float32, as an integer beside a float32 would make it float64. ---

prange = range


@cache
def _compiled(loop, parallel: bool):
    import numba

    scope = dict(loop.__globals__, prange=numba.prange)
    copy = type(loop)(loop.__code__, scope, loop.__name__, loop.__defaults__)
    return numba.njit(copy, parallel=parallel)


def numba_loop(loop, *options, parallel: bool = True):
    """Compiles loop(*arguments, *options); parallel where the benchmark and the loop are."""
    return lambda all_cores, *arguments: lambda: _compiled(loop, all_cores and parallel)(*arguments, *options)


def warp_nearest(image, motion):
    height, width, _ = motion.shape
    channels = image.shape[2]
    result = np.empty((height, width, channels), np.float32)
    for row in prange(height):
        for column in range(width):
            x = min(max(math.floor(np.float32(column) + motion[row, column, 0] + np.float32(0.5)), 0), width - 1)
            y = min(max(math.floor(np.float32(row) + motion[row, column, 1] + np.float32(0.5)), 0), height - 1)
            for k in range(channels):
                result[row, column, k] = image[y, x, k]
    return result


def warp_bilinear(image, motion):
    height, width, _ = motion.shape
    channels = image.shape[2]
    result = np.empty((height, width, channels), np.float32)
    for row in prange(height):
        for column in range(width):
            x = min(max(np.float32(column) + motion[row, column, 0], np.float32(0)), np.float32(width - 1))
            y = min(max(np.float32(row) + motion[row, column, 1], np.float32(0)), np.float32(height - 1))
            i, j = min(int(x), width - 2), min(int(y), height - 2)
            t, u = x - np.float32(i), y - np.float32(j)
            i, j, one = np.uintp(i), np.uintp(j), np.uintp(1)  # spares a test for negative indices
            a, b = (np.float32(1) - t) * (np.float32(1) - u), t * (np.float32(1) - u)
            c, d = (np.float32(1) - t) * u, t * u
            for k in range(channels):
                result[row, column, k] = (
                    a * image[j, i, k]
                    + b * image[j, i + one, k]
                    + c * image[j + one, i, k]
                    + d * image[j + one, i + one, k]
                )
    return result


def warp_bicubic(image, motion):
    """Catmull-Rom; pixels beyond the border go on linearly, which is folded into the weights."""
    height, width, _ = motion.shape
    channels = image.shape[2]
    result = np.empty((height, width, channels), np.float32)
    for row in prange(height):
        weights = np.empty((2, 4), np.float32)
        for column in range(width):
            x = min(max(np.float32(column) + motion[row, column, 0], np.float32(0)), np.float32(width - 1))
            y = min(max(np.float32(row) + motion[row, column, 1], np.float32(0)), np.float32(height - 1))
            i, j = min(int(x), width - 2), min(int(y), height - 2)
            for axis in range(2):
                t = x - np.float32(i) if axis == 0 else y - np.float32(j)
                low, size = (i, width) if axis == 0 else (j, height)
                before = t * (np.float32(-0.5) + t * (np.float32(1) - np.float32(0.5) * t))
                at = np.float32(1) + t * t * (np.float32(1.5) * t - np.float32(2.5))
                after = t * (np.float32(0.5) + t * (np.float32(2) - np.float32(1.5) * t))
                beyond = t * t * (np.float32(0.5) * t - np.float32(0.5))
                if low == 0:
                    at, after, before = at + np.float32(2) * before, after - before, np.float32(0)
                if low == size - 2:
                    at, after, beyond = at - beyond, after + np.float32(2) * beyond, np.float32(0)
                weights[axis, 0], weights[axis, 1], weights[axis, 2], weights[axis, 3] = before, at, after, beyond
            for k in range(channels):
                result[row, column, k] = 0
            for m in range(4):
                from_row = min(max(j + m - 1, 0), height - 1)
                for n in range(4):
                    from_column = min(max(i + n - 1, 0), width - 1)
                    weight = weights[1, m] * weights[0, n]
                    for k in range(channels):
                        result[row, column, k] += weight * image[from_row, from_column, k]
    return result


def chain(newer, older):
    height, width, _ = newer.shape
    result = np.empty((height, width, 2), np.float32)
    for row in prange(height):
        for column in range(width):
            x = min(max(np.float32(column) + newer[row, column, 0], np.float32(0)), np.float32(width - 1))
            y = min(max(np.float32(row) + newer[row, column, 1], np.float32(0)), np.float32(height - 1))
            i, j = min(int(x), width - 2), min(int(y), height - 2)
            t, u = x - np.float32(i), y - np.float32(j)
            i, j, one = np.uintp(i), np.uintp(j), np.uintp(1)  # spares a test for negative indices
            a, b = (np.float32(1) - t) * (np.float32(1) - u), t * (np.float32(1) - u)
            c, d = (np.float32(1) - t) * u, t * u
            for k in range(2):
                above = a * older[j, i, k] + b * older[j, i + one, k]
                below = c * older[j + one, i, k] + d * older[j + one, i + one, k]
                result[row, column, k] = newer[row, column, k] + above + below
    return result


def search_nearest(flow, fraction, steps):
    """The fixed point of Yang et al. 2011, eq. 5, the flow by the nearest pixel; its place, and its error (eq. 7)."""
    height, width, _ = flow.shape
    place, error = np.empty((height, width, 2), np.float32), np.empty((height, width, 1), np.float32)
    half = np.float32(0.5)
    for y in prange(height):
        for x in range(width):
            px, py = np.float32(x), np.float32(y)
            qx, qy = px, py
            for _ in range(steps):
                i = min(max(math.floor(qx + half), 0), width - 1)
                j = min(max(math.floor(qy + half), 0), height - 1)
                qx, qy = px - fraction * flow[j, i, 0], py - fraction * flow[j, i, 1]
            i = min(max(math.floor(qx + half), 0), width - 1)
            j = min(max(math.floor(qy + half), 0), height - 1)
            ex, ey = qx + fraction * flow[j, i, 0] - px, qy + fraction * flow[j, i, 1] - py
            place[y, x, 0], place[y, x, 1] = qx, qy
            error[y, x, 0] = math.sqrt(ex * ex + ey * ey)
    return place, error


def search_bilinear(flow, fraction, steps):
    """As `search_nearest`, the flow interpolated, its edge repeated."""
    height, width, _ = flow.shape
    place, error = np.empty((height, width, 2), np.float32), np.empty((height, width, 1), np.float32)
    one = np.float32(1)
    for y in prange(height):
        for x in range(width):
            px, py = np.float32(x), np.float32(y)
            qx, qy, u, v = px, py, np.float32(0), np.float32(0)
            for k in range(steps + 1):
                cx = min(max(qx, np.float32(0)), np.float32(width - 1))
                cy = min(max(qy, np.float32(0)), np.float32(height - 1))
                i, j = min(int(cx), width - 2), min(int(cy), height - 2)
                s, t = cx - np.float32(i), cy - np.float32(j)
                u = (flow[j, i, 0] * (one - s) + flow[j, i + 1, 0] * s) * (one - t)
                u += (flow[j + 1, i, 0] * (one - s) + flow[j + 1, i + 1, 0] * s) * t
                v = (flow[j, i, 1] * (one - s) + flow[j, i + 1, 1] * s) * (one - t)
                v += (flow[j + 1, i, 1] * (one - s) + flow[j + 1, i + 1, 1] * s) * t
                if k < steps:
                    qx, qy = px - fraction * u, py - fraction * v
            ex, ey = qx + fraction * u - px, qy + fraction * v - py
            place[y, x, 0], place[y, x, 1] = qx, qy
            error[y, x, 0] = math.sqrt(ex * ex + ey * ey)
    return place, error


def splat_nearest(values, motion, depth):
    """Each value to the four pixel centres around its landing place; a depth buffer decides."""
    height, width, channels = values.shape
    buffer = np.full((height, width), np.inf, np.float32)
    result = np.zeros((height, width, channels), np.float32)
    covered = np.zeros((height, width), np.bool_)
    for row in range(height):
        for column in range(width):
            left = math.floor(np.float32(column) + motion[row, column, 0])
            top = math.floor(np.float32(row) + motion[row, column, 1])
            nearness = depth[row, column, 0]
            for y in range(max(top, 0), min(top + 2, height)):
                for x in range(max(left, 0), min(left + 2, width)):
                    if nearness < buffer[y, x]:
                        buffer[y, x] = nearness
                        covered[y, x] = True
                        for k in range(channels):
                            result[y, x, k] = values[row, column, k]
    return result, covered


def occlusion_motion(motion, depth):
    height, width, _ = motion.shape
    buffer = np.full((height, width), np.inf, np.float32)
    splatted = np.zeros((height, width, 2), np.float32)
    for row in range(height):
        for column in range(width):
            left = math.floor(np.float32(column) + motion[row, column, 0])
            top = math.floor(np.float32(row) + motion[row, column, 1])
            nearness = depth[row, column, 0]
            for y in range(max(top, 0), min(top + 2, height)):
                for x in range(max(left, 0), min(left + 2, width)):
                    if nearness < buffer[y, x]:
                        buffer[y, x] = nearness
                        splatted[y, x, 0] = motion[row, column, 0]
                        splatted[y, x, 1] = motion[row, column, 1]
    result = np.empty((height, width, 2), np.float32)
    for row in range(height):
        for column in range(width):
            x = min(max(math.floor(np.float32(column) + motion[row, column, 0]), 0), width - 1)
            y = min(max(math.floor(np.float32(row) + motion[row, column, 1]), 0), height - 1)
            result[row, column, 0] = splatted[y, x, 0]
            result[row, column, 1] = splatted[y, x, 1]
    return result


def splat_softmax(values, motion, weights, guarded):
    """Softmax splatting; `guarded` takes the exponentials relative to the largest exponent at each target."""
    height, width, channels = values.shape
    largest = np.full((height, width), -np.inf, np.float32)
    if guarded:
        for row in range(height):
            for column in range(width):
                px = np.float32(column) + motion[row, column, 0]
                py = np.float32(row) + motion[row, column, 1]
                left, top = math.floor(px), math.floor(py)
                for y in range(max(top, 0), min(top + 2, height)):
                    for x in range(max(left, 0), min(left + 2, width)):
                        share = (np.float32(1) - abs(px - np.float32(x))) * (np.float32(1) - abs(py - np.float32(y)))
                        if share > 0:
                            largest[y, x] = max(largest[y, x], weights[row, column, 0])
    total = np.zeros((height, width), np.float32)
    result = np.zeros((height, width, channels), np.float32)
    for row in range(height):
        for column in range(width):
            px = np.float32(column) + motion[row, column, 0]
            py = np.float32(row) + motion[row, column, 1]
            left, top = math.floor(px), math.floor(py)
            z = weights[row, column, 0]
            importance = np.float32(0) if guarded else math.exp(z)
            for y in range(max(top, 0), min(top + 2, height)):
                for x in range(max(left, 0), min(left + 2, width)):
                    share = (np.float32(1) - abs(px - np.float32(x))) * (np.float32(1) - abs(py - np.float32(y)))
                    if share > 0:
                        if guarded:
                            importance = math.exp(z - largest[y, x])
                        weight = share * importance
                        total[y, x] += weight
                        for k in range(channels):
                            result[y, x, k] += weight * values[row, column, k]
    for row in range(height):
        for column in range(width):
            if total[row, column] > 0:
                over = np.float32(1) / total[row, column]
                for k in range(channels):
                    result[row, column, k] *= over
    return result


def guided_taps(strides):
    """The offsets (row, column) of all kernels, int64 `[N, 2]`; the centre first, and once."""
    around = [(k, l) for k in (-1, 0, 1) for l in (-1, 0, 1) if (k, l) != (0, 0)]
    return np.array([(0, 0)] + [(stride * k, stride * l) for stride in strides for k, l in around])


def guided_warp(image, motion, target_guide, source_guide, sigma_guide, sigma_space, taps):
    """The four best of the taps; a tap is given up as soon as its cost exceeds that of the fourth best."""
    height, width, channels = image.shape
    guides = target_guide.shape[2]
    guide_factor = np.float32(0.5 / sigma_guide**2)
    space_factor = np.float32(0.5 / sigma_space**2)
    result = np.empty((height, width, channels), np.float32)
    for row in prange(height):
        costs = np.empty(4, np.float32)
        from_row = np.empty(4, np.int32)
        from_column = np.empty(4, np.int32)
        for column in range(width):
            x, y = np.float32(column) + motion[row, column, 0], np.float32(row) + motion[row, column, 1]
            i, j = math.floor(x + np.float32(0.5)), math.floor(y + np.float32(0.5))
            count = 0
            for number in range(len(taps)):
                tap_row, tap_column = j + taps[number, 0], i + taps[number, 1]
                if tap_row < 0 or tap_row >= height or tap_column < 0 or tap_column >= width:
                    continue
                dx, dy = x - np.float32(tap_column), y - np.float32(tap_row)
                cost = space_factor * (dx * dx + dy * dy)
                limit = costs[3] if count == 4 else np.float32(3e38)
                k = 0
                while k < guides and cost < limit:
                    apart = target_guide[row, column, k] - source_guide[tap_row, tap_column, k]
                    cost += guide_factor * apart * apart
                    k += 1
                if cost >= limit:
                    continue
                slot = count if count < 4 else 3
                while slot > 0 and costs[slot - 1] > cost:
                    costs[slot] = costs[slot - 1]
                    from_row[slot] = from_row[slot - 1]
                    from_column[slot] = from_column[slot - 1]
                    slot -= 1
                costs[slot], from_row[slot], from_column[slot] = cost, tap_row, tap_column
                count = min(count + 1, 4)
            if count == 0:
                count = 1
                costs[0] = 0
                from_row[0], from_column[0] = min(max(j, 0), height - 1), min(max(i, 0), width - 1)
            total = np.float32(0)
            for k in range(channels):
                result[row, column, k] = 0
            for slot in range(count):
                weight = math.exp(costs[0] - costs[slot])
                total += weight
                for k in range(channels):
                    result[row, column, k] += weight * image[from_row[slot], from_column[slot], k]
            over = np.float32(1) / total
            for k in range(channels):
                result[row, column, k] *= over
    return result
