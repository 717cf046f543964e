"""Output folders: what may go on, what is refused, one run at a time, and what killed processes leave."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from synthetic import SyntheticSequence

from jaxtrapolate.atomic import atomic_path, sweep
from jaxtrapolate.errors import InputError
from jaxtrapolate.runtime import output as module
from jaxtrapolate.runtime.output import RECORD, differences, open_output, read_json, write_json


class Files(SyntheticSequence):
    """Frames that are said to be in files of a folder, `<number>.a` and `<number>.b`."""

    def __init__(self, folder, numbers=range(4)):
        super().__init__(numbers)
        self.folder = folder

    def files(self, number):
        return {path.suffix[1:]: path for path in sorted(self.folder.glob(f"{number}.*"))}


@pytest.fixture
def inputs(tmp_path):
    folder = tmp_path / "inputs"
    folder.mkdir()
    for number in range(4):
        for kind in "ab":
            (folder / f"{number}.{kind}").write_text(f"{number} {kind}")
    return Files(folder)


def used(folder, settings=None, *, command="generate", write="0000.exr", **options):
    """A run that writes a file."""
    with open_output(folder, command, settings or {"method": "warp"}, **options) as output:
        (output.folder / write).write_text("content")


def test_equal_settings_go_on_and_others_are_refused(tmp_path):
    used(tmp_path / "out", {"method": "warp", "factor": 2, "weights": None})
    used(tmp_path / "out", {"method": "warp", "factor": 2, "weights": None}, write="0001.exr")
    with pytest.raises(InputError) as error:
        used(tmp_path / "out", {"method": "guided_warp", "factor": 3, "weights": None})
    text = str(error.value)
    assert 'method was "warp", is now "guided_warp"; factor was 2, is now 3' in text
    assert "start anew with fresh, which" in text
    assert "start anew with --fresh, which" in error.value.on_command_line
    assert "\n" not in text
    with pytest.raises(InputError, match='command was "generate", is now "render"'):
        used(tmp_path / "out", {"method": "warp", "factor": 2, "weights": None}, command="render")


def test_other_code_is_refused(tmp_path, monkeypatch):
    used(tmp_path)
    monkeypatch.setattr(module, "code", lambda: "12345678")
    with pytest.raises(InputError, match=r"the package's code was [0-9a-f]{8}, is now 12345678"):
        used(tmp_path)
    with open_output(tmp_path, "generate", {"method": "warp"}, any_code=True) as output:
        assert len(output.code_before or "") == 8
    used(tmp_path)


def test_the_code_has_a_hash_that_knows_every_module(tmp_path, monkeypatch):
    module.code.cache_clear()
    before = module.code()
    copy = tmp_path / "jaxtrapolate"
    shutil.copytree(Path(module.__file__).parents[1], copy, ignore=shutil.ignore_patterns("*.npz", "__pycache__"))
    monkeypatch.setattr(module.resources, "files", lambda name: copy)
    module.code.cache_clear()
    assert module.code() == before
    with (copy / "methods" / "warping.py").open("a") as file:
        file.write("\n")
    module.code.cache_clear()
    assert module.code() != before
    module.code.cache_clear()


def test_fresh_deletes_what_the_run_wrote_and_no_more(tmp_path):
    used(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    used(tmp_path, {"method": "blend"}, fresh=True, write="0002.5.exr")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0002.5.exr", "notes.txt", RECORD]
    used(tmp_path, {"scene": "demo"}, command="evaluate", fresh=True, write="report.html")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["notes.txt", "report.html", RECORD]


def test_files_that_no_record_explains_are_not_touched(tmp_path):
    (tmp_path / "0000.exr").write_text("somebody's")
    for fresh in (False, True):
        with pytest.raises(InputError, match=r"holds 0000.exr, and no run.json"):
            used(tmp_path, fresh=fresh)
    assert (tmp_path / "0000.exr").read_text() == "somebody's"


@pytest.mark.parametrize("content", ["", "{", "[]", '{"settings": 1, "code": "", "parts": {}}', "[" * 100_000])
def test_a_damaged_record(tmp_path, content):
    (tmp_path / RECORD).write_text(content)
    with pytest.raises(InputError, match="damaged; choose another folder, or start anew with fresh"):
        used(tmp_path)
    used(tmp_path, fresh=True)


def test_a_record_that_is_a_folder(tmp_path):
    (tmp_path / RECORD).mkdir()
    with pytest.raises(InputError, match="is a folder"):
        used(tmp_path)


def test_nothing_stays_of_a_run_that_wrote_nothing(tmp_path):
    with pytest.raises(ValueError), open_output(tmp_path / "out", "generate", {}):  # noqa: PT011
        raise ValueError
    assert list((tmp_path / "out").iterdir()) == []


def test_inputs_are_known_by_content(tmp_path, inputs):
    def agree(sequence, numbers=(0, 1)):
        with open_output(tmp_path / "out", "generate", {}) as output:
            output.agree_frames(sequence, numbers)
            (output.folder / "0000.exr").touch()

    agree(inputs)
    agree(inputs)
    os.utime(inputs.folder / "0.a", (1, 1))  # touched, not changed
    agree(inputs)
    copy = tmp_path / "elsewhere"
    shutil.copytree(inputs.folder, copy, copy_function=shutil.copy)
    agree(Files(copy), (0, 1, 2))
    (copy / "3.b").write_text("3 c")  # not used so far
    agree(Files(copy), (0, 1, 2))
    stat = (copy / "1.b").stat()
    (copy / "1.b").write_text("1 c")
    os.utime(copy / "1.b", ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
    with pytest.raises(InputError, match=r"1.b \(frame 1 of the input\) has changed since"):
        agree(Files(copy), (0, 1, 2))
    agree(Files(copy), (0, 2))
    (copy / "2.a").unlink()
    with pytest.raises(InputError, match=r"frame 2 of the input: 2.a came or went since"):
        agree(Files(copy), (0, 2))


def test_a_file_is_hashed_once(tmp_path, inputs):
    told = []
    with open_output(tmp_path / "out", "generate", {}) as output:
        for _ in range(2):
            output.agree_frames(inputs, (0, 1), step=lambda text, done, total: told.append((done, total)))
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_parts_are_merged(tmp_path):
    def agree(**weights):
        with open_output(tmp_path, "evaluate", {}) as output:
            output.agree("weights", weights)
            (output.folder / "results.json").touch()

    agree(extranet="1a")
    agree(interpolator="2b")
    with pytest.raises(InputError, match='weights: extranet was "1a", is now "3c"'):
        agree(extranet="3c", interpolator="2b")
    agree(extranet="1a", interpolator="2b")


HOLD = """
import sys, time
from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.runtime.output import open_output
with open_output(sys.argv[1], "generate", {"method": "warp"}) as output, atomic_path(output.folder / "0000.exr"):
    print("ready", flush=True)
    time.sleep(60)
