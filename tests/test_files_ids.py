"""Ids stay apart: hashes as integers and as the bits of floats, colours, filtered masks, and what is static."""

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from jaxtrapolate.errors import InputError
from jaxtrapolate.files import UnrealSequence, open_sequence
from jaxtrapolate.files.ids import LARGEST, Numbering, color_ids
from jaxtrapolate.ops.holes import hole_masks
from jaxtrapolate.records import GBuffer

SIZE = (4, 6)


def store(path, **channels):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {name.replace("_", "."): np.ascontiguousarray(plane) for name, plane in channels.items()}
    OpenEXR.File(header, channels).write(str(path))


def describe(folder, text='stencil = "{frame}.exr"', top=""):
    (folder / "jaxtrapolate.toml").write_text(f"{top}\n[buffers]\n{text}\n")


def filled(*ids, dtype=np.uint32):
    """An image with the ids in stripes, one a column."""
    return np.resize(np.array(ids, dtype), SIZE[1])[None].repeat(SIZE[0], 0)


def stripes(sequence, number):
    """The ids that were read, one a column, after checking that they are integers that float32 holds."""
    stencil = sequence.frame(number).gbuffer.stencil
    assert stencil.dtype == np.float32
    assert stencil.shape == (*SIZE, 1)
    assert (stencil == stencil[:1]).all()
    row = stencil[0, :, 0].astype(np.int64)
    assert (row == stencil[0, :, 0]).all()
    assert row.max() <= LARGEST
    return list(row)


def test_two_hashes_that_float32_rounds_to_one(tmp_path):
    first, second = 0x9E3779B1, 0x9E3779B9
    assert np.float32(first) == np.float32(second)
    store(tmp_path / "1.exr", Y=filled(first))
    store(tmp_path / "2.exr", Y=filled(second))
    describe(tmp_path)
    sequence = open_sequence(tmp_path)
    a, b = (GBuffer(stencil=sequence.frame(n).gbuffer.stencil) for n in (1, 2))
    still = np.zeros((*SIZE, 2), np.float32)
    assert hole_masks(a, b, still).stencil.all()
    assert not hole_masks(a, a, still).any.any()


def test_numbers_do_not_depend_on_the_order_of_reading(tmp_path):
    rng = np.random.default_rng(0)
    hashes = rng.integers(2**24 + 1, 2**32, 18, dtype=np.uint32)
    frames = {n: filled(0, 3, *hashes[4 * n : 4 * n + 4]) for n in range(4)}
    for number, image in frames.items():
        store(tmp_path / f"{number}.exr", Y=image)
    describe(tmp_path)
    sequences = [open_sequence(tmp_path) for _ in range(3)]
    order = ([0, 1, 2, 3], [3, 2, 1, 0], [2])
    read = [{n: stripes(s, n) for n in o} for s, o in zip(sequences, order, strict=True)]
    assert read[0] == read[1]
    assert read[0][2] == read[2][2]
    # Ascending by hash, from 1 on, without 3, which is taken; 0 and 3 are what they were.
    ranks = {h: [1, 2, *range(4, 99)][i] for i, h in enumerate(sorted(hashes[:16]))}
    for number, image in frames.items():
        assert read[0][number] == [0, 3, *(ranks[h] for h in image[0, 2:])]
    assert sequences[0].stored_id(1) == min(hashes[:16])
    assert sequences[0].stored_id(3) == 3
    (note,) = sequences[0].notes
    assert note.startswith("stencil: 16 ids are hashes, which float32 does not keep apart")
    assert note.endswith("here they are numbered 1 to 17")


def test_cryptomatte(tmp_path):
    """Float32 whose bits are hashes, of magnitudes below 0.5, negative, and one that is an integer by chance."""
    bits = np.array([0x00800001, 0x3E3779B1, 0x9E3779B9, 0xFE3779B9, 0x40A00000], np.uint32)
    ids = np.concatenate([[np.float32(0)], bits.view(np.float32)])
    assert ids[5] == 5
    zero = np.zeros(SIZE, np.float32)
    store(tmp_path / "1.exr", Crypto00_r=filled(*ids, dtype=np.float32), Crypto00_g=zero, Crypto00_b=zero)
    store(tmp_path / "2.exr", Crypto00_r=filled(*ids[::-1], dtype=np.float32), Crypto00_g=zero, Crypto00_b=zero)
    text = 'stencil = { file = "{frame}.exr", layer = "Crypto00", channels = "r" }'
    describe(tmp_path, text)
    sequence = open_sequence(tmp_path)
    found = stripes(sequence, 1)
    assert found == [0, 3, 4, 2, 1, 5]  # ascending as floats: -6e37, -1e-20, 1e-38, 0.18
    assert stripes(sequence, 2) == found[::-1]
    assert [sequence.stored_id(n) for n in (1, 2, 3)] == ["fe3779b9", "9e3779b9", "00800001"]
    describe(tmp_path, text, 'static_ids = ["3e3779b1", "FE3779B9"]')
    assert stripes(open_sequence(tmp_path), 1) == [0, 2, 0, 1, 0, 5]


