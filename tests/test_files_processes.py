"""Readers in processes: forked off after JAX was used, or while a thread reads; pickled; and no JAX in reading."""

import multiprocessing
import os
import pickle
import subprocess
import sys
import textwrap
import threading

import numpy as np
import pytest
from synthetic import make_frame, make_keyframe

from jaxtrapolate.files import open_sequence, write_exr, write_png, write_unreal_frame
from jaxtrapolate.files.packed import encode_motion

SIZE = (5, 8)
LIMIT = 20  # seconds; a worker that hangs would wait for ever

SETTINGS = """
hdr = true
depth = "ordinal"
[motion]
sign = "previous_minus_current"
units = "ndc"
y_axis = "up"
[buffers]
color = { file = "c{frame:04d}.png", srgb = true }
albedo = { file = "c{frame:04d}.png", channels = "GBR" }
depth = { file = "x{frame:04d}.exr", layer = "P", channels = "Z", invert = true, nothing_above = 9 }
sky = { file = "x{frame:04d}.exr", layer = "P", channels = "Z", above = 9 }
shadow = { file = "x{frame:04d}.exr", layer = "P", channels = "Z", below = 0.5 }
stencil = { file = "i{frame:04d}.exr" }
motion = { file = "x{frame:04d}.exr", layer = "P", channels = "ZZ", scale = 2, offset = -1 }
backward_flow = { file = "x{frame:04d}.exr", layer = "P", channels = "ZZZ" }
"""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder for each reader, of the frames 1 to 3, with a non-finite pixel and hashes for ids."""
    top = tmp_path_factory.mktemp("inputs")
    rng = np.random.default_rng(0)
    for number in (1, 2, 3):
        frame = make_frame(number, SIZE)
        frame.color[0, 0, 0] = np.nan
        write_unreal_frame(top / "unreal", "Town", number, frame, keyframe=make_keyframe(number, SIZE))
        codes = rng.integers(0, 255, (*SIZE, 3), np.uint8)
        uv = encode_motion(frame.motion / 100)
        images = {"color": codes, "motion": uv, "depth": codes[..., 0], "stencil": codes[..., 1]}
        for name, image in images.items():
            (top / "packed" / name).mkdir(parents=True, exist_ok=True)
            write_png(top / "packed" / name / f"{number:04d}.png", image)
        (top / "pattern").mkdir(exist_ok=True)
        write_png(top / "pattern" / f"c{number:04d}.png", codes)
        depth = rng.random(SIZE).astype(np.float32) * 10
        depth[1, 1] = np.nan
        write_exr(top / "pattern" / f"x{number:04d}.exr", {"P.Z": depth}, half=False)
        write_exr(top / "pattern" / f"i{number:04d}.exr", {"Y": rng.integers(0, 2**32, SIZE, np.uint32)})
    (top / "pattern" / "jaxtrapolate.toml").write_text(SETTINGS)
    return top


NAMES = ("unreal", "packed", "pattern")


def everything(sequence):
    """What a reader gives of all frames, as bytes."""
    out = []
    for number in sequence.numbers:
        frame, keyframe = sequence.frame(number), sequence.keyframe(number)
        out.append([a.tobytes() for a in (frame.color, frame.motion, *vars(frame.gbuffer).values()) if a is not None])
        out.append([sequence.nonfinite(number), sequence.no_depth(number), sequence.stored_motion(number).tobytes()])
        out.append([sequence.invalid(number) is None, keyframe is None or keyframe.backward_flow.tobytes()])
    return [sequence.notes, *out]


def forked(function):
    """What a function returns in a process that is forked off here; fails if it takes longer than `LIMIT`."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=lambda: sender.send(function()))
    process.start()
    try:
        assert receiver.poll(LIMIT), "the forked process hangs"
        return receiver.recv()
    finally:
        process.kill()
        process.join()


fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
# Python and JAX warn of any fork in a process with threads; what they warn of is what is tested.
quiet = pytest.mark.filterwarnings("ignore:.*fork:RuntimeWarning", "ignore:.*fork:DeprecationWarning")


def use_jax():
    import jax

    import jaxtrapolate as jx

    jax.block_until_ready(jx.backward_warp(jax.numpy.ones((200, 300, 3)), jax.numpy.zeros((200, 300, 2))))


@fork
@quiet
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("opened", ["before", "after", "read before"])
def test_a_forked_worker_reads(inputs, name, opened):
    use_jax()
    sequence = None if opened == "after" else open_sequence(inputs / name)
    if opened == "read before" and sequence is not None:
        sequence.frame(2)
    read = forked(lambda: everything(sequence or open_sequence(inputs / name)))
    assert read == everything(open_sequence(inputs / name))


@fork
@quiet
def test_a_forked_worker_reads_what_jax_would_use_threads_for(tmp_path):
    """A frame so large that a computation on it is given to JAX's threads, which a forked process does not have."""
    motion = np.random.default_rng(0).normal(size=(180, 320, 3)).astype(np.float32)
    write_exr(tmp_path / "TownMotionVector.0001.exr", motion, half=False)
    use_jax()
    np.testing.assert_array_equal(forked(lambda: open_sequence(tmp_path).frame(1).motion), motion[..., :2] * [-1, 1])


@fork
@quiet
def test_a_worker_that_is_forked_off_while_a_thread_reads(inputs):
    sequence = open_sequence(inputs / "unreal")
    reading, done = threading.Event(), threading.Event()
    real = sequence._decode

    def slow(number):
        reading.set()
        done.wait(LIMIT)
        return real(number)

    sequence._decode = slow
    thread = threading.Thread(target=lambda: sequence.frame(1))
    thread.start()
    reading.wait(LIMIT)
    sequence._decode = real
    try:
        assert forked(lambda: float(sequence.frame(2).time)) == 2
    finally:
        done.set()
        thread.join()


@pytest.mark.parametrize("name", NAMES)
def test_pickled(inputs, name):
    sequence = open_sequence(inputs / name)
    sequence.frame(1)
    assert everything(pickle.loads(pickle.dumps(sequence))) == everything(sequence)


def test_reading_computes_nothing_with_jax(inputs):
    """Every primitive, compilation and array of JAX raises."""
    code = f"""
        import sys
        sys.path[:0] = {[os.path.dirname(__file__)]!r}
        import jax
        from jax._src import core, dispatch
        from jaxtrapolate.files import open_sequence, prefetch

        def poisoned(*arguments, **options):
            raise AssertionError("JAX was asked to compute")

        core.Primitive.bind = poisoned
        jax.jit = jax.device_put = jax.numpy.asarray = jax.numpy.array = jax.devices = poisoned
        for name in {NAMES!r}:
            sequence = open_sequence({str(inputs)!r} + "/" + name)
            for number, frame in prefetch(sequence, sequence.numbers):
                assert frame.gbuffer.stencil is not None
                sequence.keyframe(number), sequence.invalid(number), sequence.stored_motion(number)
        assert not jax._src.xla_bridge._backends, "a backend was started"
        print("done")
    """
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    result = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, env=environment, timeout=120
    )
    assert result.stdout.strip() == "done", result.stderr
