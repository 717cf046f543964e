"""The embedded scenes: one structure for all seeds, the `Sequence` interface, and how hard they are."""

import time

import jax
import numpy as np
import pytest

from jaxtrapolate.records import check_frame
from jaxtrapolate.scenes import (
    DEVELOPMENT_SEEDS,
    TEST_SEEDS,
    TRAINING_SEEDS,
    SceneSequence,
    render,
    scene,
    scene_names,
    statistics,
)
from jaxtrapolate.scenes.statistics import mean

MOVING = [name for name in scene_names() if name != "still"]


@pytest.mark.parametrize("name", scene_names())
def test_seeds_share_their_structure_and_differ(name):
    first, second, again = scene(name, 0), scene(name, 1), scene(name, 0)
    assert jax.tree.structure(first) == jax.tree.structure(second)
    assert [leaf.shape for leaf in jax.tree.leaves(first)] == [leaf.shape for leaf in jax.tree.leaves(second)]
    assert any(not np.array_equal(a, b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(first))


def test_test_seeds_are_no_training_seeds():
    assert len(set(TEST_SEEDS)) == len(TEST_SEEDS) >= 4
    assert not any(seed in TRAINING_SEEDS or seed in DEVELOPMENT_SEEDS for seed in TEST_SEEDS)
    assert not any(seed in TRAINING_SEEDS for seed in DEVELOPMENT_SEEDS)


def test_errors():
    with pytest.raises(ValueError, match="walkers"):
        scene("none")
    with pytest.raises(ValueError, match="seed"):
        scene("demo", -1)
    with pytest.raises(ValueError, match="frames"):
        SceneSequence("demo", frames=0)
    with pytest.raises(ValueError, match="number"):
        SceneSequence("demo", frames=3, size=(4, 4)).frame(3)


@pytest.mark.slow
@pytest.mark.parametrize("name", scene_names())
def test_sequence(name):
    sequence = SceneSequence(name, frames=2, size=(45, 80))
    frame = sequence.frame(1)
    assert check_frame("frame", frame) == sequence.size
    assert all(isinstance(leaf, np.ndarray) and np.isfinite(leaf).all() for leaf in jax.tree.leaves(frame))
    key = sequence.keyframe(1)
    np.testing.assert_array_equal(key.color, frame.color)
    np.testing.assert_allclose(key.backward_flow[..., :2], frame.motion, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVING)
def test_scenes_are_hard_enough(name):
    """On the seeds that scenes were made with; of the test seeds dock's hide 1.6 %."""
    rows = [statistics(scene(name, seed)) for seed in DEVELOPMENT_SEEDS]
    for row in rows:
        assert row.motion >= 8
        assert row.hidden >= 0.01
        assert row.hidden + row.outside <= 0.15
    total = mean(rows)
    assert 0.02 <= total.hidden <= 0.10
    if name == "interior":  # about a moving shadow
        assert total.shadow >= 0.02
    if name in ("head", "interior", "dock", "street"):  # about gloss
        assert total.glossy >= 0.05


@pytest.mark.slow
def test_samples_converge_to_a_reference():
    world, size = scene("demo"), (45, 80)
    one, four, many = (np.asarray(render(world, 3.0, size=size, samples=n).color) for n in (1, 4, 64))
    assert np.abs(four - many).mean() < np.abs(one - many).mean()


@pytest.mark.slow
def test_speed():
    world = scene("demo")
    render(world, 0.0, size=(180, 320))
    times = []
    for k in range(20):
        start = time.perf_counter()
        jax.block_until_ready(render(world, float(k), size=(180, 320)))
        times.append(time.perf_counter() - start)
    assert np.median(times) < 0.5  # a wide margin: machines differ
