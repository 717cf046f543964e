"""Output folders: one run at a time, and a later run of the same settings goes on where it ended.

A folder that a command writes to holds `run.json`: the command, its settings, the hash of the package's code, the files
of the input by frame, and whatever else the results depend on. A run whose record agrees may use what is there already.
Any other is refused in one line that says what differs; `fresh` removes what the earlier run wrote and starts anew.
While a run lasts it holds a lock on `.run.lock`, which the system releases however the process ends.

Files of the input are compared by size and time of modification, and by their SHA-256 where those differ: a copied
folder is the same input, a file that was rendered again is not. Each file is read once for that, when it is first used.
"""

import concurrent.futures
import contextlib
import functools
import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from jaxtrapolate.atomic import atomic_path, hold, os_input_error, sweep
from jaxtrapolate.errors import InputError
from jaxtrapolate.files.sequence import Sequence

RECORD = "run.json"
"""The file in an output folder that says what generated its content."""
_LOCK = ".run.lock"
_WRITES = {
    "generate": ("generate.json", "[-0-9]*.exr", "[-0-9]*.png"),
    "render": ("*.exr",),
    "evaluate": ("results.json", "report.html", "scores", "pictures", "video.*"),
    "train": ("metrics.jsonl", "batch-*.npz", "checkpoints", "images", "model"),
}
"""What each command writes into its folder: what `fresh` removes, and what no earlier run may have left unrecorded."""

Step = Callable[[str, float, float], None]


class Output:
    """An output folder in use; see `open_output`.

    Attributes:
        folder: its path.
        code_before: the hash of the code by which the folder's files were written, where it is not this one's.
    """

    def __init__(self, folder: Path, record: dict[str, Any], *, writes: bool) -> None:
        self.folder = folder
        self.code_before: str | None = None
        self._record, self._writes = record, writes

    def agree(self, kind: str, entries: Mapping[str, Any]) -> None:
        """Records what a part of the results depends on, by its name: a method's weights, say.

        Args:
            kind: of the parts.
            entries: by part, what JSON holds. Parts that the record has and this run does not ask for stay recorded.

        Raises:
            InputError: an entry differs from what the folder's results were computed from.
        """
        known = self._record["parts"].setdefault(kind, {})
        entries = json.loads(json.dumps(dict(entries)))
        both = [name for name in entries if name in known]
        if text := differences({n: known[n] for n in both}, {n: entries[n] for n in both}):
            raise self._other(f"{kind}: {text}")
        if any(name not in known for name in entries):
            known |= entries
            self._save()

    def agree_frames(
        self, sequence: Sequence, numbers: Iterable[int], *, kind: str = "frames", step: Step | None = None
    ) -> None:
        """Records the files that some frames of an input are read from.

        Args:
            sequence: the input; one that reads no files has none to compare.
            numbers: of the frames that the results depend on.
            kind: the part's name, where there are several inputs.
            step: told how many files were read, of how many.

        Raises:
            InputError: a frame has other files than when the folder's results were computed, or a file's content
                differs, or it cannot be read.
        """
        known: dict[str, dict[str, list]] = self._record["parts"].setdefault(kind, {})
        stated: dict[str, dict[str, list]] = {}
        unread: list[tuple[str, str, Path]] = []
        for number in numbers:
            files = {_name(sequence, path): path for path in sequence.files(number).values()}
            before = known.get(str(number))
            if before is not None and set(before) != set(files):
                changed = sorted(set(before) ^ set(files))
                raise self._other(f"frame {number} of the input: {', '.join(changed[:3])} came or went since")
            stated[str(number)] = {name: _state(path) for name, path in files.items()}
            for name, path in files.items():
                if before is None or before[name][:2] != stated[str(number)][name]:
                    unread.append((str(number), name, path))
        hashes = _hashes([path for _, _, path in unread], step)
        for number, name, path in unread:
            if number in known and known[number][name][2] != hashes[path]:
                raise self._other(f"{name} (frame {number} of the input) has changed since")
            stated[number][name].append(hashes[path])
        for number, files in stated.items():
            for name, state in files.items():
                if len(state) == 2:
                    state.append(known[number][name][2])
        if any(known.get(number) != files for number, files in stated.items()):
            known |= stated
            self._save()

    def _other(self, text: str) -> InputError:
        return InputError(f"{self.folder}: holds another run's files: {text}; {_REMEDY}", argument="fresh")

    def _save(self) -> None:
        if self._writes:
            write_json(self.folder / RECORD, self._record)


