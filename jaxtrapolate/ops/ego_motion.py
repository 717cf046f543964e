"""The camera's own motion, found from depth and motion vectors, and which objects move as it does.

A point of a static scene at pixel (x, y) and depth z is seen by a pinhole camera that moved at a position that is
linear in homogeneous coordinates: (u, v, w) = M (x, y, 1, 1 / z), at (u / w, v / w), whatever the focal lengths of both
cameras (M is K' [R K^-1 | t] up to scale). So the motion of all that is static follows from one matrix of 3 x 4, which
is fitted to points by the direct linear transform (Hartley & Zisserman, Multiple View Geometry, section 4.1), and to
those of one motion among several by random samples (Fischler & Bolles 1981). Computed in float64 on the host.
"""

import numpy as np

_SAMPLES = 400  # random samples
_SHARE = 0.15  # of the points have to fit
_NEAR = 0.1  # pixels: fits
_POINTS = 4000


def features(depth: np.ndarray) -> np.ndarray:
    """(x, y, 1, 1 / z) of every pixel, `[H, W, 4]`; x and y about -1..1; depth `[H, W, 1]`, +inf allowed."""
    height, width = depth.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float64)
    scale = _scale(height, width)
    along = depth[..., 0].astype(np.float64)
    inverse = np.divide(1, along, out=np.zeros_like(along), where=np.isfinite(along) & (along > 0))
    inverse /= max(inverse.max(), 1e-300)
    return np.stack([(x - width / 2) / scale, (y - height / 2) / scale, np.ones_like(x), inverse], -1)


def _scale(height: int, width: int) -> float:
    return max(height, width) / 2


def _targets(points: np.ndarray, motion: np.ndarray, scale: float) -> np.ndarray:
    return points[:, :2] + motion / scale


def _fit(points: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """The matrix `[3, 4]` of least algebraic error of points `[N, 4]` and their targets `[N, 2]`."""
    zero = np.zeros_like(points)
    rows = [
        np.concatenate([points, zero, -targets[:, :1] * points], 1),
        np.concatenate([zero, points, -targets[:, 1:] * points], 1),
    ]
    system = np.concatenate(rows)
    return np.linalg.eigh(system.T @ system)[1][:, 0].reshape(3, 4)


def _errors(matrix: np.ndarray, points: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """How far from its target the matrix takes each point; infinite where it takes it behind the camera."""
    u, v, w = matrix @ points.T
    sign = np.sign(np.median(w)) or 1.0
    ahead = w * sign > 1e-12
    w = np.where(ahead, w, 1)
    return np.where(ahead, np.hypot(u / w - targets[:, 0], v / w - targets[:, 1]), np.inf)


def camera_matrix(
    depth: np.ndarray, motion: np.ndarray, candidates: np.ndarray, *, seed: int = 0
) -> tuple[np.ndarray, float] | None:
    """The motion of the camera, as the one that most of the candidates have in common.

    Args:
        depth: `[H, W, 1]`, along the view axis; +inf where nothing is.
        motion: `[H, W, 2]`, in pixels; NaN where there is none.
        candidates: bool `[H, W]`: the pixels to look at; those known to be static, or all.
        seed: of the random samples.

    Returns:
        The matrix `[3, 4]` for `features`, and the share of the candidates that it takes to within 0.1 pixels of where
        they go; `None` where no motion is common to 15 % of them, or there are fewer than 100.
    """
    rng = np.random.default_rng(seed)
    (places,) = np.nonzero((candidates & np.isfinite(motion).all(-1)).ravel())
    if len(places) < 100:
        return None
    places = rng.permutation(places)[:_POINTS]
    points = features(depth).reshape(-1, 4)[places]
    scale = _scale(*motion.shape[:2])
    targets = _targets(points, motion.reshape(-1, 2)[places].astype(np.float64), scale)
    best, most = np.zeros(len(points), bool), 0
    for _ in range(_SAMPLES):
        chosen = rng.choice(len(points), 8, replace=False)
        near = _errors(_fit(points[chosen], targets[chosen]), points, targets) * scale < 3 * _NEAR
        if near.sum() > most:
            best, most = near, int(near.sum())
        if most > 0.9 * len(points):
            break
    if most < 100 or most < _SHARE * len(points):
        return None
    for _ in range(3):
        matrix = _fit(points[best], targets[best])
        best = _errors(matrix, points, targets) * scale < _NEAR
        if best.sum() < 8:
            return None
    share = float(best.mean())
    return (matrix, share) if share >= _SHARE else None


def off_camera(matrix: np.ndarray, depth: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """How many pixels each pixel's motion is off that of a static point there, `[H, W]`; NaN where it has none."""
    scale = _scale(*motion.shape[:2])
    points = features(depth).reshape(-1, 4)
    targets = _targets(points, motion.reshape(-1, 2).astype(np.float64), scale)
    return (_errors(matrix, points, targets) * scale).reshape(motion.shape[:2])


def static_ids(stencil: np.ndarray, off: np.ndarray, *, least: int = 16) -> dict[int, bool]:
    """Of each id above 0 that covers enough pixels, whether it moves as a static object would.

    Args:
        stencil: `[H, W, 1]`.
        off: of `off_camera`.
        least: pixels that have motion.

    Returns:
        True where the median of its pixels is off by less than 0.1 pixels and nine of ten by less than 0.5.
    """
    ids, finite = stencil[..., 0], np.isfinite(off)
    out = {}
    for number in np.unique(ids[(ids > 0) & finite]):
        values = off[(ids == number) & finite]
        if len(values) >= least:
            median, most = np.quantile(values, (0.5, 0.9))
            out[int(number)] = bool(median < _NEAR and most < 5 * _NEAR)
    return out
