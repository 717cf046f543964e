"""The player: schedules, windows, memory threaded through a sequence, each frame generated once."""

import json
import pickle
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import SyntheticSequence, make_frame

import jaxtrapolate as jx
from jaxtrapolate.commands.generate import Work
from jaxtrapolate.evaluation.evaluate import Evaluation
from jaxtrapolate.evaluation.player import Player, play
from jaxtrapolate.evaluation.schedule import (
    held_back_slots,
    missing_slots,
    needed_slots,
    virtual_slots,
)
from jaxtrapolate.evaluation.windows import Window, held_back, hidden, hide, load
from jaxtrapolate.methods import Method, Stage, neighbours
from jaxtrapolate.results import Results

SHARE = 0.25


def running_mean():
    """The mean of all rendered frames along the motion: a method whose every frame depends on all before it."""

    def start(history, target):
        return jnp.zeros((*jnp.shape(target.color if target.color is not None else history[-1].color)[:2], 4))

    def advance(state, values):
        target, carry = values["target"], values["carry"]
        if target.motion is not None:
            carry = jx.backward_warp(carry, target.motion)
        if target.color is None:
            return {"carry": carry, "image": carry[..., :3] / jnp.maximum(carry[..., 3:], 1e-6)}
        new = jnp.concatenate([target.color, jnp.ones_like(target.color[..., :1])], -1)
        return {"carry": SHARE * new + (1 - SHARE) * carry, "image": jnp.asarray(target.color)}

    stage = Stage("mean", advance, ("carry", "target"), ("carry", "image"), reads=("target.motion",), past=0, on="both")
    return Method("running_mean", (stage,), start=start)


class Uncolored(SyntheticSequence):
    """Every second frame has buffers alone."""

    def frame(self, number):
        return super().frame(number) if number % 2 == 0 else hide(super().frame(number))

    def has_color(self, number):
        return number % 2 == 0


def scanned(count):
    """The frames that a running mean generates, by `lax.scan` over pairs of a rendered and a held-back frame."""
    method = running_mean()

    def pair(carry, frames):
        rendered, target = frames
        carry, _ = method.function((), carry, (), rendered)
        carry, image = method.function((), carry, (rendered,), target)
        return carry, image

    frames = [jax.tree.map(jnp.asarray, make_frame(i)) for i in range(count)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *frames[::2])
    targets = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(hide, frames[1::2]))
    return jax.lax.scan(pair, method.init((), frames[0]), (stacked, targets))[1]


def test_memory_by_evaluation_generation_and_scan():
    expected = scanned(12)
    method = running_mean()
    evaluation = Evaluation.prepare(SyntheticSequence(range(12)), {"mean": method}, {})
    assert evaluation.numbers == (1, 3, 5, 7, 9, 11)
    for k, (slot, _, generated) in enumerate(evaluation.play(lambda *_: True)):
        assert slot.number == 2 * k + 1
        np.testing.assert_allclose(generated["mean"].image, expected[k], atol=1e-6)
    work = Work.plan(Uncolored(range(12)), running_mean(), 2)
    images = dict(work.images([work.name(slot) for slot in work.targets]))
    assert list(images) == [f"{n:04d}" for n in (1, 3, 5, 7, 9, 11)]
    for image, truth in zip(images.values(), expected, strict=True):
        np.testing.assert_allclose(image, truth, atol=1e-6)


def test_one_frame_alone_is_what_it_is_among_all():
    """What a method with memory has to see before it is replayed."""
    expected = scanned(12)
    evaluation = Evaluation.prepare(SyntheticSequence(range(12)), {"mean": running_mean()}, {}, frames=[9])
    ((slot, _, generated),) = evaluation.play(lambda *_: True)
    assert slot.number == 9
    np.testing.assert_allclose(generated["mean"].image, expected[4], atol=1e-6)
    assert evaluation.reads() == list(range(10))