_REMEDY = "choose another folder, or start anew with {argument}, which deletes them"


@contextlib.contextmanager
def open_output(
    folder: str | os.PathLike[str],
    command: str,
    settings: Mapping[str, Any],
    *,
    fresh: bool = False,
    any_code: bool = False,
    writes: bool = True,
) -> Iterator[Output]:
    """An output folder for one run: created if need be, locked, swept of what killed runs left, and its record checked.

    Args:
        folder: where to.
        command: which of the commands writes there.
        settings: all that its results depend on, but for the code and what `Output.agree` is told; what JSON holds.
        fresh: delete what the recorded run wrote.
        any_code: go on also where the record is of other code of this package.
        writes: False for the processes of a run over several hosts that leave writing to the first.

    Raises:
        InputError: another run is at work there; the record is of other settings, damaged, or there is none beside
            files that this command would write; no permission, or the disk is full.
    """
    path = writable_folder(folder)
    settings = json.loads(json.dumps({"command": command, **settings}))
    with _locked(path) if writes else contextlib.nullcontext():
        if writes:
            sweep(path)
        record = _read_record(path, command, damaged_is_none=fresh)
        if record is not None and fresh and writes:
            _clear(path, {command, record["settings"].get("command", command)})
            record = None
        if record is None:
            if writes and (found := _found(path, command)):
                raise InputError(
                    f"{path}: holds {found}, and no {RECORD} that says what generated it; choose another folder"
                )
            record = {"settings": settings, "code": code(), "parts": {}}
            output = Output(path, record, writes=writes)
            output._save()
        else:
            if text := differences(record["settings"], settings):
                raise InputError(f"{path}: holds another run's files: {text}; {_REMEDY}", argument="fresh")
            output = Output(path, record, writes=writes)
            if record["code"] != code():
                if not any_code:
                    raise output._other(f"the package's code was {record['code']}, is now {code()}")
                output.code_before, record["code"] = record["code"], code()
                output._save()
        try:
            yield output
        finally:
            if writes and _found(path, command) is None:  # nothing came of it: nothing stays
                with contextlib.suppress(OSError):
                    (path / RECORD).unlink()


def writable_folder(folder: str | os.PathLike[str]) -> Path:
    """A folder, created if need be, that can be written to; raises `InputError`."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise os_input_error(path, error, action="write") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{path}: no permission to write there; change its permissions or choose another folder")
    return path


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Holds the folder's lock, whose file is gone afterwards."""
    path = folder / _LOCK
    while True:
        try:
            descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        except OSError as error:
            raise os_input_error(path, error, action="write") from error
        if not hold(descriptor):
            os.close(descriptor)
            raise InputError(f"{folder}: another run is at work there; wait for its end, or choose another folder")
        with contextlib.suppress(OSError):
            if os.fstat(descriptor).st_ino == os.stat(path).st_ino:
                break
        os.close(descriptor)  # it was another run's, which has just removed it
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            path.unlink()
        os.close(descriptor)


def _read_record(folder: Path, command: str, *, damaged_is_none: bool) -> dict[str, Any] | None:
    path = folder / RECORD
    if not path.exists():
        return None
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise os_input_error(path, error) from error
    except (ValueError, RecursionError):
        record = None
    kinds = {"settings": dict, "code": str, "parts": dict}
    if isinstance(record, dict) and all(isinstance(record.get(key), kind) for key, kind in kinds.items()):
        return record
    if damaged_is_none:
        return {"settings": {"command": command}, "code": "", "parts": {}}
    raise InputError(f"{path}: damaged; choose another folder, or start anew with {{argument}}", argument="fresh")