"""


def test_one_run_at_a_time_and_what_a_kill_leaves(tmp_path):
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "ready\n"
        with pytest.raises(InputError, match="another run is at work there"):
            used(tmp_path)
        (left,) = tmp_path.glob(".0000.exr.*.tmp")
        assert sweep(tmp_path) == 0  # it lives
        assert left.exists()
        other.send_signal(signal.SIGKILL)
    used(tmp_path, write="0001.exr")
    assert not left.exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0001.exr", RECORD]


def test_sweeping_spares_this_process_and_other_names(tmp_path):
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / ".a.png.0123abcd.tmp").touch()
    (tmp_path / ".mine.tmp").touch()
    with atomic_path(tmp_path / "b.png") as temporary:
        assert sweep(tmp_path) == 1
        assert temporary.exists()
    assert sorted(p.name for p in tmp_path.rglob("*")) == [".mine.tmp", "b.png", "below"]


def test_json_that_cannot_be_read(tmp_path):
    path = tmp_path / "a.json"
    assert read_json(path) is None
    write_json(path, {"a": [1.5, float("inf"), float("nan")]})
    assert read_json(path) == {"a": [1.5, "inf", None]}
    assert json.loads(path.read_text())["a"] == [1.5, "inf", None]
    for content in (b"\xff", b"{", b"[" * 100_000):
        path.write_bytes(content)
        assert read_json(path) is None
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match="is a folder"):
        read_json(path)


def test_differences_are_named_in_full():
    assert differences({"a": {"b": 1}, "c": 2}, {"a": {"b": 1}, "c": 2}) == ""
    assert differences({"a": {"b": 1}}, {"a": {"b": 2}, "d": 3}) == "a.b was 1, is now 2; d was not there, is now 3"
    old, new = {"a": {"b": 1, "bc": 1}, "d": {"e": 1}}, {"a": {"b": 2, "bc": 2}, "d": {"e": 2}}
    assert differences(old, new, free=("d", "a.b")) == "a.bc was 1, is now 2"