def test_memory_starts_anew_after_a_gap():
    sequence = SyntheticSequence([0, 1, 2, 3, 20, 21])
    slots = held_back_slots(sequence, past=1)
    assert [slot.number for slot in slots if slot.first] == [0, 20]
    images = {s.number: g["m"].image for s, _, g in play(sequence, slots, {"m": running_mean()}, hidden={1, 3, 21})}
    alone = SyntheticSequence([20, 21])
    ((_, _, generated),) = play(alone, held_back_slots(alone, past=1), {"m": running_mean()}, hidden={21})
    np.testing.assert_array_equal(images[21], generated["m"].image)


def test_memory_starts_anew_where_the_size_changes():
    player = Player(running_mean())
    for size in ((32, 48), (16, 24)):
        frame = jax.tree.map(jnp.asarray, make_frame(0, size))
        player.show(Window(0, frame, (), frame, ()))
        target = hide(jax.tree.map(jnp.asarray, make_frame(1, size)))
        generated = player.show(Window(1, target, (frame,), target, ()))
        warped = jx.backward_warp(frame.color, target.motion)
        np.testing.assert_allclose(generated.image, warped, atol=1e-5)


def counting(name, calls):
    """A method that says how often it is called."""

    def function(state, values):
        calls.append(float(values["target"].time))
        return {"image": values["history"][0].color}

    return Method(name, (Stage("count", function, ("history", "target"), ("image",), host=True),))


def test_each_frame_is_generated_once_and_the_first_twice():
    calls = []
    sequence = SyntheticSequence(range(8))
    results = jx.evaluate(sequence, {"count": counting("count", calls)}, metrics=())
    timed = 1 + 2 + 5  # `time_stages` runs each stage on its own: first, warm-up, repeats
    assert [calls.count(n) for n in (3, 5, 7)] == [1, 1, 1]
    assert calls.count(1) == 2 + timed + 1  # with the values that later stages would get
    assert results.methods["count"].ms.compile >= 0
    assert all(frame.ms >= 0 for frame in results.methods["count"].frames)


def test_methods_without_memory_are_shown_nothing_else():
    calls = []
    sequence = SyntheticSequence(range(8))
    slots = held_back_slots(sequence, past=1)
    methods = {"a": counting("a", calls), "m": running_mean()}
    shown = [
        s.number for s, _, _ in play(sequence, slots, methods, wanted=lambda n, s: s.number == 5, hidden={1, 3, 5, 7})
    ]
    assert shown == [5]
    assert calls == [5.0, 5.0]


@pytest.mark.parametrize("past, future", [(1, 0), (2, 1), (3, 2)])
def test_schedules_have_the_neighbours_that_python_would_be_handed(past, future):
    """Against `neighbours`, for random patterns of colour and gaps."""
    rng = np.random.default_rng(past)

    class Patchy(SyntheticSequence):
        def has_color(self, number):
            return bool(colored[number])

    for _ in range(20):
        colored = rng.random(14) < 0.5
        numbers = [n for n in range(14) if n not in rng.integers(1, 14, 2)]
        sequence = Patchy(numbers)
        for slot in missing_slots(sequence, past=past, future=future):
            place = numbers.index(slot.number)
            flags = [bool(colored[n]) for n in numbers]
            before, behind = neighbours(flags, place, past=past, future=future, numbers=numbers)
            assert slot.before == tuple(numbers[i] for i in before)
            assert slot.behind == tuple(numbers[i] for i in behind)
            assert slot.rendered == colored[slot.number]


def test_several_frames_in_a_row_are_held_back():
    sequence = SyntheticSequence(range(10))
    assert held_back(sequence, past=1, factor=3) == [1, 2, 4, 5, 7, 8]
    assert held_back(sequence, past=2, factor=3) == [4, 5, 7, 8]
    assert held_back(sequence, past=1, future=1, factor=3) == [1, 2, 4, 5, 7, 8]
    assert held_back(sequence, past=1, future=1, factor=4) == [1, 2, 3, 5, 6, 7]
    slots = {s.number: s for s in held_back_slots(sequence, past=2, future=1, factor=3)}
    assert (slots[5].before, slots[5].behind, slots[5].distance) == ((0, 1, 2, 3, 4), (6,), 2)
    with pytest.raises(ValueError, match="factor: expected 2 or more, got 1"):
        held_back(sequence, past=1, factor=1)


