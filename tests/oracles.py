"""Reference results: float64 NumPy loops written from the docstrings and papers, one pixel after the other, and inputs.

Nothing here imports the library. Speed does not matter, likeness to the formula does.
"""

import itertools

import numpy as np

SIZES = [(5, 7), (1, 6), (6, 1), (1, 1), (2, 2)]
"""Heights and widths: not square, one pixel high, wide, both, and the smallest with a cell."""


def random(*shape, seed=0, low=0.0, high=1.0, dtype=np.float32):
    return np.random.default_rng(seed).uniform(low, high, shape).astype(dtype)


def random_motion(height, width, *, seed=1, amount=2, kinks=False, dtype=np.float32):
    """Whole pixels up to `amount` and, unless `kinks`, a fraction in 0.2..0.8: away from where derivatives jump."""
    rng = np.random.default_rng(seed)
    whole = rng.integers(-amount, amount + 1, (height, width, 2))
    fraction = 0 if kinks else rng.uniform(0.2, 0.8, (height, width, 2))
    return (whole + fraction).astype(dtype)


def inner_motion(height, width, *, seed=2, margin=0.2, dtype=np.float32):
    """Random motion to places within the outermost pixel centres, away from kinks; a frame of one pixel stays."""
    rng = np.random.default_rng(seed)
    out = np.zeros((height, width, 2))
    for axis, size in ((0, width), (1, height)):
        if size > 1:
            place = rng.integers(0, size - 1, (height, width)) + rng.uniform(margin, 1 - margin, (height, width))
            out[..., axis] = place - (np.arange(width)[None, :] if axis == 0 else np.arange(height)[:, None])
    return out.astype(dtype)


def places(motion):
    """(row, column, x, y, finite) of every pixel's landing place; where the motion is not finite that is the pixel."""
    for r, c in np.ndindex(motion.shape[:2]):
        mx, my = np.float64(motion[r, c, 0]), np.float64(motion[r, c, 1])
        finite = bool(np.isfinite(mx) and np.isfinite(my))
        yield (r, c, c + mx, r + my, True) if finite else (r, c, float(c), float(r), False)


def in_frame(motion):
    height, width, _ = motion.shape
    out = np.zeros((height, width), bool)
    for r, c, x, y, finite in places(motion):
        out[r, c] = finite and -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5
    return out


def keys(t):
    """The cubic convolution kernel of Keys 1981 with a = -1/2, at distance t."""
    t = abs(t)
    if t < 1:
        return 1.5 * t**3 - 2.5 * t**2 + 1
    return -0.5 * t**3 + 2.5 * t**2 - 4 * t + 2 if t < 2 else 0.0


def line(values, index):
    """values[index]; beyond the ends the sequence goes on linearly."""
    last = len(values) - 1
    if index < 0:
        return values[0] + (values[0] - values[min(1, last)]) * -index
    if index > last:
        return values[last] + (values[last] - values[max(last - 1, 0)]) * (index - last)
    return values[index]


def sample(image, x, y, filter="bilinear"):
    """The float64 image at one place, held to the pixel centres' range; a tap counts only if it has weight."""
    height, width, channels = image.shape
    x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
    if filter == "nearest":
        return image[min(int(np.floor(y + 0.5)), height - 1), min(int(np.floor(x + 0.5)), width - 1)]
    left, top = int(np.floor(x)), int(np.floor(y))
    if filter == "bicubic":
        columns = [sum(keys(x - i) * line(row, i) for i in range(left - 1, left + 3)) for row in image]
        return sum(keys(y - j) * line(columns, j) for j in range(top - 1, top + 3))
    total = np.zeros(channels)
    for j, i in itertools.product((top, top + 1), (left, left + 1)):
        weight = (1 - abs(x - i)) * (1 - abs(y - j))
        if weight > 0:
            total += weight * image[j, i]
    return total