def test_one_hash_that_looks_like_a_filtered_mask(tmp_path):
    """0.3 might be an edge; a layer called crypto says that it is not."""
    store(tmp_path / "1.exr", crypto__object00_R=filled(0, 0.3, dtype=np.float32))
    store(tmp_path / "2.exr", mask_R=filled(0, 0.3, 0.7, 2.6, -1, 7, dtype=np.float32))
    describe(tmp_path, 'stencil = { file = "{frame}.exr", channels = "R" }')
    (tmp_path / "a").mkdir()
    (tmp_path / "2.exr").rename(tmp_path / "a" / "2.exr")
    describe(tmp_path, 'stencil = { file = "{frame}.exr", layer = "crypto..object00", channels = "R" }')
    assert stripes(open_sequence(tmp_path), 1) == [0, 1, 0, 1, 0, 1]
    describe(tmp_path / "a")
    sequence = open_sequence(tmp_path / "a")
    assert stripes(sequence, 2) == [0, 0, 1, 3, 0, 7]
    assert sequence.notes == ()


def test_integers_stay_what_they_are(tmp_path):
    store(tmp_path / "1.exr", Y=filled(0, 1, 255, 70000, LARGEST - 1, LARGEST))
    describe(tmp_path)
    assert stripes(open_sequence(tmp_path), 1) == [0, 1, 255, 70000, LARGEST - 1, LARGEST]
    describe(tmp_path, top="static_ids = [255, 0x1000000]")
    assert stripes(open_sequence(tmp_path), 1) == [0, 1, 0, 70000, LARGEST - 1, 0]


def test_each_colour_is_an_id(tmp_path):
    """Of a picture in colour all three codes count; of grey, as an id has it, the one."""
    colors = [(0, 0, 0), (9, 9, 9), (0, 0, 9), (9, 0, 0), (9, 0, 1), (255, 255, 255)]
    Image.fromarray(np.array([colors] * SIZE[0], np.uint8)).save(tmp_path / "1.png")
    describe(tmp_path, 'stencil = "{frame}.png"')
    found = stripes(open_sequence(tmp_path), 1)
    assert len(set(found)) == 6
    assert found[:2] == [0, 9]
    assert found[4:] == [0x090001, 255]
    Image.fromarray(filled(0, 9, 200, dtype=np.uint8)).save(tmp_path / "1.png")
    assert stripes(open_sequence(tmp_path), 1) == [0, 9, 200] * 2


def test_every_colour_has_its_own_id():
    codes = np.array(np.meshgrid(*[[0, 1, 2, 17, 254, 255]] * 3), np.uint8).reshape(3, -1).T[None]
    grey = np.arange(256, dtype=np.uint8)[None, :, None].repeat(3, 2)
    dark = grey * np.array([0, 0, 1], np.uint8)
    together = np.unique(np.concatenate([codes, grey, dark], 1), axis=1)
    ids = color_ids(together)
    assert len(np.unique(ids)) == together.shape[1]
    assert ids.max() < 2**24
    np.testing.assert_array_equal(color_ids(grey)[0, :, 0], np.arange(256))


def test_unreal_dumps_have_them_too(tmp_path):
    """And what names the static ones applies to every reader."""
    for number in (1, 2):
        store(tmp_path / f"TownMyStencil.{number:04d}.exr", Y=filled(0, 2**31, 2**31 + 1, 12))
    assert stripes(UnrealSequence(tmp_path), 1) == [0, 1, 2, 12, 0, 1]
    (tmp_path / "jaxtrapolate.toml").write_text('static_ids = [12, 0x80000000]\nname = "a town"')
    sequence = open_sequence(tmp_path)
    assert stripes(sequence, 2) == [0, 0, 1, 0, 0, 0]
    assert sequence.name == "a town"


def test_invalid_pixels_stay_invalid(tmp_path):
    store(tmp_path / "1.exr", Y=filled(0, 1e-30, np.nan, np.inf, 2e-30, 3, dtype=np.float32))
    describe(tmp_path)
    sequence = open_sequence(tmp_path)
    assert sequence.nonfinite(1) == 2 * SIZE[0]
    assert set(stripes(sequence, 1)) == {0, 1, 2, 3}


def test_a_thousand_hashes_keep_apart():
    hashes = np.unique(np.random.default_rng(1).integers(0, 2**32, 100_000, dtype=np.uint32))
    numbering = Numbering.of(hashes.astype(np.float64))
    assert len(np.unique(numbering.apply(hashes))) == len(hashes)


def test_a_frame_that_changed_meanwhile(tmp_path):
    for number in (1, 2):
        store(tmp_path / f"{number}.exr", Y=filled(2**30 + number))
    describe(tmp_path)
    sequence = open_sequence(tmp_path)
    assert stripes(sequence, 1)[0] == 1
    store(tmp_path / "2.exr", Y=filled(2**31))
    with pytest.raises(InputError, match=f"{tmp_path}: the stencil has an id that was not there"):
        sequence.frame(2)
