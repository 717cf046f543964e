"""Temporal stability: against loops over pixels, on clips whose answer is known."""

import numpy as np
import oracles
import pytest
from oracles import random

from jaxtrapolate import metrics
from jaxtrapolate.metrics.temporal import flicker, warped_difference

SIZE = (6, 7)


def clip(count, seed=0):
    return random(count, *SIZE, 3, seed=seed)


def test_flicker_against_a_loop():
    reference = np.repeat(clip(1), 4, 0)
    reference[2:, :3] += 0.1  # what changes does not stand still
    frames = clip(4, seed=1)
    frames[1, 5, 5] = np.nan
    found = flicker(frames, reference)
    for k in range(3):
        errors = []
        for r, c in np.ndindex(SIZE):
            true, change = (
                np.float64(reference[k + 1, r, c]) - reference[k, r, c],
                frames[k + 1, r, c] - frames[k, r, c],
            )
            if np.abs(true).max() <= 1.5 / 255 and np.isfinite(change).all():
                errors.append(np.abs(change - true))
        np.testing.assert_allclose(found.frames[k], np.mean(errors), rtol=1e-5)
    np.testing.assert_allclose(found.mean, found.frames.mean(), rtol=1e-6)


def test_flicker_of_what_is_right_and_of_what_is_wrong_but_steady():
    reference = np.repeat(clip(1), 3, 0)
    assert flicker(reference, reference).mean == 0
    assert flicker(reference * 0.5, reference).mean == 0
    blinking = reference.copy()
    blinking[1] += 0.25
    np.testing.assert_allclose(flicker(blinking, reference).frames, [0.25, 0.25], rtol=1e-5)


def test_bytes_are_display_values():
    codes = (clip(3) * 255).astype(np.uint8)
    reference = np.repeat(codes[:1], 3, 0)
    shown = flicker(codes.astype(np.float32) / 255, reference.astype(np.float32) / 255)
    np.testing.assert_allclose(flicker(iter(codes), list(reference)).frames, shown.frames, rtol=1e-6)


def test_a_clip_in_which_all_moves_has_no_flicker():
    found = flicker(clip(3), np.stack([np.full((*SIZE, 3), v, np.float32) for v in (0.1, 0.3, 0.5)]))
    assert np.isnan(found.mean)
    assert np.isnan(found.frames).all()


def test_warped_difference_against_the_oracle():
    frames = clip(3)
    motions = [oracles.random_motion(*SIZE, seed=k) for k in (1, 2)]
    masks = [random(*SIZE, 1, seed=k) > 0.3 for k in (5, 6)]
    for given in (None, masks):
        found = warped_difference(frames, motions, given)
        for k, motion in enumerate(motions):
            where = oracles.in_frame(motion) & (True if given is None else given[k][..., 0])
            error = np.abs(np.float64(frames[k + 1]) - oracles.backward_warp(frames[k], motion))
            np.testing.assert_allclose(found.frames[k], error[where].mean(), rtol=1e-4)


def test_what_moves_as_its_motion_says_does_not_differ():
    image = random(6, 12, 3)
    frames = [image[:, k : k + 7] for k in (0, 2, 4)]  # moves two pixels to the left
    motion = np.broadcast_to(np.float32([2, 0]), (*SIZE, 2))
    assert warped_difference(frames, [motion, motion]).mean < 1e-7
    assert warped_difference(frames, [0 * motion, 0 * motion]).mean > 0.1


def test_by_name():
    metric = metrics.load("flicker")
    reference = np.repeat(clip(1), 3, 0)
    assert (metric.per, metric.better, metric.space) == ("clip", "lower", "display")
    assert metric(clip(3, seed=1), reference) == flicker(clip(3, seed=1), reference).mean


def test_errors(unchecked):
    frames = clip(2)
    with pytest.raises(ValueError, match="frames: expected at least two frames"):
        flicker(frames[:1], frames[:1])
    with pytest.raises(ValueError, match="frames: expected as many as in the reference"):
        flicker(frames, clip(3))
    with pytest.raises(ValueError, match=r"frames: expected shape \[6, 7, 3\], as the reference, got \[5, 7, 3\]"):
        flicker(frames[:, :5], frames)
    with pytest.raises(ValueError, match="motions: expected a motion"):
        warped_difference(frames, [])
    with pytest.raises(ValueError, match=r"motions: expected shape \[6, 7, 2\], got \[6, 7, 3\]"):
        warped_difference(frames, [frames[0]])
