"""Non-finite pixels become holes; what is legitimate at the sky stays valid."""

import numpy as np
import pytest

from jaxtrapolate.errors import InputError
from jaxtrapolate.files.convention import convert, unconvert
from jaxtrapolate.files.repair import LOST, fill_nearest, no_depth, repair
from jaxtrapolate.files.sequence import MotionConvention
from jaxtrapolate.ops.motion import convert_motion


def test_finite_buffers_are_left_alone():
    buffers = {"color": np.ones((2, 3, 3), np.float32), "motion": np.zeros((2, 3, 2), np.float32)}
    out, invalid = repair(buffers)
    assert invalid is None
    assert all(out[name] is buffers[name] for name in buffers)
    assert repair({}) == ({}, None)


def test_fill_nearest_against_a_loop():
    rng = np.random.default_rng(0)
    image = rng.normal(size=(9, 6, 2)).astype(np.float32)
    bad = rng.random((9, 6)) < 0.6
    filled = fill_nearest(image, bad)
    good = np.argwhere(~bad)
    for y, x in np.ndindex(9, 6):
        distance = ((good - (y, x)) ** 2).sum(axis=1)
        nearest = good[distance == distance.min()]
        assert any((filled[y, x] == image[a, b]).all() for a, b in nearest)
    np.testing.assert_array_equal(fill_nearest(image, np.ones((9, 6), bool)), np.zeros_like(image))


def test_invalid_pixel_becomes_a_hole():
    shape = (4, 5)
    color = np.arange(60, dtype=np.float32).reshape(*shape, 3)
    buffers = {
        "color": color.copy(),
        "motion": np.zeros((*shape, 2), np.float32),
        "depth": np.full((*shape, 1), 7, np.float32),
        "normal": np.full((*shape, 3), 0.5, np.float32),
        "position": np.ones((*shape, 3), np.float32),
    }
    buffers["color"][1, 2, 1] = np.nan
    buffers["depth"][3, 4] = -np.inf
    out, invalid = repair(buffers)
    assert invalid is not None
    np.testing.assert_array_equal(np.argwhere(invalid), [[1, 2], [3, 4]])
    assert np.isnan(out["motion"][invalid]).all()
    assert (out["position"][invalid] == LOST).all()
    assert (out["normal"][invalid] == 0).all()
    assert (out["depth"] == 7).all()
    assert any((out["color"][1, 2] == color[y, x]).all() for y, x in ((0, 2), (2, 2), (1, 1), (1, 3)))
    np.testing.assert_array_equal(out["color"][3, 4], color[3, 4])
    valid = ~invalid
    assert np.isfinite(out["motion"][valid]).all()
    assert (out["position"][valid] == 1).all()


def column(*values):
    return np.array(values, np.float32).reshape(1, -1, 1)


@pytest.mark.parametrize("empty", [np.inf, 0.0, -0.0, -1.0, -1e30])
def test_where_nothing_was_hit_depth_is_infinite(empty):
    depth, position = column(5, empty), np.array([[[1, 2, 3], [np.nan, np.inf, 4]]], np.float32)
    out, invalid = repair({"depth": depth, "position": position})
    assert invalid is None
    np.testing.assert_array_equal(out["depth"], column(5, np.inf))
    np.testing.assert_array_equal(out["sky"], column(0, 1))
    np.testing.assert_array_equal(out["position"], [[[1, 2, 3], [0, 0, 4]]])
    assert no_depth({"depth": depth}) == {"infinite" if empty > 0 else "not positive": 1}


def test_depth_under_the_sky_mask_is_infinite():
    depth, sky = column(5, 1e7, 3, np.nan, -1), column(0, 1, 0.51, 1, 0)
    out, invalid = repair({"depth": depth, "sky": sky})
    assert invalid is None
    assert out["sky"] is sky
    np.testing.assert_array_equal(out["depth"], column(5, *[np.inf] * 4))
    assert no_depth({"depth": depth, "sky": sky}) == {"not positive": 1, "under the sky mask": 3}


def test_nothing_needs_no_normal():
    depth, sky = column(np.inf, np.inf, 2), column(1, 0, 0)
    normal = np.full((1, 3, 3), np.nan, np.float32)
    out, invalid = repair({"depth": depth, "sky": sky, "normal": normal})
    assert invalid is not None
    np.testing.assert_array_equal(invalid, [[False, False, True]])
    np.testing.assert_array_equal(out["normal"], np.zeros((1, 3, 3)))


def test_the_mask_follows_in_every_frame_or_in_none():
    depth = column(1, 2)
    np.testing.assert_array_equal(repair({"depth": depth})[0]["sky"], column(0, 0))
    assert "sky" not in repair({"depth": depth}, sky=False)[0]
    assert "sky" not in repair({"motion": np.zeros((1, 2, 2), np.float32)})[0]


def test_depth_that_is_nowhere_known_is_far():
    out, invalid = repair({"depth": column(np.nan, -np.inf)})
    assert invalid is not None
    assert invalid.all()
    np.testing.assert_array_equal(out["depth"], column(np.inf, np.inf))


@pytest.mark.parametrize("sign", ["previous_minus_current", "current_minus_previous"])
@pytest.mark.parametrize("units, span", [("pixels", (1, 1)), ("uv", (7, 4)), ("ndc", (3.5, 2))])
@pytest.mark.parametrize("y_axis", ["down", "up"])
def test_convention(sign, units, span, y_axis):
    motion = np.random.default_rng(0).normal(size=(4, 7, 2)).astype(np.float32)
    convention = MotionConvention(sign, units, y_axis)
    s, up = (-1 if sign == "current_minus_previous" else 1), (-1 if y_axis == "up" else 1)
    expected = motion.astype(np.float64) * [s * span[0], s * up * span[1]]
    np.testing.assert_allclose(convert(motion, convention), expected, rtol=1e-6)
    same = convert_motion(motion, sign=sign, units=units, y_axis=y_axis)
    np.testing.assert_allclose(convert(motion, convention), same, rtol=1e-6)
    np.testing.assert_allclose(unconvert(convert(motion, convention), convention), motion, rtol=1e-6)
    assert MotionConvention.parse(str(convention)) == convention


def test_parse_convention():
    base = MotionConvention("current_minus_previous", "pixels", "up")
    assert MotionConvention.parse("ndc", base=base) == MotionConvention("current_minus_previous", "ndc", "up")
    assert MotionConvention.parse("") == MotionConvention()
    with pytest.raises(InputError, match="'sideways' is not one of"):
        MotionConvention.parse("up, sideways")
