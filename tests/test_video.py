"""Videos: layout, files of each kind, and what cannot be written."""

import importlib.util
import subprocess

import numpy as np
import pytest
from PIL import Image

from jaxtrapolate import report
from jaxtrapolate.errors import InputError
from jaxtrapolate.report import side_by_side, write_video

COLORS = np.uint8([[200, 30, 40], [20, 180, 60], [40, 60, 220]])


def flat(color, size=(90, 160)):
    return np.full((*size, 3), color, np.uint8)


def frames(count):
    """Sheets of two panels, the right one of which changes its colour."""
    for i in range(count):
        yield side_by_side([flat(COLORS[0]), flat(COLORS[i % 3])], ["left", "right"])


@pytest.mark.parametrize(
    "count, size, columns",
    [(2, (180, 320), 2), (5, (180, 320), 5), (5, (540, 960), 3), (3, (18, 32), 3), (4, (7, 9), 4)],
)
def test_panels_are_side_by_side_where_they_are_largest(count, size, columns):
    sheet = side_by_side([flat((10 * i, 0, 255), size) for i in range(count)], [f"m{i}" for i in range(count)])
    assert sheet.width % 2 == sheet.height % 2 == 0
    assert sheet.width <= 1920 + 2 * columns
    pixels = np.asarray(sheet)
    blue = (pixels == (0, 0, 255)).all(-1)  # the first panel
    height, width = blue.any(1).sum(), blue.any(0).sum()
    assert width / height == pytest.approx(size[1] / size[0], rel=0.02)
    assert round(sheet.width / (width + 2)) == columns
    assert width >= min(160, size[1])
    for i in range(count):
        panel = (pixels == (10 * i, 0, 255)).all(-1)
        assert panel.sum() == height * width
        assert panel.any(1).argmax() == i // columns * (height + 22) + 22
    assert (pixels[:22, :width].max(-1) > 150).any()  # the label


def test_a_long_label_stays_in_its_column():
    sheet = np.asarray(side_by_side([flat(0), flat(0)], ["x" * 200, ""]))
    assert (sheet[:22, :160].max(-1) > 150).any()
    assert not (sheet[:22, 162:].max(-1) > 150).any()


@pytest.mark.parametrize("kind", ["webp", "gif"])
def test_animated_images(tmp_path, kind):
    path = tmp_path / f"video.{kind}"
    write_video(path, frames(5), count=5, fps=25)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    with Image.open(path) as image:
        assert image.n_frames == 5
        assert image.info["loop"] == 0
        for i in range(5):
            image.seek(i)
            right = np.asarray(image.convert("RGB"))[40:100, 180:300].reshape(-1, 3)
            np.testing.assert_allclose(right.mean(0), COLORS[i % 3], atol=8)
            image.load()
            assert image.info["duration"] == 40


def test_one_frame_is_a_still(tmp_path):
    write_video(tmp_path / "a.webp", frames(1), count=1, fps=30)
    with Image.open(tmp_path / "a.webp") as image:
        assert image.n_frames == 1


def test_frames_are_taken_one_by_one(tmp_path):
    """Of many frames only few live at a time."""
    import weakref

    alive, most = weakref.WeakSet(), 0

    class Counted:
        pass

    def counted():
        nonlocal most
        for sheet in frames(12):
            token = Counted()
            sheet.info["token"] = token
            alive.add(token)
            del token
            most = max(most, len(alive))
            yield sheet
            del sheet

    write_video(tmp_path / "a.webp", counted(), count=12, fps=30)
    assert most <= 4


def test_mp4(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "video.mp4"
    write_video(path, frames(6), count=6, fps=30)
    command = [ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    assert b"322x112" in done.stderr
    assert b"30 fps" in done.stderr
    seen = np.frombuffer(done.stdout, np.uint8).reshape(-1, 112, 322, 3)
    assert len(seen) == 6
    for i, frame in enumerate(seen):
        np.testing.assert_allclose(frame[40:100, 180:300].reshape(-1, 3).mean(0), COLORS[i % 3], atol=25)


def test_mp4_without_its_package(tmp_path, monkeypatch):
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "imageio_ffmpeg" else real(name))
    with pytest.raises(InputError, match=r'a.mp4: MP4 needs .* pip install "jaxtrapolate\[video\]", or choose .webp'):
        write_video(tmp_path / "a.mp4", frames(2), count=2, fps=30)
    report.check_video_format("a.gif")


def test_an_ffmpeg_that_fails_is_one_line(tmp_path, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    with pytest.raises(InputError, match=r"choose \.webp") as error:
        write_video(tmp_path / "a.mp4", frames(400), count=400, fps=30)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_names_that_say_no_format(tmp_path):
    for name in ("video", "video.png", "video.webp.txt"):
        with pytest.raises(InputError, match=r"ends in one of .webp, .gif, .mp4"):
            write_video(tmp_path / name, frames(1), count=1, fps=30)
    with pytest.raises(InputError, match="its folder does not exist"):
        write_video(tmp_path / "nowhere" / "a.webp", frames(1), count=1, fps=30)