def backward_warp(image, motion, filter="bilinear", outside="edge"):
    image = np.asarray(image, np.float64)
    height, width, channels = image.shape
    out = np.zeros((*motion.shape[:2], channels))
    for r, c, x, y, finite in places(motion):
        seen = finite and -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5
        if outside == "edge" or seen:
            out[r, c] = sample(image, x, y, filter)
        else:
            out[r, c] = 0.0 if outside == "zero" else outside
    return out


def shift(image, dx, dy, fill=None):
    """out[p] = image[p + (dx, dy)] for whole pixels, the edge repeated unless there is a value to `fill`."""
    height, width, _ = image.shape
    out = np.empty_like(image)
    for r, c in np.ndindex(height, width):
        j, i = r + dy, c + dx
        if (0 <= j < height and 0 <= i < width) or fill is None:
            out[r, c] = image[min(max(j, 0), height - 1), min(max(i, 0), width - 1)]
        else:
            out[r, c] = fill
    return out


def far(depth):
    """Nothing, which is where a depth is not positive, at infinity."""
    return np.where(depth <= 0, np.inf, depth)


def splat_nearest(values, motion, depth, footprint=4):
    height, width, _ = values.shape
    depth = far(depth)
    out, covered = np.zeros_like(values), np.zeros((height, width), bool)
    nearest = np.full((height, width), np.inf)
    for r, c, x, y, finite in places(motion):
        z = depth[r, c, 0]
        if not finite or np.isnan(z):
            continue
        if footprint == 4:
            landed = itertools.product((np.floor(y), np.floor(y) + 1), (np.floor(x), np.floor(x) + 1))
        else:
            landed = [(np.floor(y + 0.5), np.floor(x + 0.5))]
        for j, i in landed:
            if 0 <= j < height and 0 <= i < width:
                j, i = int(j), int(i)
                if not covered[j, i] or z < nearest[j, i]:
                    out[j, i], nearest[j, i], covered[j, i] = values[r, c], z, True
    return out, covered


def splat(values, motion, weights=None, mode="average"):
    """Every source against every target, the bilinear share from their distance."""
    values = np.asarray(values, np.float64)
    height, width, channels = values.shape
    sources = list(places(motion))
    out = np.zeros(values.shape)
    for r, c in np.ndindex(height, width):
        total, weight, parts = np.zeros(channels), 0.0, []
        for j, i, x, y, finite in sources:
            z = 0.0 if weights is None else float(weights[j, i, 0])
            share = max(0.0, 1 - abs(x - c)) * max(0.0, 1 - abs(y - r))
            if finite and np.isfinite(z) and share > 0:
                parts.append((share, z, values[j, i]))
        largest = max((z for _, z, _ in parts), default=0.0)
        for share, z, value in parts:
            factor = {"sum": 1.0, "average": 1.0, "linear": z, "softmax": np.exp(z - largest)}[mode]
            weight += share * factor
            if share * factor != 0:
                total += share * factor * value
        if mode == "sum":
            out[r, c] = total
        elif weight > 0:
            out[r, c] = total / weight
    return out


def chain_motion(newer, older):
    return np.asarray(newer, np.float64) + backward_warp(older, newer)


def project(view, projection, point, height, width):
    """Pixel position of one homogeneous world point, None behind the camera."""
    clip = np.float64(projection) @ np.float64(view) @ point
    if not clip[3] > 0:
        return None
    x, y = clip[:2] / clip[3]
    return np.array([(x + 1) / 2 * width - 0.5, (1 - y) / 2 * height - 0.5])


def camera_motion(position, camera, previous, object_motion=None, stencil=None):
    """`camera` and `previous` are pairs (view, projection)."""
    height, width, _ = position.shape
    out = np.full((height, width, 2), np.nan)
    for r, c in np.ndindex(height, width):
        point = np.append(np.float64(position[r, c]), 1.0)
        if not np.isfinite(point).all():
            continue
        before = point
        if stencil is not None and 0 <= round(float(stencil[r, c, 0])) < len(object_motion):
            before = np.float64(object_motion[round(float(stencil[r, c, 0]))]) @ point
        here, there = project(*camera, point, height, width), project(*previous, before, height, width)
        if here is not None and there is not None:
            out[r, c] = there - here
    return out


