"""Depth where nothing is, in every reader: not positive, under a mask, outside the data window, beyond limits."""

import numpy as np
import OpenEXR
import pytest

from jaxtrapolate.files import UnrealSequence, open_sequence, write_exr, write_unreal_frame
from jaxtrapolate.records import Frame, GBuffer

SIZE = (4, 6)
INF = np.inf


def store(path, channels, *, window=None, size=SIZE):
    """An EXR by OpenEXR itself; window: x0, y0 of the data in a display of `size`."""
    first = next(iter(channels.values()))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if window is not None:
        x, y = window
        end = np.array([x + first.shape[1] - 1, y + first.shape[0] - 1], np.int32)
        header["dataWindow"] = (np.array([x, y], np.int32), end)
        header["displayWindow"] = (np.zeros(2, np.int32), np.array([size[1] - 1, size[0] - 1], np.int32))
    planes = {name: np.ascontiguousarray(plane, np.float32) for name, plane in channels.items()}
    OpenEXR.File(header, planes).write(str(path))


def describe(folder, text, top=""):
    (folder / "jaxtrapolate.toml").write_text(f"{top}\n[buffers]\n{text}\n")
    return open_sequence(folder)


def stripes(*values):
    return np.resize(np.array(values, np.float32), SIZE[1])[None].repeat(SIZE[0], 0)


def row(image):
    image = np.asarray(image)[..., 0]
    assert (image == image[:1]).all()
    return list(image[0])


@pytest.mark.parametrize("empty", [0, -1, INF])
def test_depth_that_is_not_positive(tmp_path, empty):
    store(tmp_path / "1.exr", {"Z": stripes(2, empty, 3)})
    store(tmp_path / "2.exr", {"Z": stripes(2, 4, 3)})
    sequence = describe(tmp_path, 'depth = { file = "{frame}.exr", scale = 10 }')
    buffers = sequence.frame(1).gbuffer
    assert row(buffers.depth) == [20, INF, 30] * 2
    assert row(buffers.sky) == [0, 1, 0] * 2
    assert row(sequence.frame(2).gbuffer.sky) == [0] * 6  # the same structure in every frame
    assert sequence.no_depth(1) == {"infinite" if empty == INF else "not positive": 8}
    assert sequence.no_depth(2) == {}
    assert sequence.nonfinite(1) == 0


def test_a_mask_says_better(tmp_path):
    store(tmp_path / "1.exr", {"Z": stripes(2, 7, 1e7), "A": stripes(1, 0, 1)})
    sequence = describe(
        tmp_path,
        'depth = { file = "{frame}.exr", channels = "Z" }\n'
        'sky = { file = "{frame}.exr", channels = "A", invert = true }',
    )
    buffers = sequence.frame(1).gbuffer
    assert row(buffers.depth) == [2, INF, 1e7] * 2
    assert row(buffers.sky) == [0, 1, 0] * 2
    assert sequence.no_depth(1) == {"under the sky mask": 8}


@pytest.mark.parametrize(
    "limits, expected",
    [
        ("nothing_above = 1000", [4, INF, 1998, INF, 12, INF]),
        ("nothing_below = 3", [INF, INF, 1998, INF, 12, 4000]),
        ("nothing_above = 99, nothing_below = 2", [4, INF, INF, INF, 12, INF]),
    ],
)
def test_limits_of_depth_are_of_stored_values(tmp_path, limits, expected):
    store(tmp_path / "1.exr", {"Z": stripes(2, 0, 999, -1, 6, 2000)})
    buffers = describe(tmp_path, f'depth = {{ file = "{{frame}}.exr", scale = 2, {limits} }}').frame(1).gbuffer
    assert row(buffers.depth) == expected
    assert row(buffers.sky) == [float(value == INF) for value in expected]


def test_masks_by_both_limits(tmp_path):
    store(tmp_path / "1.exr", {"Z": stripes(2, 0.5, 9)})
    buffers = describe(tmp_path, 'sky = { file = "{frame}.exr", above = 8, below = 1 }').frame(1).gbuffer
    assert row(buffers.sky) == [0, 1, 1] * 2


def test_outside_the_data_window(tmp_path):
    inside = np.zeros(SIZE, bool)
    inside[1:3, 2:5] = True
    data = {name: np.full((2, 3), 4.0) for name in ("R", "G", "B", "Z")}
    store(tmp_path / "1.exr", data, window=(2, 1))
    text = 'color = "{frame}.exr"\ndepth = { file = "{frame}.exr", channels = "Z" }'
    frame = describe(tmp_path, text).frame(1)
    np.testing.assert_array_equal(frame.color, np.where(inside[..., None], 4, 0).repeat(3, -1))
    np.testing.assert_array_equal(frame.gbuffer.depth[..., 0], np.where(inside, 4, INF))
    np.testing.assert_array_equal(frame.gbuffer.sky[..., 0], ~inside)
    # Scaled, moved and turned round: outside is outside all the same. A stated mask says nothing there either.
    mask = '\nsky = { file = "{frame}.exr", channels = "R", above = 9 }'
    turned = text.replace('"Z"', '"Z", scale = -1, offset = 5, invert = false') + mask
    buffers = describe(tmp_path, turned).frame(1).gbuffer
    np.testing.assert_array_equal(buffers.depth[..., 0], np.where(inside, 1, INF))
    np.testing.assert_array_equal(buffers.sky[..., 0], ~inside)
    # A mask from a file that is whole is believed.
    store(tmp_path / "a1.exr", {"Y": np.zeros(SIZE)})
    buffers = describe(tmp_path, text + '\nsky = "a{frame}.exr"').frame(1).gbuffer
    assert not buffers.sky.any()
    np.testing.assert_array_equal(buffers.depth[..., 0], np.where(inside, 4, INF))


