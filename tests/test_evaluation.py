"""Evaluation: what is held back, what a method may see, causes, scores."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import BOX, PAN, SyntheticSequence, make_frame, make_keyframe

import jaxtrapolate as jx
from jaxtrapolate.evaluation.score import causes_of, mean_over_frames, score
from jaxtrapolate.evaluation.stages import time_stages
from jaxtrapolate.evaluation.windows import held_back, hide, windows
from jaxtrapolate.results import CauseScore, FrameScore


def test_every_second_frame_is_held_back():
    sequence = SyntheticSequence(range(1, 9))
    assert held_back(sequence, past=1) == [2, 4, 6, 8]
    assert held_back(sequence, past=2) == [4, 6, 8]
    assert held_back(sequence, past=3) == [6, 8]
    assert held_back(sequence, past=1, future=1) == [2, 4, 6]
    assert held_back(sequence, past=2, future=2) == [4]


def test_a_gap_starts_the_history_anew():
    sequence = SyntheticSequence([0, 1, 2, 3, 7, 8, 9, 10, 11])
    assert held_back(sequence, past=1) == [1, 3, 8, 10]
    assert held_back(sequence, past=2) == [3, 10]


def test_what_a_method_sees():
    for w in windows(SyntheticSequence(range(8)), [5, 7], past=2):
        assert [f.color is None for f in w.history] == [False, True, False]
        assert [float(f.time) for f in (*w.history, w.target)] == [w.number - 3, w.number - 2, w.number - 1, w.number]
        assert w.target.color is None
        assert w.target.gbuffer.shadow is None
        assert w.history[1].gbuffer.shadow is None
        assert w.history[0].gbuffer.shadow is not None
        assert w.truth.color is not None
        assert w.target.gbuffer.albedo is not None


class Altered(SyntheticSequence):
    """Other colour, shadow and sky colour in the held-back frames."""

    def frame(self, number):
        frame = super().frame(number)
        if number % 2 == 0:
            return frame
        buffers = jx.replace(frame.gbuffer, shadow=frame.gbuffer.shadow + 1, sky_color=frame.color)
        return jx.replace(frame, color=frame.color + 9, gbuffer=buffers)


def test_the_truth_does_not_leak():
    for a, b in zip(
        *(windows(s(range(9)), [5, 7], past=2, future=1) for s in (SyntheticSequence, Altered)), strict=True
    ):
        seen = [jax.tree.flatten((w.history, w.target, w.future)) for w in (a, b)]
        assert seen[0][1] == seen[1][1]
        assert all(np.array_equal(x, y) for x, y in zip(seen[0][0], seen[1][0], strict=True))
        assert not np.array_equal(a.truth.color, b.truth.color)


def test_windows_see_the_future_of_interpolation():
    (w,) = windows(SyntheticSequence(range(8)), [3], past=1, future=2)
    assert [f.color is None for f in w.future] == [False, True, False]
    assert [float(f.time) for f in w.future] == [4, 5, 6]


def test_hide_keeps_everything_else():
    frame = make_frame(3)
    hidden = hide(frame)
    names = [n for n in frame.gbuffer.__dataclass_fields__ if getattr(hidden.gbuffer, n) is None]
    assert {"shadow", "sky_color"} <= set(names)
    assert hidden.gbuffer.depth is frame.gbuffer.depth
    assert hidden.motion is frame.motion


def test_exact_disocclusion():
    """The box moves by BOX - (-PAN) over the wall: what it uncovers is its shape before, less its shape now."""
    hidden = np.asarray(jx.disoccluded(make_keyframe(4), make_keyframe(3)))
    box = np.asarray(make_frame(4).gbuffer.stencil[..., 0] > 0)
    y, x = np.mgrid[0:32, 0:48]
    there_x, there_y = x + PAN[0], y + PAN[1]
    left, top = 6 + BOX[0] * 3, 5 + BOX[1] * 3
    deep = (there_x >= left) & (there_x <= left + 13) & (there_y >= top) & (there_y <= top + 9) & ~box
    near = (there_x > left - 1) & (there_x < left + 14) & (there_y > top - 1) & (there_y < top + 10) & ~box
    assert hidden[deep].all()
    assert not hidden[~near].any()
    assert deep.sum() > 20


def test_causes_are_tried_in_order():
    target, source = make_frame(4), make_frame(3)
    causes = np.asarray(jx.cause_map(target, source, jnp.asarray(target.motion)))
    outside = ~np.asarray(jx.in_frame(jnp.asarray(target.motion)))
    assert (causes[outside] == jx.CAUSES.index("border")).all()
    assert (causes == jx.CAUSES.index("hole")).any()
    assert (causes == jx.CAUSES.index("edge")).any()
    assert (causes == jx.CAUSES.index("rest")).any()
    assert not (causes == jx.CAUSES.index("shadow")).any()

    shadow = np.zeros((32, 48, 1), np.float32)
    shadow[10:30, 25:45] = 0.5
    shaded = jx.replace(target, gbuffer=jx.replace(target.gbuffer, shadow=shadow))
    causes = np.asarray(jx.cause_map(shaded, source, jnp.asarray(target.motion)))
    inside = (shadow[..., 0] > 0) & ~outside
    assert np.isin(causes[inside], [jx.CAUSES.index("shadow"), jx.CAUSES.index("hole")]).all()

    smooth = jx.replace(target, gbuffer=jx.replace(target.gbuffer, roughness=np.full((32, 48, 1), 0.1, np.float32)))
    causes = np.asarray(jx.cause_map(smooth, source, jnp.asarray(target.motion)))
    assert set(np.unique(causes)) <= {jx.CAUSES.index(c) for c in ("border", "hole", "glossy")}


def test_causes_without_buffers_are_border_and_rest():
    frame = jx.Frame(color=make_frame(0).color, motion=np.full((32, 48, 2), 3, np.float32))
    causes = np.asarray(jx.cause_map(frame, frame, jnp.asarray(frame.motion)))
    assert set(np.unique(causes)) == {jx.CAUSES.index("border"), jx.CAUSES.index("rest")}


def test_an_inclined_plane_has_no_edges():
    """Depth along a plane bends, its inverse does not."""
    y, x = np.mgrid[0:32, 0:48]
    depth = (100.0 / (3.0 + 0.9 * y + 0.3 * x))[..., None].astype(np.float32)
    frame = jx.Frame(gbuffer=jx.GBuffer(depth=depth), motion=np.zeros((32, 48, 2), np.float32))
    assert (np.asarray(jx.cause_map(frame, frame, jnp.asarray(frame.motion))) == jx.CAUSES.index("rest")).all()


def test_scores_by_cause_make_up_the_whole():
    sequence = SyntheticSequence()
    (w,) = windows(sequence, [5], past=2)
    causes = causes_of(sequence, w)
    image = jx.load("warp")(w.history, w.target)
    result = score(image, w, causes, None, hdr=True)
    assert sum(c.share for c in result.by_cause.values()) == pytest.approx(1)
    whole = sum(c.share * 10 ** (-c.psnr / 10) for c in result.by_cause.values())
    assert -10 * np.log10(whole) == pytest.approx(result.psnr, abs=1e-3)


def test_pixels_that_were_not_finite_are_not_scored():
    (w,) = windows(SyntheticSequence(), [5], past=2)
    wrong = np.array(w.truth.color)
    wrong[3, 4] += 1
    invalid = np.zeros((32, 48), bool)
    assert score(jnp.asarray(wrong), w, None, invalid, hdr=True).psnr < 60
    invalid[3, 4] = True
    assert score(jnp.asarray(wrong), w, None, invalid, hdr=True).psnr == np.inf


def test_means_are_over_frames():
    frames = [
        {
            "psnr": 20.0,
            "ssim": 0.5,
            "by_cause": {"hole": {"psnr": 10.0, "share": 0.1}, "rest": {"psnr": 30.0, "share": 0.9}},
        },
        {"psnr": 30.0, "ssim": 0.7, "by_cause": {"rest": {"psnr": 40.0, "share": 1.0}}},
    ]
    entries = ({"number": i, "ms": 10.0 + i, **frame} for i, frame in enumerate(frames))
    mean = mean_over_frames([FrameScore.from_json(entry) for entry in entries])
    assert mean.psnr == 25
    assert mean.by_cause["hole"] == CauseScore(10.0, 0.05)
    assert mean.by_cause["rest"].psnr == 35
    assert mean.ms.median == 10.5
    assert mean.by_distance == {}


def test_stage_times_cover_the_active_stages():
    (w,) = windows(SyntheticSequence(), [5], past=2)
    method = jx.load("occlusion_warp")
    timings = time_stages(method, w, repeats=1)
    assert list(timings) == [s.name for s in method.active(w.history, w.target)]
    assert all(t.median > 0 for t in timings.values())


def test_forecast_carries_motion_on():
    """Half a step after frame 4, motion leads back by half of what it was; buffers move along."""
    newest = jax.tree.map(jnp.asarray, make_frame(4))
    ahead = jx.forecast(newest, 0.5)
    assert ahead.color is None
    assert float(ahead.time) == 4.5
    wall = np.zeros((32, 48), bool)
    wall[26:30, 4:10] = True
    np.testing.assert_allclose(np.asarray(ahead.motion)[wall], np.broadcast_to(PAN / 2, (24, 2)), atol=1e-6)
    box = np.asarray(ahead.gbuffer.stencil[..., 0]) > 0.5
    rows, columns = np.nonzero(box)
    assert columns.max() == pytest.approx(6 + BOX[0] * 4.5 + 13, abs=1)
    assert rows.max() == pytest.approx(5 + BOX[1] * 4.5 + 9, abs=1)
    np.testing.assert_allclose(np.asarray(ahead.motion)[rows[30], columns[30]], -BOX / 2, atol=1e-6)
