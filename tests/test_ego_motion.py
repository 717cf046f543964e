"""The camera's motion from depth and motion vectors, against exact projections of points and the ray-cast scenes."""

import numpy as np
import pytest
from synthetic import static_scene as scene

from jaxtrapolate.ops.ego_motion import camera_matrix, off_camera, static_ids

SIZE = (48, 64)


@pytest.mark.parametrize("camera", [{}, {"turn": 0.0}, {"shift": (0, 0, 0)}, {"zoom": 1.05}])
def test_everything_static_fits(camera):
    depth, motion, ids = scene(**camera)
    matrix, share = camera_matrix(depth, motion, np.ones(SIZE, bool))
    assert share == 1
    assert off_camera(matrix, depth, motion).max() < 1e-6
    assert static_ids(ids, off_camera(matrix, depth, motion)) == dict.fromkeys(range(1, 13), True)


def test_objects_that_move_are_told_apart_without_knowing_which():
    """Five of twelve blocks, 42 % of the pixels, move in three ways of their own; every block has an id."""
    depth, motion, ids = scene()
    own = {2: (1.0, 0.3), 3: (1.0, 0.3), 7: (-0.6, 0.6), 8: (0.0, 4.0), 12: (0.0, 4.0)}
    for number, by in own.items():
        motion = motion + np.where(ids == number, by, 0)
    motion += np.random.default_rng(1).normal(scale=0.01, size=motion.shape)
    found = camera_matrix(depth, motion.astype(np.float32), np.ones(SIZE, bool))
    assert found is not None
    assert found[1] == pytest.approx(7 / 12, abs=0.05)
    fits = static_ids(ids, off_camera(found[0], depth, motion))
    assert {number for number, fit in fits.items() if not fit} == set(own)


def test_pixels_without_depth_or_motion():
    """Infinitely far, motion is the rotation's alone; where there is no vector nothing is said."""
    depth, motion, ids = scene()
    far, turned, _ = scene(shift=(0, 0, 0))
    sky = ids == 1
    depth, motion = np.where(sky, np.inf, depth), np.where(sky, turned, motion)
    assert far.shape == depth.shape
    motion[40:] = np.nan
    matrix, share = camera_matrix(depth, motion, np.ones(SIZE, bool))
    assert share == 1
    off = off_camera(matrix, depth, motion)
    assert np.isnan(off[40:]).all()
    assert np.nanmax(off) < 1e-6


def test_what_cannot_be_told():
    depth, motion, ids = scene()
    assert camera_matrix(depth, motion, np.zeros(SIZE, bool)) is None
    noise = np.random.default_rng(0).uniform(-9, 9, motion.shape)
    assert camera_matrix(depth, noise, np.ones(SIZE, bool)) is None
    off = np.full(SIZE, np.nan)
    off[:1, :15] = 0
    assert static_ids(ids, off) == {}


@pytest.mark.parametrize("name", ["czest1dm", "torcs"])
def test_real_dumps(data, name):
    """All pixels are candidates; three characters, and three cars, move on their own."""
    from jaxtrapolate.files import open_sequence

    frame = open_sequence(data / name).frame(6)
    buffers = frame.gbuffer
    matrix, share = camera_matrix(buffers.depth, frame.motion, np.isfinite(buffers.depth[..., 0]))
    static = buffers.stencil[..., 0] == 0
    assert share > 0.85
    off = off_camera(matrix, buffers.depth, frame.motion)
    assert np.median(off[static]) < 0.01
    assert static_ids(buffers.stencil, off) == {1: False, 2: False, 3: False}
