"""Lag and pacing against timelines worked out by hand, a clock that ticks, and the formulas of the papers."""

import io

import matplotlib
import numpy as np
import pytest

from jaxtrapolate.latency import additional_lag, presentation_latency, simulate, summarize
from jaxtrapolate.latency import timeline as latency
from jaxtrapolate.latency.plot import plot_latency

LATE = np.array([18.0, 18, 26, 18, 18])


def rows(timeline):
    """number, animation, input, finished, display of each shown frame."""
    columns = (timeline.number, timeline.animation, timeline.input, timeline.finished, timeline.display)
    return np.stack(columns, -1)


def step_lag(shown, method, *, ahead=0, partitioned=True, generate=1.0, interval=10.0):
    """The lag of rendered frames in steps from one to the next; rendering takes all the time that generation leaves."""
    count = 1 if method == "none" else shown
    render = shown * interval - (count - 1) * generate - 0.5
    options = {"generate": generate, "ahead": ahead, "partitioned": partitioned, "frames": 12}
    timeline = simulate(render, refresh_rate=1000 / interval, method=method, shown=shown, **options)
    assert np.ptp(timeline.lag) < 1e-9
    assert timeline.late.sum() == 0
    np.testing.assert_allclose(np.diff(timeline.animation), shown / count * interval)
    np.testing.assert_allclose(np.diff(timeline.display), shown / count * interval)
    return timeline.lag[0] / (shown * interval)


# Formulas


@pytest.mark.parametrize("partitioned", [True, False])
@pytest.mark.parametrize("shown", [2, 3, 4, 8])
def test_interpolation_lags_by_a_share_of_a_step_with_double_buffering(shown, partitioned):
    """Yang et al., Figure 6: (n - 1) / n steps more than rendering alone, which lags by one."""
    assert step_lag(shown, "none") == pytest.approx(1)
    found = step_lag(shown, "interpolation", partitioned=partitioned) - step_lag(shown, "none")
    assert found == pytest.approx((shown - 1) / shown)
    assert additional_lag(shown) == pytest.approx(found)
    assert step_lag(shown, "extrapolation", partitioned=partitioned) == pytest.approx(1)


@pytest.mark.parametrize("shown", [2, 3, 4, 8])
def test_the_additional_lag_vanishes_with_a_queue_of_one(shown):
    """Yang et al., Figure 6, for partitioned rendering; rendered in one go it stays."""
    assert step_lag(shown, "none", ahead=1) == pytest.approx(2)
    assert step_lag(shown, "interpolation", ahead=1) == pytest.approx(2)
    assert additional_lag(shown, ahead=1) == 0
    for ahead in (2, 3):
        found = step_lag(shown, "interpolation", ahead=ahead) - step_lag(shown, "none", ahead=ahead)
        assert additional_lag(shown, ahead=ahead) == pytest.approx(found)
    whole = step_lag(shown, "interpolation", ahead=1, partitioned=False)
    assert whole == pytest.approx(2 + (shown - 1) / shown)


@pytest.mark.parametrize("shown", [2, 3, 5])
def test_where_a_partitioned_frame_is_rendered(shown):
    """Yang et al., Figure 5: within [t - 2 + 1/n, t - 1 + 1/n], in steps of the display, which shows t at t."""
    step = 10.0 * shown
    timeline = simulate(step - 1, refresh_rate=100, method="interpolation", shown=shown, frames=6)
    rendered = timeline.rendered
    begins = (timeline.input - timeline.display)[rendered] / step
    np.testing.assert_allclose(begins, -2 + 1 / shown)
    ends = (timeline.finished - timeline.display)[rendered] / step
    assert (ends <= -1 + 1 / shown).all()
    assert (ends > -1).all(), "the first frame that is interpolated from it comes next"


