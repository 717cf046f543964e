"""Changed and hostile files: every reader ends in a result or one documented line, and starts and prints nothing."""

import fuzz_readers
import pytest

SHORT = {"exr": 30, "png": 20, "tiff": 20, "image": 20, "toml": 30, "json": 12, "npz": 15, "torch": 20, "jitter": 12}


def test_a_few_inputs_of_every_kind(tmp_path, monkeypatch, capfd):
    (tmp_path / "run").mkdir()
    for name, value in fuzz_readers.trap(tmp_path).items():
        monkeypatch.setenv(name, value)
    kinds = {kind: range(count) for kind, count in SHORT.items()}
    count = fuzz_readers.run(kinds, 0, tmp_path / "run", printed=lambda: "".join(capfd.readouterr()))
    count.programs = fuzz_readers.started(tmp_path)
    assert fuzz_readers.faults(count) == []
    assert count.inputs == count.accepted + count.refused == sum(SHORT.values())
    assert count.accepted >= 10
    assert count.refused >= 80


def test_what_must_not_be_is_noticed(tmp_path, monkeypatch, capfd):
    """Readers that do what no reader may do are found out."""

    def recursion(path):
        return recursion(path)

    def prints(_):
        print("libsomething: bad marker")

    def nameless(_):
        raise fuzz_readers.refusals("json")[0]("damaged")

    def waits(path):
        while True:
            pass

    def starts(_):
        import subprocess

        subprocess.run(["gs", "--version"], check=False)

    (tmp_path / "trap").mkdir()
    for name, value in fuzz_readers.trap(tmp_path / "trap").items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(fuzz_readers, "SECONDS", 0.2)
    found = {}
    for k, reader in enumerate((recursion, prints, nameless, waits, starts)):
        monkeypatch.setattr("jaxtrapolate.files.text.read_json", reader)
        folder = tmp_path / str(k)
        folder.mkdir()
        special = len(fuzz_readers.SPECIAL["json"])
        kinds = {"json": range(special, special + 1)}
        count = fuzz_readers.run(kinds, 0, folder, printed=lambda: "".join(capfd.readouterr()))
        count.programs = fuzz_readers.started(tmp_path / "trap")
        (found[reader.__name__],) = fuzz_readers.faults(count)
    assert "RecursionError" in found["recursion"]
    assert "bad marker" in found["prints"]
    assert "does not name the file" in found["nameless"]
    assert found["waits"].startswith("json ")
    assert found["starts"] == "1 programs started"


@pytest.mark.slow
def test_thousands_of_inputs():
    count = fuzz_readers.fuzz(4000, 1)
    assert fuzz_readers.faults(count) == []
    assert count.inputs > 3900
    assert count.largest_mib < 1500