def test_nothing_held_back_is_seen():
    sequence = SyntheticSequence(range(10))
    slots = [s for s in held_back_slots(sequence, past=2, future=1, factor=3) if s.full]
    for slot, window in load(sequence, slots, hidden=hidden(sequence, factor=3)):
        for number, frame in zip(slot.before, window.history, strict=True):
            assert (frame.color is None) == (number % 3 != 0)
        assert (window.target.color is None) == (slot.number % 3 != 0)
        assert window.truth.color is not None


def test_virtual_frames():
    sequence = SyntheticSequence(range(4))
    slots = virtual_slots(sequence, "between", past=2, factor=3)
    assert [(s.number, s.fraction) for s in slots if not s.rendered] == [
        (n, Fraction(k, 3)) for n in (0, 1, 2) for k in (1, 2)
    ]
    assert [(s.rendered, s.before, s.behind) for s in slots if s.number == 2] == [
        (True, (0, 1), ()),
        (False, (1,), (3,)),
        (False, (1,), (3,)),
    ]
    onward = virtual_slots(sequence, "onward", past=1, factor=2)
    assert [s.number for s in onward if not s.rendered] == [0, 1, 2, 3]
    (_, window), *_ = load(sequence, [s for s in onward if s.number == 2 and not s.rendered])
    assert float(window.target.time) == 2.5
    assert window.truth.color is None
    (_, window), *_ = load(sequence, [s for s in slots if s.fraction == Fraction(2, 3)])
    assert float(window.target.time) == pytest.approx(2 / 3)
    assert [float(f.time) for f in (*window.history, *window.future)] == [0, 1]


def test_what_has_to_be_shown():
    slots = held_back_slots(SyntheticSequence([0, 1, 2, 3, 7, 8, 9]), past=1)
    wanted = [slot.number in (1, 8) for slot in slots]
    assert needed_slots(slots, wanted, memory=False) == wanted
    assert needed_slots(slots, wanted, memory=True) == [True, True, False, False, True, True, False]


def test_evaluation_as_a_function():
    sequence = SyntheticSequence(range(10))
    results = jx.evaluate(sequence, ["repeat", "warp"], factor=3)
    assert results.frames == (1, 2, 4, 5, 7, 8)
    warp = results.methods["warp"]
    assert set(warp.by_distance) == {1, 2}
    assert warp.psnr == pytest.approx(np.mean([f.psnr for f in warp.frames]))
    assert warp.drift == pytest.approx(warp.by_distance[1] - warp.by_distance[2])
    assert results.methods["repeat"].drift > 0
    assert warp.psnr > results.methods["repeat"].psnr
    restored = Results.from_json(json.loads(json.dumps(results.to_json())))
    assert restored == results
    with pytest.raises(ValueError, match="method: expected one of"):
        jx.evaluate(sequence, ["wrap"])
    with pytest.raises(jx.InputError, match=r"^frames: 2 of") as error:
        jx.evaluate(sequence, ["warp"], frames=[2])
    assert error.value.on_command_line.startswith("--frames: 2 of ")
    assert str(pickle.loads(pickle.dumps(error.value))) == str(error.value)


def test_exact_and_unknown_figures_survive_json(tmp_path):
    from jaxtrapolate.runtime.output import read_json, write_json

    sequence = SyntheticSequence(range(4))
    results = jx.evaluate(
        sequence,
        {
            "truth": Method(
                "truth", (Stage("t", lambda s, v: {"image": v["history"][0].color}, ("history",), ("image",)),)
            )
        },
    )
    write_json(tmp_path / "r.json", results.to_json())
    assert Results.from_json(read_json(tmp_path / "r.json")).methods["truth"].psnr == results.methods["truth"].psnr


def test_a_frame_that_lacks_buffers_is_named():
    class Damaged(SyntheticSequence):
        def frame(self, number):
            return jx.replace(super().frame(number), motion=None if number == 5 else super().frame(number).motion)

    with pytest.raises(jx.InputError, match=r"frame 5: method 'warp', stage 'reproject': missing target\.motion"):
        jx.evaluate(Damaged(range(8)), ["warp"])