def test_from_15_to_60_frames_per_second():
    """The setting of Yang et al.'s study: 3/4 of 66.7 ms, which players placed at 50 to 100 ms of lag."""
    options = {"refresh_rate": 60, "shown": 4, "generate": 2.0}
    plain = summarize(simulate(60.0, **options))
    ours = summarize(simulate(60.0, method="interpolation", **options))
    assert ours.lag_mean - plain.lag_mean == pytest.approx(50)
    assert (plain.shown_rate, ours.shown_rate) == (pytest.approx(15), pytest.approx(60))
    assert ours.reaction_mean == pytest.approx(plain.reaction_mean), "the first interpolated frame knows of it"


@pytest.mark.parametrize("render", [11.5, 16.0, 20.0])
def test_presentation_latency_of_two_frames(render):
    """PatchEX, Table 1, at 90 Hz: 3 D - R for interpolation; 2 D - R for extrapolation by the same clock, printed 0."""
    interval = 1000 / 90
    options = {"refresh_rate": 90.0, "generate": 2.0, "partitioned": False, "frames": 8}
    for method, expected in (("interpolation", 3 * interval - render), ("extrapolation", 2 * interval - render)):
        timeline = simulate(render, method=method, hold=1, **options)
        np.testing.assert_allclose(timeline.waiting[timeline.rendered], expected)
        assert presentation_latency(render, refresh_rate=90.0, method=method) == pytest.approx(expected)
    printed = [presentation_latency(render, refresh_rate=90.0, method=m, clock="printed") for m in latency._METHODS[1:]]
    assert printed == [pytest.approx(3 * interval - render), 0]
    assert interval < printed[0] < 2 * interval, "11.11 to 22.22 ms"


@pytest.mark.parametrize("method, shown", [("none", 1), ("interpolation", 3), ("extrapolation", 4)])
def test_presentation_latency_of_more_frames(method, shown):
    render = 8.0 * shown
    timeline = simulate(
        render, refresh_rate=100, method=method, shown=shown, generate=1.0, partitioned=False, hold=1, frames=9
    )
    found = timeline.waiting[timeline.rendered]
    np.testing.assert_allclose(found, presentation_latency(render, refresh_rate=100, method=method, shown=shown))


def test_without_slack_extrapolation_waits_for_nothing():
    """A display that refreshes whenever a frame is there, and generation for nothing: the clock of the printed 0."""
    timeline = simulate(15.0, refresh_rate=1e6, method="extrapolation", partitioned=False, hold=7500, frames=9)
    np.testing.assert_allclose(timeline.waiting[timeline.rendered], 0, atol=1e-6)
    assert presentation_latency(20.0, refresh_rate=100, method="extrapolation") == 0


# By hand


def test_a_late_frame_between_extrapolated_ones():
    """Rendered in one go at 100 Hz, 1 ms to generate; the third frame takes 26 ms and misses one refresh."""
    timeline = simulate(LATE, refresh_rate=100, method="extrapolation", generate=1.0, partitioned=False, hold=1)
    expected = [
        (0.0, 0, 0, 18, 20),
        (0.5, 10, 0, 19, 30),
        (1.0, 20, 20, 38, 40),
        (1.5, 30, 20, 39, 50),
        (2.0, 40, 40, 66, 70),
        (2.5, 50, 40, 67, 80),
        (3.0, 70, 70, 88, 90),
        (3.5, 80, 70, 89, 100),
        (4.0, 90, 90, 108, 110),
    ]
    np.testing.assert_allclose(rows(timeline), expected, atol=1e-9)
    np.testing.assert_array_equal(timeline.rendered, [True, False] * 4 + [True])
    np.testing.assert_array_equal(timeline.late, [0, 0, 0, 1, 0, 0, 0, 0])
    found = summarize(timeline)
    assert found.missed == 1
    assert found.irregularity == pytest.approx(5), "steps of the animation minus the display's: -10 and +10 out of 8"
    assert found.latency_worst == 40
    assert found.latency_mean == pytest.approx((30 + 20 + 30 + 30 + 40 + 20 + 30 + 20) / 8)
    assert found.lag_mean == pytest.approx((20 + 20 + 20 + 30 + 30 + 20 + 20 + 20) / 8)
    assert found.waiting_mean == pytest.approx((2 + 4 + 2 + 2) / 4)
    assert found.waiting_worst == 4
    assert found.reaction_worst == pytest.approx(50), "just after 20, sampled at 40, seen at 70"
    waits = np.array([(20, 20), (20, 30), (30, 20), (20, 20)])  # gaps between samplings, then until it is seen
    assert found.reaction_mean == pytest.approx(np.sum(waits[:, 0] * (waits[:, 0] / 2 + waits[:, 1])) / 90)
    assert found.shown_rate == pytest.approx(8 / 0.09)
    assert found.rendered_rate == pytest.approx(4 / 0.09)
    assert found.busy == pytest.approx((18 + 26 + 18 + 18 + 4) / 90)