def perspective(height, width, focal=1.2, near=0.1, far=100.0):
    """An OpenGL projection whose focal length is in half heights."""
    a, b = (far + near) / (near - far), 2 * far * near / (near - far)
    return np.array([[focal * height / width, 0, 0, 0], [0, focal, 0, 0], [0, 0, a, b], [0, 0, -1, 0]], np.float64)


def look(angle=0.0, eye=(0.0, 0.0, 0.0)):
    """World to camera: at `eye`, turned about the vertical axis."""
    c, s = np.cos(angle), np.sin(angle)
    view = np.eye(4)
    view[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    view[:3, 3] = -view[:3, :3] @ np.asarray(eye)
    return view


def occlusion_motion(motion, depth):
    height, width, _ = motion.shape
    splatted, _ = splat_nearest(motion, motion, depth)
    out = np.zeros_like(motion)
    for r, c, x, y, _ in places(motion):
        out[r, c] = splatted[int(np.clip(np.floor(y), 0, height - 1)), int(np.clip(np.floor(x), 0, width - 1))]
    return out


def dilate_motion(motion, depth, offsets):
    height, width, _ = motion.shape
    out, depth = motion.copy(), far(depth)
    for r, c in np.ndindex(height, width):
        nearest = np.inf if np.isnan(depth[r, c, 0]) else depth[r, c, 0]
        for j, i in offsets:
            if 0 <= r + j < height and 0 <= c + i < width and depth[r + j, c + i, 0] < nearest:
                nearest, out[r, c] = depth[r + j, c + i, 0], motion[r + j, c + i]
    return out


def guided_offsets(strides):
    out = [(0, 0)]
    for s in strides:
        out += [(s * j, s * i) for j in (-1, 0, 1) for i in (-1, 0, 1) if (j, i) != (0, 0)]
    return out


def guided_warp(image, motion, target, source, strides=(1, 3, 5, 9), sigma_guide=0.03, sigma_space=0.5, keep=4):
    """The result, and by how much the last kept cost differs from the first that is not, relative to it."""
    image, target, source = (np.asarray(a, np.float64) for a in (image, target, source))
    height, width, _ = image.shape
    out, gap = np.zeros(image.shape), np.full((height, width), np.inf)
    for r, c, x, y, _ in places(motion):
        column, row = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
        taps = []
        for number, (j, i) in enumerate(guided_offsets(strides)):
            a, b = row + j, column + i
            if 0 <= a < height and 0 <= b < width and np.isfinite(source[a, b]).all():
                cost = ((target[r, c] - source[a, b]) ** 2).sum() / (2 * sigma_guide**2)
                cost += ((x - b) ** 2 + (y - a) ** 2) / (2 * sigma_space**2)
                if np.isfinite(cost):
                    taps.append((cost, number, image[a, b]))
        taps.sort(key=lambda tap: tap[:2])
        kept = taps[:keep]
        if not kept:
            out[r, c] = image[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
            continue
        if len(taps) > keep:
            gap[r, c] = (taps[keep][0] - taps[keep - 1][0]) / max(taps[keep][0], 1e-300)
        weights = [np.exp(kept[0][0] - cost) for cost, _, _ in kept]
        out[r, c] = sum(w * v for w, (_, _, v) in zip(weights, kept, strict=True)) / sum(weights)
    return out, gap


def assert_gradients(function, arguments, gradients, *, step=1e-6, rtol=1e-5, atol=1e-7, directions=3, seed=7):
    """The gradients of a scalar NumPy function, against its central differences along random directions."""
    rng = np.random.default_rng(seed)
    for k, (argument, gradient) in enumerate(zip(arguments, gradients, strict=True)):
        assert np.shape(gradient) == np.shape(argument)
        for _ in range(directions):
            along = rng.uniform(-1, 1, np.shape(argument))
            up, down = list(arguments), list(arguments)
            up[k], down[k] = argument + step * along, argument - step * along
            expected = (function(*up) - function(*down)) / (2 * step)
            np.testing.assert_allclose(np.sum(gradient * along), expected, rtol, atol, err_msg=f"argument {k}")