def test_a_data_window_beyond_the_frame_hides_nothing(tmp_path):
    store(tmp_path / "1.exr", {"Z": np.full((8, 10), 4.0)}, window=(-2, -1))
    buffers = describe(tmp_path, 'depth = "{frame}.exr"').frame(1).gbuffer
    assert (buffers.depth == 4).all()
    assert not buffers.sky.any()


def test_the_window_of_an_unreal_dump(tmp_path):
    name = "Town{}.0001.exr"
    normal = {n: np.full((2, 3), v) for n, v in zip("RGB", (0, 0, 1), strict=True)}
    normal["B"][0, 0] = normal["G"][0, 0] = normal["R"][0, 0] = -1
    store(tmp_path / name.format("SceneDepth"), {"Y": np.full((2, 3), 0.05)}, window=(2, 1))
    store(tmp_path / name.format("WorldNormal"), normal, window=(2, 1))
    buffers = open_sequence(tmp_path).frame(1).gbuffer
    seen = np.zeros(SIZE, bool)
    seen[1:3, 2:5] = True
    seen[1, 2] = False  # the sky's normal
    np.testing.assert_allclose(buffers.depth[..., 0], np.where(seen, 500, INF), rtol=1e-6)
    np.testing.assert_array_equal(buffers.sky[..., 0], ~seen)
    np.testing.assert_array_equal(buffers.normal[..., 2], seen)


def test_unreal_sky_by_the_normal_and_by_depth(tmp_path):
    """The dump's own large number for the sky, and 0, are far."""
    name = "Town{}.0001.exr"
    normal = stripes(0, -1, 0.5)
    store(tmp_path / name.format("SceneDepth"), {"Y": stripes(0.05, 1e3, 0)})
    store(tmp_path / name.format("WorldNormal"), dict.fromkeys("RGB", normal))
    sequence = open_sequence(tmp_path)
    buffers = sequence.frame(1).gbuffer
    np.testing.assert_allclose(row(buffers.depth), [500, INF, INF] * 2)
    assert row(buffers.sky) == [0, 1, 1] * 2
    assert sequence.no_depth(1) == {"not positive": 8, "under the sky mask": 8}


@pytest.mark.parametrize("sky", ["none", "of depth", "more", "soft", "less"])
@pytest.mark.parametrize("normals", [False, True])
def test_what_is_written_reads_back(tmp_path, sky, normals):
    """Infinite depth, masks that follow from it or do not, and ids that half floats do not hold."""
    depth = stripes(2, INF, 3, 1e6, 40, 5)[..., None]
    mask = {
        "of depth": stripes(0, 1, 0, 0, 0, 0),
        "more": stripes(0, 1, 1, 0, 0, 0),
        "soft": stripes(0, 1, 0.25, 0.5, 0, 0),
        "less": stripes(0, 0, 0, 0, 0, 0),
    }.get(sky)
    normal = np.stack([stripes(0), stripes(0), stripes(1)], -1) * (1 if mask is None else mask[..., None] < 1)
    ids = stripes(0, 2049, 70000, 2**24, 3, 1)[..., None]
    written = GBuffer(
        depth=depth,
        stencil=ids,
        sky=None if mask is None else mask[..., None],
        normal=normal.astype(np.float32) if normals else None,
    )
    write_unreal_frame(tmp_path, "A", 1, Frame(gbuffer=written))
    read = UnrealSequence(tmp_path).frame(1).gbuffer
    expected = stripes(0, 1, 0, 0, 0, 0) if mask is None else mask
    np.testing.assert_array_equal(read.sky[..., 0], expected)
    np.testing.assert_allclose(read.depth, np.where(expected[..., None] > 0.5, INF, depth), rtol=1e-6)
    np.testing.assert_array_equal(read.stencil, ids)
    if normals:
        np.testing.assert_array_equal(read.normal, normal)


def test_ordinal_depth_is_positive_in_the_same_order(tmp_path):
    values = [-3e4, -1.5, -1e-3, 0.0, 1e-3, 7.0]
    store(tmp_path / "1.exr", {"Z": stripes(*values)})
    write_exr(tmp_path / "2.exr", stripes(INF, 1, 2, 0, -9, 3), half=False)
    sequence = describe(tmp_path, 'depth = "{frame}.exr"', 'depth = "ordinal"')
    depth = row(sequence.frame(1).gbuffer.depth)
    exact = [v + 1 / 256 if v >= 0 else 1 / (256 - 65536 * v) for v in values]
    np.testing.assert_allclose(depth, exact, rtol=1e-5)
    assert depth == sorted(set(depth))
    assert depth[0] > 0
    assert not sequence.frame(1).gbuffer.sky.any()
    second = row(sequence.frame(2).gbuffer.depth)
    assert second[0] == INF
    assert sequence.no_depth(2) == {"infinite": 4}
    # Stored as larger = nearer: 1 is the nearest and no sky.
    store(tmp_path / "1.exr", {"Z": stripes(1, 0.5, 0)})
    inverted = describe(tmp_path, 'depth = { file = "{frame}.exr", invert = true }', 'depth = "ordinal"')
    np.testing.assert_allclose(row(inverted.frame(1).gbuffer.depth)[:3], [1 / 256, 0.5 + 1 / 256, 1 + 1 / 256])
    limited = 'depth = { file = "{frame}.exr", invert = true, nothing_below = 0.1 }'
    assert row(describe(tmp_path, limited, 'depth = "ordinal"').frame(1).gbuffer.depth)[2] == INF