def test_a_late_frame_between_interpolated_ones():
    """Partitioned at 100 Hz, 1 ms to generate: shares of 18 ms are 9.5 and 8.5, of 26 ms 13.5 and 12.5."""
    timeline = simulate(LATE, refresh_rate=100, method="interpolation", generate=1.0, hold=1)
    # Frame 2 is rendered in the periods of 1 and 1.5: the GPU is late for both, and displays them a refresh later.
    expected = [
        (0.0, 0, 0, 18.5, 30),
        (0.5, 10, 20, 39.5, 40),
        (1.0, 20, 20, 38.5, 60),
        (1.5, 30, 40, 73.5, 80),
        (2.0, 40, 40, 72.5, 90),
        (2.5, 60, 80, 99.5, 100),
        (3.0, 80, 80, 98.5, 110),
        (3.5, 90, 100, 119.5, 120),
        (4.0, 100, 100, 118.5, 130),
    ]
    np.testing.assert_allclose(rows(timeline), expected, atol=1e-9)
    assert timeline.late.tolist() == [0, 1, 1, 0, 0, 0, 0, 0]
    found = summarize(timeline)
    assert found.missed == 2
    steps = np.array([0, -10, -10, 0, 10, 10, 0, 0])  # of the animation minus the display's
    assert found.irregularity == pytest.approx(steps.std())


def test_a_late_frame_alone():
    """Rendered frames at 100 Hz with a queue of one: input is sampled when the frame before begins."""
    timeline = simulate(LATE, refresh_rate=100, ahead=1, hold=2)
    expected = [
        (0, 0, 0, 38, 40),
        (1, 20, 20, 58, 60),
        (2, 40, 40, 86, 90),
        (3, 60, 60, 108, 110),
        (4, 90, 90, 128, 130),
    ]
    np.testing.assert_allclose(rows(timeline), expected, atol=1e-9)
    np.testing.assert_array_equal(timeline.late, [0, 1, 0, 0])


def test_generation_that_takes_longer_than_a_refresh():
    """At 100 Hz, 10 + 12 ms do not fit into two periods; by default each frame is then planned for two refreshes."""
    options = {"refresh_rate": 100, "method": "interpolation", "generate": 12.0, "frames": 8}
    planned = simulate(10.0, **options)
    assert planned.hold == 2
    assert summarize(planned).missed == 0
    assert summarize(planned).shown_rate == pytest.approx(50)
    forced = simulate(10.0, hold=1, **options)
    assert summarize(forced).missed > 0


def test_a_step_is_split_as_evenly_as_can_be():
    """Generation that takes longer than an even share leaves rendering to the periods without it."""
    timeline = simulate(6.0, refresh_rate=100, method="extrapolation", generate=9.0, frames=5)
    np.testing.assert_allclose(timeline.finished, timeline.display - np.where(timeline.rendered, 4, 1))
    even = simulate(12.0, refresh_rate=100, method="extrapolation", generate=5.0, frames=5)
    np.testing.assert_allclose(even.finished, even.display - 1.5)


# By a clock that ticks