def _found(folder: Path, command: str) -> str | None:
    """A file that the command would write and that is there already, if any."""
    return next((p.name for pattern in _WRITES[command] for p in sorted(folder.glob(pattern))), None)


def _clear(folder: Path, commands: Iterable[str]) -> None:
    """Deletes what runs of these commands have written, their record last."""
    patterns = [pattern for command in commands for pattern in _WRITES.get(command, ())]
    for path in [p for pattern in patterns for p in sorted(folder.glob(pattern))] + [folder / RECORD]:
        try:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise os_input_error(path, error, action="write") from error


def _name(sequence: Sequence, path: Path) -> str:
    """A file's path relative to its sequence's folder: the same in a copy of it."""
    folder = getattr(sequence, "folder", None)
    return Path(os.path.relpath(path, folder) if folder is not None else path).as_posix()


def _state(path: Path) -> list:
    """Size and time of modification."""
    try:
        stat = path.stat()
    except OSError as error:
        raise os_input_error(path, error) from error
    return [stat.st_size, stat.st_mtime_ns]


def _hashes(paths: list[Path], step: Step | None) -> dict[Path, str]:
    """The SHA-256 of each file."""

    def digest(path: Path) -> str:
        try:
            with path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise os_input_error(path, error) from error

    found: dict[Path, str] = {}
    unique = list(dict.fromkeys(paths))
    with concurrent.futures.ThreadPoolExecutor(4) as threads:
        for path, value in zip(unique, threads.map(digest, unique), strict=True):
            found[path] = value
            if step is not None:
                step("read input", len(found), len(unique))
    return found


@functools.cache
def code() -> str:
    """Eight hexadecimal digits of the SHA-256 of the package's modules: another state of the code has another."""
    digest = hashlib.sha256()

    def add(folder: Any, prefix: str) -> None:
        for entry in sorted(folder.iterdir(), key=lambda e: e.name):
            if entry.is_dir():
                add(entry, f"{prefix}{entry.name}/")
            elif entry.name.endswith(".py"):
                content = entry.read_bytes()
                digest.update(f"{prefix}{entry.name} {len(content)}\n".encode() + content)

    add(resources.files("jaxtrapolate"), "")
    return digest.hexdigest()[:8]


def differences(old: Mapping[str, Any], new: Mapping[str, Any], *, free: Iterable[str] = ()) -> str:
    """What differs between two nested tables that JSON can hold, by the names of their entries; empty if nothing.

    Args:
        old: a table.
        new: a later one.
        free: names, as "table.entry", of entries or tables that may differ.
    """
    before, after = (_flat(json.loads(json.dumps(table))) for table in (old, new))
    differ = [k for k in {**before, **after} if before.get(k) != after.get(k)]
    differ = [k for k in differ if not any(f"{k}.".startswith(f"{name}.") for name in free)]
    return "; ".join(f"{k} was {_show(before, k)}, is now {_show(after, k)}" for k in differ)


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {prefix: value}
    return {k: v for key, sub in value.items() for k, v in _flat(sub, f"{prefix}.{key}" if prefix else key).items()}


def _show(table: dict[str, Any], key: str) -> str:
    return json.dumps(table[key]) if key in table else "not there"


def read_json(path: Path) -> Any:
    """What `write_json` wrote, infinite numbers too; None where there is no such file, or no JSON in it.

    Raises:
        InputError: it cannot be read, or is a folder.
    """

    def revive(entry):
        return {k: math.inf if isinstance(v, str) and v == "inf" else v for k, v in entry.items()}

    try:
        return json.loads(path.read_text(encoding="utf-8"), object_hook=revive)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise os_input_error(path, error) from error
    except (ValueError, RecursionError):
        return None


def write_json(path: Path, value: Any) -> None:
    """Writes JSON, in full or not at all; infinite numbers as "inf", what is no number as null."""

    def plain(v):
        if isinstance(v, dict):
            return {k: plain(x) for k, x in v.items()}
        if isinstance(v, list | tuple):
            return [plain(x) for x in v]
        if isinstance(v, float) and not math.isfinite(v):
            return "inf" if v > 0 else None  # JSON has neither
        return v

    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(plain(value), indent=1), encoding="utf-8")