def ticking(times, shown, generate, method, hold, interval):
    """Rendering in one go, one unit of time after the other; integers. Returns display times from t = 0 on."""
    tasks, t = [], -2
    while t < len(times):
        base = t - 1 if method == "interpolation" else t
        extra = [(base + j / shown, generate) for j in range(1, shown)]
        tasks.append([(t, times[max(t, 0)]), *extra])
        t += 1
    ready, displayed, on_screen, batch = {}, {}, None, 0
    order = sorted(number for batch in tasks for number, _ in batch)
    left, clock, last, todo = None, 0, None, []
    while len(displayed) < len(order):
        if clock % interval == 0 and len(displayed) < len(order):  # the display first: it swaps what was ready before
            number = order[len(displayed)]
            if number in ready and (last is None or clock - last >= hold * interval):
                displayed[number] = last = clock
                on_screen = number
        if not todo and batch < len(tasks):
            before = min(number for number, _ in tasks[batch - 1]) if batch else None
            if before is None or (on_screen is not None and on_screen >= before):
                todo, batch = list(tasks[batch]), batch + 1
                left = todo[0][1]
        clock += 1
        if todo:
            left -= 1
            while todo and left == 0:
                ready[todo.pop(0)[0]] = clock
                left = todo[0][1] if todo else None
    return np.array([displayed[n] for n in order if n >= 0 and n <= len(times) - 1])


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("method", ["none", "interpolation", "extrapolation"])
def test_against_a_clock_that_ticks(method, seed):
    rng = np.random.default_rng(seed)
    shown, hold, interval, generate = (int(rng.integers(*r)) for r in ((2, 5), (1, 3), (3, 12), (1, 4)))
    shown = 1 if method == "none" else shown
    mean = max(2, shown * hold * interval - (shown - 1) * generate - 2)
    times = rng.integers(max(1, mean // 2), mean + mean // 2 + 1, 20)
    times[8] = 2 * shown * hold * interval  # late in any case
    expected = ticking(times.tolist(), shown, generate, method, hold, interval)
    options = {"shown": shown, "generate": float(generate), "hold": hold, "partitioned": False}
    timeline = simulate(times.astype(float), refresh_rate=1000 / interval, method=method, **options)
    np.testing.assert_allclose(timeline.display - timeline.display[0], expected - expected[0], atol=1e-6)
    assert len(set(np.diff(expected))) > 1, "an even timeline proves little"


@pytest.mark.parametrize("partitioned", [True, False])
@pytest.mark.parametrize(
    "method, shown", [("none", 1), ("interpolation", 2), ("interpolation", 3), ("extrapolation", 4)]
)
@pytest.mark.parametrize("ahead", [0, 2])
def test_what_holds_for_every_timeline(method, shown, partitioned, ahead):
    times = np.random.default_rng(1).uniform(5, 50, 40)
    options = {"shown": shown, "generate": 1.5, "partitioned": partitioned, "ahead": ahead}
    timeline = simulate(times, refresh_rate=120, method=method, **options)
    assert len(timeline.number) == 39 * shown + 1
    refreshes = timeline.display / timeline.interval
    np.testing.assert_allclose(refreshes, np.rint(refreshes), atol=1e-6)
    assert (np.diff(np.rint(refreshes)) >= timeline.hold).all()
    assert (timeline.finished <= timeline.display + 1e-6).all()
    assert (timeline.input < timeline.finished).all()
    assert (np.diff(timeline.animation) > 0).all() or method == "extrapolation"
    assert (np.diff(timeline.input[timeline.rendered]) >= timeline.hold * timeline.interval - 1e-6).all()
    assert 0 <= timeline.input[0] < timeline.interval
    rendered = np.flatnonzero(timeline.rendered)
    np.testing.assert_array_equal(timeline.input[rendered], timeline.animation[rendered])
    gpu = timeline.finished[rendered] - timeline.input[rendered]
    assert (gpu >= times - 1e-6).all(), "rendering takes at least its time"
    assert 0 < timeline.busy <= 1 + 1e-9
    assert summarize(timeline).missed == np.sum(np.rint(np.diff(refreshes)) - timeline.hold)


# Errors and the picture


def test_errors(unchecked):
    with pytest.raises(
        ValueError, match="method: expected one of 'none', 'interpolation', 'extrapolation', got 'both'"
    ):
        simulate(10.0, refresh_rate=60, method="both")
    for value in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="refresh_rate: expected a positive number"):
            simulate(10.0, refresh_rate=value)
        with pytest.raises(ValueError, match="render: expected a positive number"):
            simulate(np.array([10.0, value]), refresh_rate=60)
    with pytest.raises(ValueError, match=r"generate: expected a non-negative number, got -1"):
        simulate(10.0, refresh_rate=60, generate=-1.0)
    with pytest.raises(ValueError, match=r"render: expected a number or \[rendered\], at least 2, got shape \[1\]"):
        simulate(np.ones(1), refresh_rate=60)
    with pytest.raises(ValueError, match=r"render: .* got shape \[3, 2\]"):
        simulate(np.ones((3, 2)), refresh_rate=60)
    for name, value, least in (("shown", 0, 1), ("ahead", -1, 0), ("hold", 0, 1), ("frames", 1, 2)):
        with pytest.raises(ValueError, match=f"{name}: expected at least {least}, got {value}"):
            simulate(10.0, refresh_rate=60, **{name: value})
        with pytest.raises(TypeError, match=f"{name}: expected an integer, got 1.5"):
            simulate(10.0, refresh_rate=60, **{name: 1.5})
    with pytest.raises(ValueError, match="shown: expected at least 1, got 0"):
        additional_lag(0)
    with pytest.raises(ValueError, match="ahead: expected at least 0, got -1"):
        additional_lag(2, ahead=-1)
    with pytest.raises(ValueError, match="clock: 'printed' is for two frames shown, generated one of them, got 3"):
        presentation_latency(10.0, refresh_rate=60, method="extrapolation", shown=3, clock="printed")
    with pytest.raises(ValueError, match=r"render: expected at most 33.3333 ms, the time of 2 frames, got 40"):
        presentation_latency(40.0, refresh_rate=60, method="extrapolation")
    with pytest.raises(ValueError, match="clock: expected one of 'vsync', 'printed', got 'wall'"):
        presentation_latency(10.0, refresh_rate=60, method="extrapolation", clock="wall")
    timeline = simulate(10.0, refresh_rate=60, frames=3)
    one = {name: getattr(timeline, name)[:1] for name in ("number", "rendered", "animation", "input", "display")}
    short = latency.Timeline(**one, finished=timeline.finished[:1], interval=timeline.interval, hold=1, busy=1.0)
    with pytest.raises(ValueError, match="timeline: expected at least 2 rendered frames, got 1"):
        summarize(short)


def test_picture():
    before = dict(matplotlib.rcParams)
    lines = {
        "rendered $x": simulate(30.0, refresh_rate=120),
        "interpolated": simulate(27.0, refresh_rate=120, method="interpolation", shown=4, generate=1.0),
        "a": simulate(27.0, refresh_rate=120, method="extrapolation", shown=2),
        "b": simulate(27.0, refresh_rate=120, method="extrapolation", shown=2),
    }
    figure = plot_latency(lines, steps=2)
    assert dict(matplotlib.rcParams) == before
    panels = [axes for axes in figure.axes if axes.axison]
    assert [axes.get_title(loc="left") for axes in panels] == list(lines)
    for axes, timeline in zip(panels, lines.values(), strict=True):
        bars = np.concatenate(
            [c.get_segments() for c in axes.collections if c.get_linewidth()[0] == 4 and c.get_segments()]
        )
        shown = timeline.number < 2
        bars = bars[np.argsort(bars[:, 0, 0])]
        origin = timeline.input[0]
        np.testing.assert_allclose(bars[:, 0, 0], timeline.display[shown] - origin)
        np.testing.assert_allclose(bars[:, 0, 1], timeline.animation[shown] - origin)
        np.testing.assert_allclose(bars[:, 1, 0], timeline.display[1 : shown.sum() + 1] - origin)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=50)
    assert buffer.getvalue().startswith(b"\x89PNG")
    plot_latency({"one": simulate(30.0, refresh_rate=120, frames=2)}, steps=9).savefig(io.BytesIO(), format="svg")
    with pytest.raises(ValueError, match="timelines: expected at least one, got none"):
        plot_latency({})
    with pytest.raises(ValueError, match="steps: expected at least 1, got 0"):
        plot_latency(lines, steps=0)
